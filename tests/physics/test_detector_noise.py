"""Noise of the detector against closed forms: laws of probability, moments, excess noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from nlcwfs.detector import Detector, DetectorSettings, multiply_electrons, sample_poisson

SHAPE = (2, 100, 650)  # one shape for all: a sampler compiles once for each
COUNT = 130_000


def assert_moments(samples, mean, variance):
    """Sample mean and variance within 5 sigma of the truth, the latter from the sample's fourth moment."""
    samples = np.asarray(samples, float).ravel()
    deviations = samples - samples.mean()
    error_of_mean = np.sqrt(variance / samples.size)
    error_of_variance = np.sqrt((np.mean(deviations**4) - samples.var() ** 2) / samples.size)
    assert abs(samples.mean() - mean) < 5 * error_of_mean
    assert abs(samples.var() - variance) < 5 * error_of_variance


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("mean", [1e-3, 0.3, 9.0, 11.0, 300.0, 999.0, 1001.0, 1e4, 1e5, 1e6])
def test_photon_noise_has_the_variance_of_its_mean(mean, dtype):
    numbers = np.asarray(sample_poisson(jax.random.key(2), jnp.full(SHAPE, mean, dtype)), float)
    assert np.all(numbers == np.round(numbers))
    assert numbers.min() >= 0
    # Fourth moment of a Poisson law: 3 m^2 + m.
    assert abs(numbers.mean() - mean) < 5 * np.sqrt(mean / COUNT)
    assert abs(numbers.var() / mean - 1) < 5 * np.sqrt((2 + 1 / mean) / COUNT)


@pytest.mark.parametrize("mean", [0.5, 7.0, 40.0, 900.0, 1100.0, 5000.0])
def test_photon_noise_follows_the_law_of_poisson(mean):
    numbers = np.ravel(sample_poisson(jax.random.key(4), jnp.full(SHAPE, mean, jnp.float32)))
    law = stats.poisson(mean)
    edges = np.unique(law.ppf(np.linspace(0.001, 0.999, 40)))
    expected = np.diff(np.concatenate([[0], law.cdf(edges), [1]])) * COUNT
    found = np.bincount(np.searchsorted(edges, numbers), minlength=edges.size + 1)
    keep = expected > 10  # where a Gaussian error holds
    chi2 = np.sum((found - expected)[keep] ** 2 / expected[keep])
    freedom = keep.sum() - 1
    assert chi2 < freedom + 5 * np.sqrt(2 * freedom)  # 5 sigma


def test_bright_photon_noise_is_skewed_as_poisson_s_law():
    keys = jax.random.split(jax.random.key(13), 4)
    numbers = [np.ravel(sample_poisson(key, jnp.full(SHAPE, 1100.0))) for key in keys]
    error = np.sqrt(6 / (4 * COUNT))  # of a skewness of nearly normal numbers; five of them are 0.017 of 0.030
    assert abs(stats.skew(np.concatenate(numbers)) - 1100**-0.5) < 5 * error


def test_a_pixel_is_drawn_by_its_own_mean_in_a_frame_of_many_brightnesses():
    means = np.array([0.0, 1e-2, 5.0, 500.0, 1e6])
    frame = jnp.asarray(np.resize(means, SHAPE), jnp.float32)
    numbers = np.asarray(sample_poisson(jax.random.key(5), frame), float).reshape(-1, means.size)
    assert np.all(numbers[:, 0] == 0)
    errors = np.abs(numbers.mean(axis=0) - means)
    assert np.all(errors[1:] < 5 * np.sqrt(means[1:] / len(numbers)))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("em_gain", [1.01, 1.5, 10.0, 600.0])
@pytest.mark.parametrize("entering", [1.0, 30.0])
def test_the_register_has_the_moments_of_a_pure_birth_process(entering, em_gain, dtype):
    out = multiply_electrons(jax.random.key(6), jnp.full(SHAPE, entering, dtype), em_gain=em_gain)
    # n geometric numbers of mean G: mean n G, variance n G (G - 1).
    assert_moments(out, entering * em_gain, entering * em_gain * (em_gain - 1))


def test_the_register_resembles_a_chain_of_random_stages():
    rng = np.random.default_rng(7)
    stages, em_gain, entering = 200, 20.0, 12
    chain = np.full(20_000, entering)
    for _ in range(stages):
        chain += rng.binomial(chain, em_gain ** (1 / stages) - 1)
    out = np.ravel(multiply_electrons(jax.random.key(8), jnp.full(SHAPE, 12.0), em_gain=em_gain))
    # 5 sigma of the chain's 2e4 numbers: sqrt(n G (G - 1)) / sqrt(2e4) for the mean, 0.6 % for the rms,
    # sqrt(6 / 2e4) for the skewness. The chain's variance is 3 % lower, having 200 stages:
    # F^2 = 2 (G - 1) G^(-201/200) + 1/G = 1.922 instead of 1.95 (Robbins and Hadwen 2003).
    assert abs(out.mean() - chain.mean()) < 5 * np.sqrt(entering * em_gain * (em_gain - 1) / 2e4)
    assert abs(chain.std() / out.std() - np.sqrt(0.922 / 0.95)) < 0.03
    assert abs(stats.skew(out) - stats.skew(chain)) < 0.1


def test_one_electron_leaves_a_long_register_with_an_exponential_law():
    em_gain = 1000.0
    out = np.ravel(multiply_electrons(jax.random.key(9), jnp.ones(SHAPE), em_gain=em_gain))
    for level in (0.1, 1.0, 3.0):
        expected = np.exp(-level)
        error = np.sqrt(expected * (1 - expected) / out.size)
        assert abs(np.mean(out > level * em_gain) - expected) < 5 * error + 1e-3  # 1 / G: law of a finite gain


CAMERAS = {
    "photon noise": {},
    "efficiency": {"quantum_efficiency": 0.3},
    "background and dark": {"background_photons": 7.0, "dark_electrons": 11.0, "quantum_efficiency": 0.8},
    "read noise": {"read_noise_electrons": 50.0},
    "coarse steps": {
        "bits": 16,
        "gain_electrons_per_adu": 9.0,
        "bias_adu": 100.3,
        "read_noise_electrons": 8.0,
    },
    "low multiplication": {"em_gain": 2.0, "read_noise_electrons": 30.0},
    "high multiplication": {"em_gain": 1000.0, "read_noise_electrons": 900.0},
    "everything": {
        "quantum_efficiency": 0.9,
        "background_photons": 1.0,
        "dark_electrons": 0.5,
        "em_gain": 300.0,
        "read_noise_electrons": 200.0,
        "gain_electrons_per_adu": 400.0,
        "bits": 18,
        "bias_adu": 500.0,
    },
}


@pytest.mark.parametrize("photons", [3.0, 2500.0])
@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_reads_the_mean_and_variance_of_its_numbers(name, photons):
    s = {"quantum_efficiency": 1.0, "background_photons": 0.0, "dark_electrons": 0.0, "em_gain": 1.0}
    s |= {"read_noise_electrons": 0.0, "gain_electrons_per_adu": 1.0, "bits": 0} | CAMERAS[name]
    mean = s["quantum_efficiency"] * (photons + s["background_photons"]) + s["dark_electrons"]
    excess = 2 - 1 / s["em_gain"]
    step = s["gain_electrons_per_adu"] if s["bits"] else 0.0
    variance = excess * mean + (s["read_noise_electrons"] ** 2 + step**2 / 12) / s["em_gain"] ** 2

    camera = Detector(DetectorSettings(**CAMERAS[name]))
    frames = camera.read(jnp.full(SHAPE, photons), jax.random.key(10))
    assert not frames.saturated.any()
    assert_moments(frames.electrons, mean, variance)
    np.testing.assert_allclose(camera.expected_electrons(jnp.asarray([photons])), [mean], rtol=1e-14)
    np.testing.assert_allclose(camera.variance_electrons(jnp.asarray([mean])), [variance], rtol=1e-14)


def test_multiplication_costs_half_the_photons_but_silences_the_amplifier():
    light = jnp.full(SHAPE, 4.0)
    noisy = {"read_noise_electrons": 40.0}
    plain = Detector(DetectorSettings(**noisy)).read(light, jax.random.key(11)).electrons
    multiplied = Detector(DetectorSettings(**noisy, em_gain=1000.0)).read(light, jax.random.key(11)).electrons
    # Variances: photons 4, amplifier 40^2; photons 2 * 4 (1 / em_gain apart), amplifier 0.04^2. 5 sigma:
    # an rms of 1.3e5 numbers errs by 0.2 % for a normal law and 0.3 % for the second.
    assert abs(float(plain.std()) / np.sqrt(1604) - 1) < 0.01
    assert abs(float(multiplied.std()) / np.sqrt(8) - 1) < 0.015
