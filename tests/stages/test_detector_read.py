"""One exposure: keys, precision, transformations, saturation and readings, all with hand-made numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.detector import Detector, DetectorSettings, at_full_scale, electrons_to_adu

EMCCD = Detector(DetectorSettings(preset="EMCCD"))
SHAPE = (2, 5, 7)  # one shape for all: a sampler compiles once for each
LIGHT = jnp.asarray(np.random.default_rng(0).gamma(2.0, 30.0, SHAPE))


def test_the_same_key_gives_the_same_frames_and_another_key_gives_others():
    first, again = EMCCD.read(LIGHT, jax.random.key(3)), EMCCD.read(LIGHT, jax.random.key(3))
    other = EMCCD.read(LIGHT, jax.random.key(4))
    np.testing.assert_array_equal(first.electrons, again.electrons)
    assert np.mean(np.asarray(first.electrons) == np.asarray(other.electrons)) < 0.2  # codes may coincide


def test_jit_and_vmap_read_as_a_plain_loop_does():
    keys = jax.random.split(jax.random.key(5), 3)
    light = jnp.stack([LIGHT, 2 * LIGHT, 30 * LIGHT])

    @jax.jit
    def read_all(detector, light, keys):  # the detector itself is an argument
        return jax.vmap(detector.read)(light, keys)

    batch = read_all(EMCCD, light, keys)
    for i in range(3):
        single = EMCCD.read(light[i], keys[i])
        np.testing.assert_allclose(batch.electrons[i], single.electrons, rtol=1e-12)  # order of rounding
        np.testing.assert_array_equal(batch.saturated[i], single.saturated)


@pytest.mark.parametrize("preset", ["ideal", "qCMOS", "EMCCD"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_frames_keep_the_precision_of_the_light(preset, dtype):
    camera = Detector(DetectorSettings(preset=preset))
    frames = camera.read(LIGHT.astype(dtype), jax.random.key(7))
    assert frames.electrons.dtype == dtype
    assert camera.variance_electrons(frames.electrons).dtype == dtype
    assert camera.to_adu(frames.electrons).dtype == dtype


def test_no_light_and_no_dark_give_exactly_nothing():
    for em_gain in (1.0, 600.0):
        camera = Detector(DetectorSettings(em_gain=em_gain, bits=14, gain_electrons_per_adu=28, bias_adu=408))
        frames = camera.read(jnp.zeros(SHAPE), jax.random.key(8))
        np.testing.assert_array_equal(frames.electrons, 0)
        assert not frames.saturated.any()


def test_a_full_well_is_flagged_and_holds_its_electrons():
    camera = Detector(DetectorSettings(full_well_electrons=1000))
    frames = camera.read(jnp.zeros(SHAPE).at[1, 2, :3].set([1e5, 2000.0, 10.0]), jax.random.key(9))
    expected = np.zeros(SHAPE, bool)
    expected[1, 2, :2] = True
    np.testing.assert_array_equal(frames.saturated, expected)
    np.testing.assert_array_equal(frames.electrons[1, 2, :2], [1000, 1000])
    assert 0 < frames.electrons[1, 2, 2] < 40  # 10 electrons and 9 sigma


def test_a_full_converter_is_flagged_and_reads_its_highest_code():
    camera = Detector(DetectorSettings(bits=8, gain_electrons_per_adu=2.0, bias_adu=5.0))
    frames = camera.read(jnp.full(SHAPE, 100.0).at[0, 3, 4].set(1e4), jax.random.key(10))
    np.testing.assert_array_equal(np.argwhere(frames.saturated), [[0, 3, 4]])
    assert frames.electrons[0, 3, 4] == (255 - 5) * 2  # highest code of 8 bits, less the bias, times the step


def test_the_bias_leaves_room_for_negative_noise():
    settings = DetectorSettings(bits=10, bias_adu=100, read_noise_electrons=10)
    dark = Detector(settings).read(jnp.zeros(SHAPE), jax.random.key(11)).electrons
    assert abs(float(dark.mean())) < 6  # 5 sigma: 10 / sqrt(70) each; without negatives the mean is 4 ...
    assert float(dark.min()) < -10  # ... and the lowest of 70 numbers is 0 instead of -24


def test_readings_follow_bias_step_and_multiplication():
    settings = DetectorSettings(em_gain=10, gain_electrons_per_adu=4, bias_adu=100, bits=12)
    camera = Detector(settings)
    np.testing.assert_array_equal(camera.to_adu(jnp.asarray([0.0, 8.0, -2.0])), [100, 120, 95])
    np.testing.assert_array_equal(camera.to_electrons(jnp.asarray([100.0, 120.0, 95.0])), [0, 8, -2])


def test_without_bits_nothing_is_rounded_or_limited():
    values = jnp.asarray([-7.25, 0.1, 1e9])
    adu = electrons_to_adu(values, gain_electrons_per_adu=0.5, bias_adu=3.0, bits=0)
    np.testing.assert_array_equal(adu, np.asarray(values) / 0.5 + 3.0)
    assert not at_full_scale(adu, bits=0).any()


def test_background_and_dark_stay_in_the_electrons():
    settings = DetectorSettings(quantum_efficiency=0.5, background_photons=40, dark_electrons=5)
    camera = Detector(settings)
    assert camera.background_electrons == 25
    mean = camera.read(jnp.full(SHAPE, 10.0), jax.random.key(12)).electrons.mean()
    assert abs(float(mean) - 30) < 5 * (30 / 70) ** 0.5  # 5 sigma of the mean of 70 Poisson numbers


def test_the_variance_of_a_negative_measurement_is_that_of_darkness():
    camera = Detector(DetectorSettings(read_noise_electrons=3))
    np.testing.assert_array_equal(camera.variance_electrons(jnp.asarray([-5.0, 0.0, 16.0])), [9, 9, 25])
