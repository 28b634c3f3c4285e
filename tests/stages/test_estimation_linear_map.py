"""Features and the matrix: invariance, noise by chance, and the estimate of least error in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.binned_features import BinnedFeatures, Features
from nlcwfs.estimation.linear_map import PHOTONS, learn
from nlcwfs.estimation.linear_training import TrainingSet


def everywhere(counts: np.ndarray):
    return jnp.asarray(counts), jnp.ones(counts.shape, bool)


def test_bins_that_follow_the_tilt_see_the_shifted_image_alike():
    """Slope times distance is a whole number of pixels here, so the image moves without interpolation."""
    sensor = BinnedFeatures(Grid((15, 18), 0.5), (-2e6, 1e6), bin_pixels=2)
    image = np.zeros((2, 15, 18))
    image[:, 4:11, 5:13] = np.random.default_rng(1).uniform(1, 2, (2, 7, 8))
    moved = np.stack([np.roll(image[0], (-2, 4), (0, 1)), np.roll(image[1], (1, -2), (0, 1))])
    still = sensor.of(*everywhere(image), slope=jnp.zeros(2)).values
    slope = jnp.array([0.5e-6, -1e-6])  # -2e6 m * slope = (-1 m, 2 m)
    np.testing.assert_allclose(sensor.of(*everywhere(moved), slope=slope).values, still, atol=1e-12)
    assert np.abs(sensor.of(*everywhere(moved), slope=-slope).values - still).max() > 0.1


@pytest.mark.parametrize(("shape", "bin_pixels"), [((8, 9), 2), ((7, 10), 3)])
def test_the_noise_of_the_features_is_that_of_photons_that_fall_by_chance(shape, bin_pixels):
    rng = np.random.default_rng(5)
    sensor = BinnedFeatures(Grid(shape, 0.5), (-1e6, 2e6), bin_pixels)
    images = rng.uniform(1, 3, (2, *shape)) * np.array([1.0, 2.5])[:, None, None]
    images /= images.sum()
    photons, draws = 1e6, 8000
    counts = rng.poisson(images * photons, (draws, 2, *shape))
    look = jax.jit(jax.vmap(lambda one: sensor.of(one, jnp.ones(one.shape, bool), slope=jnp.zeros(2)).values))
    seen = np.cov(np.asarray(look(jnp.asarray(counts, float))).T) * photons
    known = np.asarray(sensor.of(*everywhere(images), slope=jnp.zeros(2)).known)
    expected = sensor.noise(images, images.sum(axis=(1, 2)))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    apart = (np.abs(seen - expected) / scale)[np.ix_(known, known)]
    assert apart.max() < 6 / np.sqrt(draws)  # thousands of sample correlations, each with sigma 1 / sqrt(draws)


def test_a_bin_that_is_mostly_masked_is_not_known_and_a_little_masked_is():
    sensor = BinnedFeatures(Grid((9, 9), 0.5), (1e6,), bin_pixels=3)
    usable = np.ones((1, 9, 9), bool)
    usable[0, 0:3, 0:2] = False
    usable[0, 4, 4] = False
    counts = np.where(usable, 4.0, 1e5)
    seen = sensor.of(jnp.asarray(counts), jnp.asarray(usable), slope=jnp.zeros(2))
    assert not seen.known[0]
    assert np.all(seen.known[1:])
    np.testing.assert_allclose(seen.values[4] / seen.values[8], 9 / 8)  # filled, then as bright as what was measured


def linear_world(screens: int):
    """A linear Gaussian measurement: three modes, five features."""
    rng = np.random.default_rng(2)
    response, variance = rng.normal(size=(3, 5)), np.array([4.0, 1.0, 0.25])
    root = rng.normal(size=(5, 5)) * 20
    noise = root @ root.T + 100 * np.eye(5)
    modes = rng.normal(size=(screens, 3)) * np.sqrt(variance)
    training = TrainingSet(modes @ response + 7.0, modes, np.ones(screens), np.ones((1, 1, 1)))
    return response, variance, noise, training


def test_the_matrix_is_the_linear_estimate_of_least_error():
    response, variance, noise, training = linear_world(100_000)
    rng = np.random.default_rng(3)
    found = learn(training, noise, judges=2000, beyond_m2=0.3, dtype="float64")
    for which in (0, 2, 4):
        seen = response.T * variance @ response + noise / PHOTONS[which]
        best = np.linalg.solve(seen, response.T * variance).T
        error = np.sum(variance) - np.trace(best @ (response.T * variance))
        matrix = np.asarray(found.matrices[which])
        bias = np.eye(3) - matrix @ response.T
        got = np.sum(bias**2 * variance) + np.trace(matrix @ noise @ matrix.T) / PHOTONS[which]
        assert error <= got < 1.05 * error  # the ridge comes from a list, in steps of 1.8
        np.testing.assert_allclose(found.noise_m2[which], np.trace(matrix @ noise @ matrix.T), rtol=0.01)
        # The error that it promises: bias over the judges' wavefronts, noise, and what lies beyond the modes.
        missed = np.mean(np.asarray(found.missed_m2[which]))
        assert missed == pytest.approx(0.3 + np.sum(bias**2 * variance), rel=5 * np.sqrt(2 / 2000) + 0.05)
        noisy = training.values[:2000] + rng.multivariate_normal(np.zeros(5), noise / PHOTONS[which], 2000)
        photons, known = jnp.asarray(PHOTONS[which]), jnp.ones(5, bool)
        judged = jax.vmap(lambda values: found.judge(Features(values, known), photons))(jnp.asarray(noisy))  # noqa: B023
        left = np.sum((np.asarray(judged.coefficients_m) - training.coefficients_m[:2000]) ** 2, axis=1).mean()
        assert left == pytest.approx(got, rel=0.15)  # 5 sigma of 2000 squares of three modes
        assert np.mean(judged.variance_m2) == pytest.approx(got + 0.3, rel=0.15)


def test_an_unknown_bin_says_nothing():
    _, _, noise, training = linear_world(3000)
    found = learn(training, noise, judges=300, beyond_m2=0.0, dtype="float64")
    values = np.array(training.values[1])
    known = jnp.array([True, True, False, True, True])
    answers = []
    for wild in (0.0, 1e6):
        values[2] = wild
        answers.append(found.judge(Features(jnp.asarray(values), known), jnp.asarray(1e4)).coefficients_m)
    np.testing.assert_array_equal(*answers)
