r"""The other wavefront that a single plane cannot tell from the true one.

Light on a plane at distance z from the pupil is, but for its scale and a curved phase, the Fourier transform of
:math:`A \exp(i \phi + i \pi |x|^2 / (\lambda z))` (Goodman 2005, eq. 4-17). A function and its mirrored conjugate,
:math:`g(x)` and :math:`g^*(-x)`, have Fourier transforms of the same modulus. So in a pupil that is the same when it is
turned by half a turn, :math:`\phi(x)` and :math:`-\phi(-x) - 2 \pi |x|^2 / (\lambda z)` make the same image. In metres
of path: :math:`W(x)` and :math:`-W(-x) - |x|^2 / z`. A second plane, at another distance, tells them apart.
"""

import math

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.grid import Grid
from nlcwfs.interop.frames_file import FramesFile

SYMMETRIC = 0.02
"""A pupil of which less than this share of the light changes place in half a turn counts as symmetric: vanes of other
shapes tell the two wavefronts apart no better than noise lets them."""


def twin_opd_m(opd_m: Float[np.ndarray, "y x"], grid: Grid, *, distance_m: float) -> Float[np.ndarray, "y x"]:
    """The wavefront that makes the same image on a plane, if the pupil is symmetric.

    Args:
        opd_m: A wavefront.
        grid: Its pixels.
        distance_m: Of the plane, signed.

    Examples:
        >>> grid = Grid((3, 4), pixel_m=1.0)
        >>> opd_m = 1e-7 * np.arange(12.0).reshape(3, 4)
        >>> twin = twin_opd_m(opd_m, grid, distance_m=-3e6)
        >>> bool(np.allclose(twin_opd_m(twin, grid, distance_m=-3e6), opd_m))  # each is the other's
        True
    """
    return -opd_m[::-1, ::-1] - (grid.x_m**2 + grid.y_m**2) / distance_m


def twin_warning(frames: FramesFile) -> str | None:
    """What the user of a single plane should know; None for several planes, or a pupil without the symmetry.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.ones((1, 1, 4, 4)), masked=np.zeros((1, 1, 4, 4), bool), has_frame_axis=False,
        ...     pixel_m=2.0, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(3.5e6,),
        ... )
        >>> print(twin_warning(frames))
        ZPLANE1: one plane cannot tell the wavefront W(x) from -W(-x) - x^2/z, ... 1320 nm rms
    """
    if len(frames.distances_m) != 1 or not _is_symmetric(frames.pupil):
        return None
    (distance_m,) = frames.distances_m
    radius_m = frames.diameter_m / 2
    defocus_nm = radius_m**2 / math.sqrt(12) / abs(distance_m) * 1e9  # rms of r^2 over a disc
    return (
        "ZPLANE1: one plane cannot tell the wavefront W(x) from -W(-x) - x^2/z, so the sign is ambiguous; turbulence "
        f"as the prior chooses the one without the defocus of {defocus_nm:.0f} nm rms"
    )


def _is_symmetric(pupil: Float[np.ndarray, "y x"] | None) -> bool:
    if pupil is None:
        return True
    light = pupil**2
    return bool(np.abs(light - light[::-1, ::-1]).sum() / 2 < SYMMETRIC * light.sum())
