"""A model of one colour of light that has many: at the wavelength of the mean phase, behind chromatic lenses."""

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.chromatic_lenses import LensLaw
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.estimation.sensor_geometry import SensorGeometry

WIDE = Grid((64, 63), 0.125)  # 8 m high, lit everywhere
LOW_M, HIGH_M, PLANES_M = 0.68e-6, 1.02e-6, (-2.5e6, 3.5e6)
BAND = LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=HIGH_M - LOW_M)
GEOMETRY = SensorGeometry(PupilShape(8.0), WIDE, 0.85e-6, PLANES_M)


def ripples(spectrum: Spectrum, distances_m, cycles: int = 11) -> np.ndarray:
    """What a wave of 2 nm along y becomes in each image, over the mean light."""
    wave = np.exp(-2j * np.pi * cycles * WIDE.y_m / 8.0)
    opd_m = 2e-9 * wave.real + 0 * WIDE.x_m
    light = {"distances_m": distances_m, "spectrum": spectrum, "dtype": "float64"}
    sensor = CurvatureSensor.build(np.ones(WIDE.shape), WIDE, **light)
    images = np.asarray(sensor.images(jnp.asarray(opd_m), 1.0).photons)
    return 2 * np.mean(images * wave, axis=(1, 2)) / np.mean(images, axis=(1, 2))


@pytest.mark.parametrize("cycles", [5, 11])
def test_one_colour_shows_the_ripples_of_a_whole_band_behind_ideal_lenses(cycles):
    law = LensLaw("ideal", 0.85e-6)
    told = GEOMETRY.in_mean_phase(BAND, law)
    # The mean of 1 / wavelength over a flat band is log(high / low) / (high - low).
    mean_per_m = np.log(HIGH_M / LOW_M) / (HIGH_M - LOW_M)
    signal = np.sin(np.pi * 0.85e-6 * np.array(PLANES_M) * (cycles / 8) ** 2)
    expected = 2 * 2 * np.pi * mean_per_m * 2e-9 * signal
    spectrum = BAND.spectrum(15)
    band = ripples(spectrum, law.distances_m(PLANES_M, spectrum.wavelengths_m), cycles)
    one = ripples(Spectrum.monochromatic(told.wavelength_m), told.distances_m, cycles)
    # Second order in a phase of 0.015 rad; a model in the middle of the band is 1.4 % off.
    np.testing.assert_allclose(band, expected, rtol=1e-3)
    np.testing.assert_allclose(one, expected, rtol=1e-3)
    middle = ripples(Spectrum.monochromatic(0.85e-6), PLANES_M, cycles)
    assert np.all(np.abs(middle / expected) < 0.99)


def test_a_model_behind_achromatic_lenses_stays_in_the_middle():
    assert GEOMETRY.in_mean_phase(BAND, LensLaw("achromatic", 0.85e-6)) is GEOMETRY
