"""The sensor behind a file of frames: its geometry, the pixels that count, and the Zernikes these tell apart."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil import inside, light_weights
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.zernike import ZernikeFit, zernike_fit, zernikes
from nlcwfs.curvature_sensor.chromatic_lenses import LensLaw
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.interop.frames_file import FramesFile

WELL_SEEN = 2.0
"""Zernikes are listed as long as noise in the worst combination of them is below twice that in the best: beyond, even
tilt takes up noise from the last ones, because all are fitted together."""


def sensor_geometry(frames: FramesFile, *, wavelengths: int = 1, moments: int = 1) -> SensorGeometry:
    """The sensor that a file of frames describes, without a static aberration.

    Args:
        frames: The file.
        wavelengths: By which a model stands for the light of its band, which is taken as flat in photons; 1 takes all
            light for that of one, see `SensorGeometry.in_mean_phase`.
        moments: By which it follows a membrane that vibrates like a sine; 1 lets the planes rest.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.ones((1, 2, 8, 9)), masked=np.zeros((1, 2, 8, 9), bool), has_frame_axis=False,
        ...     pixel_m=1.0, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(-2.5e6, 2.5e6),
        ... )
        >>> sensor_geometry(frames).frame.shape
        (8, 9)
    """
    maps = {"map_pixel_m": frames.pixel_m, "label_map": frames.segments}
    if frames.pupil is None:
        shape = PupilShape(frames.diameter_m, frames.obstruction_ratio, **maps)
    else:
        shape = PupilShape(frames.diameter_m, amplitude_map=frames.pupil, **maps)
    geometry = SensorGeometry(
        pupil=shape,
        frame=Grid(frames.electrons.shape[2:], frames.pixel_m),
        wavelength_m=frames.wavelength_m,
        distances_m=frames.distances_m,
        flux_fractions=frames.flux_fractions,
        motion=frames.membrane,
        moments=moments,
        dead_share=frames.membrane_dead_share,
    )
    if frames.bandwidth_m == 0:
        return geometry
    band = LightBand.flat(wavelength_m=frames.wavelength_m, bandwidth_m=frames.bandwidth_m)
    law = LensLaw("ideal" if frames.chromatic_lenses else "achromatic", frames.wavelength_m)
    if wavelengths == 1:
        return geometry.in_mean_phase(band, law)
    spectrum = band.spectrum(wavelengths)
    places_m = law.distances_m(frames.distances_m, spectrum.wavelengths_m)
    return dataclasses.replace(geometry, spectrum=spectrum, colour_distances_m=tuple(map(tuple, places_m.tolist())))


def window_pupil(geometry: SensorGeometry, shape: tuple[int, int]) -> Float[np.ndarray, "y x"]:
    """Amplitude of the pupil on a window that holds it whole, with the pixels and the centre of the frames.

    Examples:
        >>> window_pupil(SensorGeometry(PupilShape(8.0), Grid((4, 6), 1.0), 0.65e-6, (3e6,)), (10, 12)).shape
        (10, 12)
    """
    return geometry.pupil.on(Grid(shape, geometry.frame.pixel_m))


def pupil_on_frame(geometry: SensorGeometry) -> Float[np.ndarray, "y x"]:
    """Amplitude of the pupil on the pixels of a frame, which may be narrower than the pupil.

    Examples:
        >>> pupil_on_frame(SensorGeometry(PupilShape(8.0), Grid((4, 6), 1.0), 0.65e-6, (3e6,))).shape
        (4, 6)
    """
    rows, columns = geometry.frame.shape
    margin = math.ceil(geometry.pupil.diameter_m / geometry.frame.pixel_m / 2)
    pupil = window_pupil(geometry, (rows + 2 * margin, columns + 2 * margin))
    return pupil[margin : margin + rows, margin : margin + columns]


def scored_pupil(geometry: SensorGeometry) -> Float[np.ndarray, "y x"]:
    """The pupil on the pixels that count for a wavefront: those at least half lit.

    Examples:
        >>> pupil = scored_pupil(SensorGeometry(PupilShape(8.0), Grid((4, 10), 1.0), 0.65e-6, (3e6,)))
        >>> bool(pupil[0, 0] == 0), bool(pupil[0, 5] == 1)
        (True, True)
    """
    pupil = pupil_on_frame(geometry)
    return np.where(inside(pupil), pupil, 0)


def well_seen_zernikes(pupil: Float[np.ndarray, "y x"], geometry: SensorGeometry, *, most: int) -> ZernikeFit:
    """The fit of as many whole radial orders of Zernikes, `most` at most, as this pupil tells apart well.

    Examples:
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((20, 20), 0.5), 0.65e-6, (-3e6, 3e6))
        >>> well_seen_zernikes(scored_pupil(geometry), geometry, most=800).matrix.shape
        (45, 20, 20)
    """
    grid, diameter_m = geometry.frame, geometry.pupil.diameter_m
    weights = light_weights(pupil)
    lit = weights > 0
    most = max(1, min(most, int(lit.sum()) // 2))
    seen = zernikes(most, grid, diameter_m=diameter_m)[:, lit] * np.sqrt(weights[lit])
    gram = seen @ seen.T
    counts = sorted({min(most, (n + 1) * (n + 2) // 2) for n in range(math.isqrt(2 * most) + 2)})
    low, high = 0, len(counts) - 1  # piston alone is always well seen
    while low < high:
        middle = (low + high + 1) // 2
        spread = np.linalg.eigvalsh(gram[: counts[middle], : counts[middle]])
        good = spread[0] > 0 and spread[-1] / spread[0] <= WELL_SEEN**2
        low, high = (middle, high) if good else (low, middle - 1)
    return zernike_fit(pupil, grid, diameter_m=diameter_m, count=counts[low])
