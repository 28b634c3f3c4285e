"""The sensors whose sensitivity is asked, on grids that carry their light."""

import math

import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.pyramid import Pyramid
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, lenslet_grid
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.speckle_blur import blurred
from nlcwfs.simulation.exposure import distances_m, wavelength_m
from nlcwfs.simulation.sensitivity import Optics
from nlcwfs.simulation.sensitivity_settings import LightCells, SensitivityCase, SensitivityQuestion
from nlcwfs.simulation.static_aberration import static_aberration
from nlcwfs.simulation.steady_light import refuse_colours
from nlcwfs.simulation.telescope import telescope


def optics_of(case: SensitivityCase, config: Config, question: SensitivityQuestion, air: Turbulence | None) -> Optics:
    """A sensor on a grid for its light.

    Args:
        case: Which one.
        config: Its settings.
        question: Cells and pixels.
        air: The turbulence that the cells must carry; None for a flat wavefront.

    Raises:
        SettingsError: If settings contradict each other.
        SamplingError: If the grid is too coarse.
        SettingsError: If the settings ask for light of many colours.

    Examples:
        >>> case = SensitivityCase(name="linear curvature", set=("curvature_sensor.distances_km=[-1000, 1000]",))
        >>> config = case.config(None, ())
        >>> asked = SensitivityQuestion(question="?", flat=LightCells(across_pupil=32, window=2.0))
        >>> optics = optics_of(case, config, asked, None)
        >>> optics.grid.shape, optics.images(jnp.zeros((64, 64))).shape
        ((64, 64), (2, 64, 64))
    """
    refuse_colours(config, because="nlcwfs sensitivity")
    cells = question.flat if air is None else question.rough
    if case.sensor == "shack-hartmann":
        return _lenslets(config, air)
    if case.sensor == "pyramid":
        return _pyramid(config, cells)
    return _curvature(config, cells, cells.across_pupil // (question.pixels_across_pupil or cells.across_pupil))


def _curvature(config: Config, cells: LightCells, binning: int) -> Optics:
    """Defocused images: curvature of any distance, linear or not, and phase diversity."""
    across = cells.across_pupil
    size = math.ceil(across * cells.window)
    while size % binning or (size - across) % 2 or size != scipy.fft.next_fast_len(size):
        size += 1
    diameter_m, colour_m = config.beam.diameter_m, wavelength_m(config)
    grid = Grid((size, size), diameter_m / across)
    pupil = telescope(config).on(grid)
    weights = light_weights(pupil)
    sensor = CurvatureSensor.build(
        pupil,
        grid,
        distances_m=distances_m(config),
        spectrum=Spectrum.monochromatic(colour_m),
        flux_fractions=config.curvature_sensor.flux_fractions,
        static_opd_m=static_aberration(config, weights, grid),
    )

    def images(opd_m: Float[Array, "Y X"]) -> Float[Array, "plane v u"]:
        photons = sensor.images(opd_m, 1.0).photons
        planes, pixels = len(photons), size // binning
        return photons.reshape(planes, pixels, binning, pixels, binning).sum((2, 4))

    def long_exposure(several: Float[Array, "some v u"], air: Turbulence) -> Float[Array, "some v u"]:
        planes = np.tile(np.abs(distances_m(config)), len(several) // len(distances_m(config)))
        pixels = Grid((size // binning, size // binning), grid.pixel_m * binning)
        frequency_per_m = np.hypot(pixels.fy_per_m, np.fft.rfftfreq(pixels.shape[1], pixels.pixel_m)[None, :])
        return _faded(several, colour_m * planes[:, None, None] * frequency_per_m, air, colour_m)

    still = config.curvature_sensor.static_rms_nm == 0
    return Optics(images, grid, weights, diameter_m, colour_m, long_exposure if still else None)


def _lenslets(config: Config, air: Turbulence | None) -> Optics:
    """Spots behind lenslets, in their own windows."""
    settings, diameter_m, colour_m = config.shack_hartmann, config.beam.diameter_m, wavelength_m(config)
    fried_m = diameter_m if air is None else air.fried_at(colour_m)
    grid = lenslet_grid(settings, diameter_m=diameter_m, fried_m=fried_m)
    pupil = telescope(config).on(grid)
    colours = Spectrum.monochromatic(colour_m)
    sensor = ShackHartmann.build(pupil, grid, diameter_m=diameter_m, spectrum=colours, settings=settings)

    def images(opd_m: Float[Array, "Y X"]) -> Float[Array, "spot v u"]:
        return sensor.images(opd_m, 1.0).photons

    def long_exposure(several: Float[Array, "some v u"], air: Turbulence) -> Float[Array, "some v u"]:
        wide = 2 * several.shape[1], 2 * several.shape[2]  # spots do not come in again on the other side
        margins = [(0, 0)] + [(0, width - size) for width, size in zip(wide, several.shape[1:], strict=True)]
        frequency = np.hypot(
            np.fft.fftfreq(wide[0], sensor.pixel_rad)[:, None], np.fft.rfftfreq(wide[1], sensor.pixel_rad)[None, :]
        )
        faded = _faded(jnp.pad(several, margins), (colour_m * frequency)[None], air, colour_m)
        return faded[:, : several.shape[1], : several.shape[2]]

    weights = light_weights(pupil)
    return Optics(images, grid, weights, diameter_m, colour_m, long_exposure, finest_cpa=settings.subapertures / 2)


def _pyramid(config: Config, cells: LightCells) -> Optics:
    """Four images of the pupil; how turbulence blurs them has no closed form."""
    across, diameter_m, colour_m = cells.across_pupil, config.beam.diameter_m, wavelength_m(config)
    grid = Grid((across, across), diameter_m / across)
    pupil = telescope(config).on(grid)
    colours = Spectrum.monochromatic(colour_m)
    sensor = Pyramid.build(pupil, grid, diameter_m=diameter_m, spectrum=colours, settings=config.pyramid)

    def images(opd_m: Float[Array, "Y X"]) -> Float[Array, "image v u"]:
        return sensor.images(opd_m, 1.0).photons

    return Optics(images, grid, light_weights(pupil), diameter_m, colour_m, finest_cpa=config.pyramid.pixels / 2)


def _faded(
    several: Float[Array, "some v u"], apart_m: Float[np.ndarray, "some v fu"], air: Turbulence, wavelength_m: float
) -> Float[Array, "some v u"]:
    r"""Images averaged over turbulence: each wave times :math:`\exp(-D / 2)`, D the structure function in rad^2.

    Exact, for a wave of an image comes from two points of the pupil that are a fixed distance apart (Fried 1966).
    """
    rough = air.structure_m2(apart_m) * (2 * np.pi / wavelength_m) ** 2
    return blurred(several, jnp.asarray(np.exp(-rough / 2), several.dtype))


def check_case(case: SensitivityCase, config: Config) -> None:
    """Refuse what has no sensitivity, before anything is computed.

    Raises:
        SettingsError: If the pupil is a map.

    Examples:
        >>> check_case(SensitivityCase(name="planes"), Config())
    """
    if config.beam.pupil_map is not None:
        raise SettingsError("beam.pupil_map", f"must be left out of a sensitivity ({case.name})", config.beam.pupil_map)
