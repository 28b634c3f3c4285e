"""The linear reconstructor, its test and its range, on images whose answers are known."""

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.estimation.image_matrix import FACTORS, LEAST_CHI2, Residuals, image_matrix, linear_range
from nlcwfs.estimation.image_signals import NormalisedCounts
from nlcwfs.estimation.interaction_matrix import Linearised
from nlcwfs.estimation.loop_reconstructor import LoopModes
from nlcwfs.estimation.slopes_to_modes import minimum_variance

RANDOM = np.random.default_rng(8)
PIXELS, MODES, DRIVEN, ELECTRONS = 60, 9, 6, 1e6
BASE = RANDOM.uniform(0.5, 1.5, size=PIXELS)
BASE /= BASE.sum()
PATTERNS = RANDOM.normal(size=(PIXELS, MODES)) * BASE[:, None] * 1e5
PATTERNS -= PATTERNS.mean(axis=0)  # no mode makes light
KNOWN = LoopModes(PATTERNS, np.where(np.arange(MODES) < DRIVEN, 1e-14, 1e-16), np.full(DRIVEN, 1e-17))


def made(bend=lambda x: x, electrons=ELECTRONS, closed=True):
    def images(modes_m, seed):
        return electrons * (BASE + BASE * bend(PATTERNS @ modes_m / BASE)).reshape(2, 5, 6)

    counts = NormalisedCounts(np.arange(PIXELS))
    return image_matrix(counts, Linearised(BASE, PATTERNS), KNOWN, Residuals(images, 0.0), closed=closed)


def test_the_open_matrix_has_the_minimum_variance():
    """Photon noise alone is left of linear images; the same as one solution for all modes at once."""
    found = made(closed=False)
    noise = BASE / ELECTRONS
    wanted = minimum_variance(PATTERNS, prior_m2=KNOWN.open_m2, noise_rad2=noise, keep=DRIVEN)
    np.testing.assert_allclose(found.matrix, wanted.matrix, atol=0.03 * np.abs(wanted.matrix).max())
    # 3 %: photon noise is that of the mean over 24 drawn images, 3 % of contrast each


def test_linear_images_have_no_end_of_their_range_and_the_test_is_one():
    found = made()
    assert found.range.limit_m == pytest.approx(found.range.rms_m[-1])
    assert max(found.range.missed) < 0.01  # single precision
    random = np.random.default_rng(3)
    usable, told = jnp.ones((2, 5, 6), bool), []
    left_m = found.range.rms_m[0] / np.sqrt(DRIVEN)
    for _ in range(200):
        modes_m = np.concatenate([random.normal(size=DRIVEN) * left_m, random.normal(size=3) * 1e-8])
        counts = jnp.asarray(random.poisson(ELECTRONS * (BASE + PATTERNS @ modes_m)).reshape(2, 5, 6), jnp.float32)
        modes = found.modes_m(counts, usable)
        told.append([float(found.chi2(counts, usable, modes)), *(np.asarray(modes) - modes_m[:DRIVEN])])
    chi2, errors_m = np.array(told)[:, 0], np.array(told)[:, 1:]
    assert np.mean(chi2) == pytest.approx(1, abs=0.2)  # the expectation is of six tries of 54 degrees of freedom: 8 %
    assert np.sqrt(np.mean(errors_m**2) * DRIVEN) < 1.2 * found.predicted_m


def test_light_that_no_mode_makes_fails_the_test():
    found, usable = made(), jnp.ones((2, 5, 6), bool)
    odd = ELECTRONS * BASE * (1 + 0.2 * np.sign(RANDOM.normal(size=PIXELS)))
    counts = jnp.asarray(odd.reshape(2, 5, 6), jnp.float32)
    assert float(found.chi2(counts, usable, found.modes_m(counts, usable))) > 5 * found.range.limit_chi2


def test_the_range_ends_where_the_images_bend():
    """Images that show tanh(x / s) s: NumPy's linear answer, and how far it is off, at each size."""
    found = made(lambda x: 0.004 * np.tanh(x / 0.004))
    rms_m = np.array(found.range.rms_m)
    assert found.range.missed[0] < 0.4 < 0.6 < found.range.missed[-1]
    last = np.flatnonzero(np.array(found.range.missed) <= 0.5)[-1]
    assert rms_m[last] <= found.range.limit_m < rms_m[min(last + 1, len(rms_m) - 1)] * (1 + 1e-9)
    np.testing.assert_allclose(rms_m / rms_m[0], FACTORS)


def test_a_range_without_an_estimate_that_serves_is_empty():
    sizes = np.array([1.0, 2.0])
    assert linear_range(sizes, np.array([0.6, 0.9]), np.ones(2), np.ones(2)).limit_m == 0
    whole = linear_range(sizes, np.array([0.1, 0.2]), np.array([1.0, 5.0]), np.ones(2))
    assert (whole.limit_m, whole.limit_chi2) == (2.0, 5.0)
    assert linear_range(sizes, np.array([0.1, 0.2]), np.ones(2), np.ones(2)).limit_chi2 == LEAST_CHI2
