"""How much light the window of a detector misses."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.sampling_cost import SensedLight, light_outside
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor, centred_in
from nlcwfs.detector.pixels import fraction_outside_window
from nlcwfs.estimation.sensor_geometry import SensorGeometry

WIDE = 2
"""The window that tells how much light a detector misses holds twice the frame and twice the pupil."""


def wide_optics(geometry: SensorGeometry, *, dtype: str) -> CurvatureSensor:
    """The optics on a wider window, to know what the detector's window misses.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((15, 20), 0.5), 0.65e-6, (3e6,))
        >>> wide_optics(geometry, dtype="float32").pupil.shape
        (33, 40)
    """
    return geometry.model(_wide_grid(geometry), dtype=dtype)


def missed_by_wavefronts(
    wide: CurvatureSensor, opds_m: Sequence[Float[np.ndarray, "y x"]]
) -> Float[np.ndarray, " plane"]:
    """Share of the light of each plane that these wavefronts carry out of the window, mean over them.

    Args:
        wide: See `wide_optics`.
        opds_m: Wavefronts on the pixels of a frame; NaN counts as 0.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((20, 20), 0.5), 0.65e-6, (3e6,))
        >>> tilted_m = 3e-7 * np.broadcast_to(np.arange(20.0), (20, 20))  # 0.6 urad: 1.8 m at 3000 km
        >>> missed_by_wavefronts(wide_optics(geometry, dtype="float32"), [tilted_m]).round(2).tolist()
        [0.05]
    """
    rows, columns = wide.pupil.shape
    window = (opds_m[0].shape[0], opds_m[0].shape[1])
    whole = [jnp.asarray(centred_in(np.nan_to_num(one), (rows, columns)), wide.pupil.dtype) for one in opds_m]
    return np.mean([np.asarray(_fraction_outside(wide, one, window), float) for one in whole], axis=0)


def missed_on_average(geometry: SensorGeometry, air: Turbulence) -> Float[np.ndarray, " plane"]:
    """The same for the mean over turbulence, whose finest waves no wavefront on pixels holds.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((20, 20), 0.5), 0.65e-6, (-3e6, 0.0))
        >>> missed_on_average(geometry, Turbulence.from_seeing(seeing_arcsec=0.6)).round(2).tolist()
        [0.48, 0.0]
    """
    wavelength_m = geometry.wavelength_m
    light = SensedLight(geometry.pupil.diameter_m, wavelength_m, fried_m=air.fried_at(wavelength_m))
    window_m = min(geometry.frame.width_m)
    both_sides = {abs(distance_m) for distance_m in geometry.distances_m}
    usual = {z: light_outside(light, distance_m=z, window_m=window_m) if z else 0.0 for z in both_sides}
    return np.array([usual[abs(distance_m)] for distance_m in geometry.distances_m])


def _wide_grid(geometry: SensorGeometry) -> Grid:
    pupil_pixels = geometry.pupil.diameter_m / geometry.frame.pixel_m

    def size(frame: int) -> int:
        count = math.ceil(WIDE * max(frame, pupil_pixels))
        while (count - frame) % 2 or count != scipy.fft.next_fast_len(count):
            count += 1
        return count

    return Grid((size(geometry.frame.shape[0]), size(geometry.frame.shape[1])), geometry.frame.pixel_m)


@eqx.filter_jit
def _fraction_outside(
    wide: CurvatureSensor, opd_m: Float[Array, "y x"], window: tuple[int, int]
) -> Float[Array, " plane"]:
    return fraction_outside_window(wide.images(opd_m, 1.0).photons, factor=1, window=window)
