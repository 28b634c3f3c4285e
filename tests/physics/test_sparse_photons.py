"""Photons drawn one by one are Poisson's on every pixel, and independent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import poisson

from nlcwfs.detector.sparse_photons import room_for_photons, sample_sparse_photons
from nlcwfs.errors import SettingsError

DRAWS = 20000


@pytest.fixture(scope="module")
def drawn():
    mean = np.random.default_rng(4).random((3, 4, 5)) ** 3
    mean[1, 2] = 0
    mean[0, 0, 3] = 0
    mean[2, 3, 4] = 4.0
    draw = jax.jit(
        jax.vmap(lambda key: sample_sparse_photons(key, jnp.asarray(mean), room=room_for_photons(mean.sum())))
    )
    return mean, np.asarray(draw(jax.random.split(jax.random.key(1), DRAWS)))


def test_every_pixel_has_the_mean_and_the_variance_of_poisson(drawn):
    mean, counts = drawn
    # 5 sigma: sqrt(m / n), and sqrt((m + 2 m^2) / n) for the variance of Poisson numbers
    assert np.all(abs(counts.mean(0) - mean) <= 5 * np.sqrt(mean / DRAWS))
    assert np.all(abs(counts.var(0) - mean) <= 5 * np.sqrt((mean + 2 * mean**2) / DRAWS))


def test_a_pixel_without_light_has_none(drawn):
    mean, counts = drawn
    assert not counts[:, mean == 0].any()
    assert np.array_equal(counts, np.round(counts))


def test_pixels_do_not_know_of_each_other(drawn):
    mean, counts = drawn
    lit = counts[:, mean > 0.05].astype(float)
    correlation = np.corrcoef(lit.T) - np.eye(lit.shape[1])
    assert abs(correlation).max() < 5 / np.sqrt(DRAWS)


@pytest.mark.parametrize("pixel", [(2, 3, 4), (0, 1, 1)])
def test_each_count_is_as_frequent_as_poisson_says(drawn, pixel):
    mean, counts = drawn
    values = counts[(slice(None), *pixel)]
    for count in range(5):
        probability = poisson.pmf(count, mean[pixel])
        spread = np.sqrt(probability * (1 - probability) / DRAWS)
        assert abs(np.mean(values == count) - probability) < 5 * spread + 1e-12


def test_the_total_is_poissons(drawn):
    mean, counts = drawn
    totals = counts.sum((1, 2, 3))
    assert totals.mean() == pytest.approx(mean.sum(), abs=5 * np.sqrt(mean.sum() / DRAWS))
    assert totals.var() == pytest.approx(mean.sum(), rel=5 * np.sqrt(2 / DRAWS) * 1.1)


def test_many_pixels_in_single_precision_get_their_shares():
    mean = jnp.asarray(np.random.default_rng(2).random((500, 32, 32)) ** 6, "float32")
    mean = mean / mean.sum() * 2e5
    counts = np.asarray(sample_sparse_photons(jax.random.key(0), mean, room=room_for_photons(2e5)), float)
    expected = np.asarray(mean, float)
    for axes in ((1, 2), (0, 2), (0, 1)):
        pull = (counts.sum(axes) - expected.sum(axes)) / np.sqrt(expected.sum(axes))
        assert abs(pull).max() < 5
        assert np.mean(pull**2) == pytest.approx(1, abs=5 * np.sqrt(2 / pull.size))


@pytest.mark.parametrize("mean", [1e-3, 1.0, 30.0, 2e4])
def test_there_is_room_for_every_frame(mean):
    assert poisson.sf(room_for_photons(mean), mean) < 1e-14


def test_darkness_gives_nothing_and_no_room_is_refused():
    assert not sample_sparse_photons(jax.random.key(0), jnp.zeros((2, 3, 4)), room=10).any()
    with pytest.raises(SettingsError, match=r"mean_total: must be a positive number of photons, got 0"):
        room_for_photons(0.0)
