r"""Which steps between segments the defocused planes can show: those of segments whose light overlaps there.

Light that a straight rim sheds into the shadow falls with the square of the distance s from it, as
:math:`\lambda z / (4 \pi^2 s^2)` (Fresnel's integrals; Born & Wolf, sec. 8.7). Where light of both segments arrives it
interferes, and the photons of the weaker one tell the step. Summed over the gap g between two segments of width w that
is the share

.. math:: \frac{\lambda |z|}{w} \, \frac{1}{\pi^2 \max(g, \sqrt{\lambda |z|})}

of their photons: the spread :math:`\lambda |z| / w` against the gap. Fisher information of the step, in units of what a
perfect sensor has (4 N var = N for two equal segments), agrees with it within a factor of 2.7 for discs of 2.4 and
8.4 m, gaps from 0 to 16 m and planes from 300 to 35 000 km (`tests/physics/test_segments.py`).
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.sparse.csgraph
from jaxtyping import Float, Int

from nlcwfs.beam.grid import Grid

LEAST = 10.0
"""Photons that must tell a step: they leave 1 / sqrt(10) rad, a twentieth of a wave."""


class SeenPlanes(NamedTuple):
    """Where the light of segments may meet.

    Attributes:
        distances_m: Of the planes.
        wavelength_m: Of the light.
        flux_fractions: Share of the light of each plane; equal when left out.
    """

    distances_m: tuple[float, ...]
    wavelength_m: float
    flux_fractions: tuple[float, ...] | None = None

    def share(
        self, gap_m: Float[np.ndarray, "..."] | float, width_m: Float[np.ndarray, "..."] | float
    ) -> Float[np.ndarray, "..."]:
        """Share of the photons of two segments that tells the step between them, on all planes together."""
        fractions = self.flux_fractions or (1 / len(self.distances_m),) * len(self.distances_m)
        each = [telling_share(gap_m, width_m, distance_m=z, wavelength_m=self.wavelength_m) for z in self.distances_m]
        return np.asarray(np.tensordot(np.array(fractions), np.array(each), axes=1))


def telling_share(
    gap_m: Float[np.ndarray, "..."] | float,
    width_m: Float[np.ndarray, "..."] | float,
    *,
    distance_m: float,
    wavelength_m: float,
) -> Float[np.ndarray, "..."]:
    """Share of the photons of two segments that tells the step between them, on a plane.

    Args:
        gap_m: Between their rims.
        width_m: Of each.
        distance_m: Of the plane.
        wavelength_m: Of the light.

    Examples:
        Farther planes see more, wider gaps less.

        >>> near, far = (telling_share(2.0, 2.4, distance_m=z, wavelength_m=0.65e-6) for z in (1e5, -3.5e6))
        >>> round(float(near), 4), round(float(far), 3)
        (0.0014, 0.048)
    """
    spread_m2 = wavelength_m * abs(distance_m)
    wide_m = np.maximum(gap_m, math.sqrt(spread_m2))
    return np.asarray(spread_m2 / (np.pi**2 * np.asarray(width_m) * wide_m))


def unseen_step(
    pupil: Float[np.ndarray, "y x"],
    labels: Int[np.ndarray, "y x"],
    grid: Grid,
    *,
    photons: float,
    planes: SeenPlanes,
) -> tuple[int, float] | None:
    """The segment whose step against all others is told by too few photons, and by how many; None if there is none.

    Segments are taken as discs with their light. One segment seen from another is enough, whose step is seen from a
    third.

    Args:
        pupil: Amplitude.
        labels: Segment of each pixel.
        grid: Its pixels.
        photons: Of one exposure, whole sensor.
        planes: Where they go.

    Examples:
        >>> from nlcwfs.beam.segments import Segment, Segments
        >>> grid, two = Grid((20, 40), 0.5), Segments((Segment(0.0, -6.0, 2.0), Segment(0.0, 6.0, 2.0)))
        >>> pupil, labels = two.amplitude(grid), two.labels(grid)
        >>> unseen_step(pupil, labels, grid, photons=1e4, planes=SeenPlanes((-3.5e6, 3.5e6), 0.65e-6)) is None
        True
        >>> number, few = unseen_step(pupil, labels, grid, photons=1e4, planes=SeenPlanes((-1e4, 1e4), 0.65e-6))
        >>> number, round(few, 1)
        (1, 0.3)
    """
    count = int(labels.max()) + 1
    flat, light = labels.ravel(), pupil.ravel() ** 2
    sums = np.maximum(np.bincount(flat, light, count), 1e-12)
    y_m, x_m = (
        np.bincount(flat, light * axis_m.ravel(), count) / sums
        for axis_m in np.broadcast_arrays(grid.y_m, grid.x_m, subok=False)
    )
    widths_m = np.sqrt(4 / np.pi * np.maximum(np.bincount(flat, pupil.ravel(), count), 1)) * grid.pixel_m
    between_m = (widths_m[:, None] + widths_m) / 2
    gaps_m = np.maximum(np.hypot(y_m[:, None] - y_m, x_m[:, None] - x_m) - between_m, 0)
    both = 2 * np.minimum(sums[:, None], sums) / sums.sum()
    telling = photons * both * planes.share(gaps_m, between_m)
    pieces, piece = scipy.sparse.csgraph.connected_components(telling >= LEAST, directed=False)
    if pieces == 1:
        return None
    apart = piece != piece[int(np.argmax(sums))]
    across = np.where(apart[:, None] & ~apart[None], telling, 0)
    number = int(np.flatnonzero(apart)[np.argmin(across[apart].max(axis=1))])
    return number, float(across[number].max())
