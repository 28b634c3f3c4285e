"""Mean and variance of our cameras against two packages that share no code with us: getframes and hcipy.

Tolerance 3 %: 1.3e5 pixels give an error of a variance of 0.4 % (normal law) to 0.8 % (an EMCCD at one
electron), for each of the two samples, and the two models of a register differ by 1 / (2 em_gain).
"""

import getframes
import hcipy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.detector import Detector, DetectorSettings

SHAPE = (200, 650)
EXPOSURE_S = 0.5


@pytest.fixture
def global_generator():
    """hcipy draws from NumPy's global generator: seed it here, and leave it as it was."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(12)  # noqa: NPY002
    yield
    np.random.set_state(state)  # noqa: NPY002


def read(settings, photons):
    return Detector(settings).read(jnp.full((2, 100, 650), photons), jax.random.key(1)).electrons


def assert_same_moments(ours, theirs, *, rtol=0.03):
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    error_of_mean = 5 * np.sqrt(2 * theirs.var() / theirs.size)  # 5 sigma, where the mean is near zero
    assert abs(ours.mean() - theirs.mean()) < max(rtol * abs(theirs.mean()), error_of_mean)
    assert abs(ours.var() / theirs.var() - 1) < rtol


@pytest.mark.parametrize("photons", [0.0, 1.0, 150.0])
@pytest.mark.parametrize("name", ["hamamatsu_orca_quest_2", "andor_ocam2k", "andor_ixon_ultra_888"])
def test_cameras_of_getframes(name, photons):
    uniform = {"read_noise_nonuniformity": 0.0, "dark_current_nonuniformity": 0.0, "hot_pixel_fraction": 0.0}
    camera = getframes.Camera.from_preset(name).with_config(resolution=SHAPE, **uniform)
    config = camera.config
    temperature_c = config.dark_current_ref_temp_c
    theirs = camera.expose(photons / EXPOSURE_S, exposure=EXPOSURE_S, temperature=temperature_c, seed=2).data
    settings = DetectorSettings(
        preset="custom",
        quantum_efficiency=config.quantum_efficiency,
        dark_electrons=config.dark_current_e_per_s * EXPOSURE_S + config.clock_induced_charge_e,
        read_noise_electrons=config.read_noise_e,
        em_gain=config.em_gain,
        gain_electrons_per_adu=config.gain_e_per_adu,
        full_well_electrons=config.full_well_e,
        bits=config.bit_depth,
        bias_adu=config.bias_offset_adu,
    )
    scale = config.gain_e_per_adu / config.em_gain
    assert_same_moments(read(settings, photons), (theirs - config.bias_offset_adu) * scale)


@pytest.mark.parametrize("flux", [1.0, 30.0, 3000.0])
def test_the_register_of_hcipy(flux, global_generator):
    em_gain, read_noise = 600.0, 216.0
    theirs = hcipy.make_emccd_noise(np.full(SHAPE, flux), read_noise, em_gain) / em_gain
    settings = DetectorSettings(em_gain=em_gain, read_noise_electrons=read_noise)
    assert_same_moments(read(settings, flux), theirs)


@pytest.mark.parametrize("photons", [0.0, 1.0, 30.0, 3000.0])
def test_the_noisy_detector_of_hcipy(photons, global_generator):
    grid = hcipy.make_pupil_grid(SHAPE)
    detector = hcipy.NoisyDetector(grid, dark_current_rate=0.7, read_noise=0.4)
    detector.integrate(hcipy.Field(np.full(grid.size, photons), grid), 1.0)
    theirs = detector.read_out()
    settings = DetectorSettings(dark_electrons=0.7, read_noise_electrons=0.4)
    assert_same_moments(read(settings, photons), theirs)
