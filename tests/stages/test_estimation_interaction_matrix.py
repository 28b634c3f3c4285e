"""Derivatives of a signal along modes, and the signals themselves; expected values from NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.errors import SettingsError
from nlcwfs.estimation.image_signals import NormalisedCounts, NormalisedDifferences, lit_pixels
from nlcwfs.estimation.interaction_matrix import linearised

RANDOM = np.random.default_rng(4)
AMPLITUDE = RANDOM.uniform(0.2, 1, size=(5, 6))  # odd and even, no symmetry
REFERENCE = RANDOM.normal(size=(5, 6))
SHAPES = RANDOM.normal(size=(140, 5, 6))  # more than one batch


def far_light(phase):
    far = jnp.fft.fft2(jax.lax.complex(AMPLITUDE * jnp.cos(phase), AMPLITUDE * jnp.sin(phase)))
    return (far.real**2 + far.imag**2).ravel()


def test_derivatives_around_a_rough_reference_are_those_of_calculus():
    """d|F E|^2 = 2 Re conj(F E) F(i E d phi), by NumPy."""
    found = linearised(far_light, jnp.asarray(REFERENCE), SHAPES)
    field = AMPLITUDE * np.exp(1j * REFERENCE)
    far = np.fft.fft2(field)
    wanted = [2 * (far.conj() * np.fft.fft2(1j * field * shape)).real.ravel() for shape in SHAPES]
    np.testing.assert_allclose(found.signal, np.abs(far.ravel()) ** 2, rtol=1e-9)
    np.testing.assert_allclose(found.interaction, np.transpose(wanted), atol=1e-9 * np.max(np.abs(wanted)))


def test_counts_are_in_units_of_the_flux_and_dark_pixels_are_left_out():
    mean = np.array([[[4.0, 0.0, 2.0]], [[1.0, 1e-6, 3.0]]])
    counts = NormalisedCounts.of_light(mean)
    seen = np.array([[[40.0, 7.0, 10.0]], [[20.0, 9.0, 30.0]]])
    found = counts.of(jnp.asarray(seen), jnp.asarray(seen != 10.0))
    np.testing.assert_allclose(found, [40 / 90, 0, 20 / 90, 30 / 90], rtol=1e-6)
    np.testing.assert_allclose(counts.variance(100 * mean, 2.0), (100 * np.array([4, 2, 1, 3]) + 2) / 1000**2)
    dark = counts.of(jnp.zeros((2, 1, 3)), jnp.ones((2, 1, 3), bool))
    assert not np.asarray(dark).any()


def test_differences_are_of_planes_at_the_same_distance():
    """Two pairs in any order; a flipped sign of z flips the signal."""
    mean = np.ones((4, 1, 2))
    curvature = NormalisedDifferences.of_light(mean, (800.0, -2000.0, -800.0, 2000.0), read_variance=3.0)
    seen = np.array([[[9.0, 1.0]], [[5.0, 2.0]], [[3.0, 4.0]], [[11.0, 6.0]]])
    found = curvature.of(jnp.asarray(seen), jnp.ones(seen.shape, bool))
    near, far = (seen[0] - seen[2]) / (seen[0] + seen[2] + 4), (seen[3] - seen[1]) / (seen[3] + seen[1] + 4)
    np.testing.assert_allclose(found, np.concatenate([near, far]).ravel(), rtol=1e-6)
    broken = curvature.of(jnp.asarray(seen), jnp.asarray(seen != 11.0))
    np.testing.assert_allclose(broken, [*near.ravel(), 0, far[0, 1]], rtol=1e-6)


def test_the_noise_of_differences_is_that_of_photons():
    """Drawn photons and read noise; the formula is of the mean sum, right to 5 % from 20 electrons on."""
    mean, read = np.array([[[30.0, 90.0]], [[50.0, 20.0]]]), 4.0
    curvature = NormalisedDifferences.of_light(mean, (1.0, -1.0), read_variance=read)
    random = np.random.default_rng(2)
    drawn = random.poisson(mean, (20000, *mean.shape)) + 2 * random.normal(size=(20000, *mean.shape))
    after, before = drawn[:, 0, 0], drawn[:, 1, 0]
    spread = np.var((after - before) / (after + before + 5), axis=0)
    np.testing.assert_allclose(curvature.variance(mean, read), spread, rtol=0.06)


def test_planes_that_are_no_pairs_are_refused():
    with pytest.raises(SettingsError, match=r"linear_curvature\.distances_km: must be pairs, at \+z and at -z"):
        NormalisedDifferences.of_light(np.ones((2, 1, 1)), (1e6, -2e6), read_variance=0.0)


def test_nearly_all_light_is_on_the_lit_pixels():
    light = RANDOM.exponential(size=(2, 7, 9)) ** 3
    lit = lit_pixels(light)
    assert 0.999 <= light[lit].sum() / light.sum() < 1
    assert light[lit].min() > light[~lit].max()
