"""Phase and log-amplitude as unknowns, and the counts they make: against NumPy, whatever the pupil and the numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from tests.laws.test_map_laws import (
    POLYNOMIAL,
    ROUNDING,
    Sensor,
    blocks,
    cases,
    few,
    half,
    numbers,
    random_power,
    seeds,
    shapes,
    travelled,
    white_unknown,
    whitened,
)

from nlcwfs.estimation.complex_phase import ComplexPhase
from nlcwfs.estimation.sensor_model import mean_counts
from nlcwfs.estimation.whitened_phase import Unknown


def prior_and_power(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[ComplexPhase, np.ndarray]:
    power = random_power(rng, shape)
    return ComplexPhase(whitened(random_power(rng, shape)), jnp.asarray(np.sqrt(half(power)))), power


@few
@given(seed=seeds, shape=shapes)
def test_a_log_amplitude_drawn_white_has_its_power_and_the_phase_is_as_it_would_be_alone(seed, shape):
    rng = numbers(seed)
    both, power = prior_and_power(rng, shape)
    phase, _ = white_unknown(rng, shape)
    amplitude, noise = white_unknown(rng, shape)
    unknown = Unknown(jnp.stack([phase.waves, amplitude.waves]), phase.slope)
    found = np.asarray(both.phase_rad(unknown))
    waves = np.fft.ifft2(np.fft.fft2(noise) * np.sqrt(power)).real
    np.testing.assert_allclose(found[1], waves, atol=ROUNDING)
    np.testing.assert_array_equal(found[0], both.phase.phase_rad(phase))
    alone = float(both.phase.dot(phase, phase))
    assert float(both.dot(unknown, unknown)) == pytest.approx(alone + np.sum(noise**2), rel=1e-12)  # Parseval
    np.testing.assert_array_equal(both.phase_rad(both.start(phase)), found * np.array([1, 0])[:, None, None])


@few
@given(seed=seeds, shape=shapes)
def test_the_transpose_of_the_complex_phase_is_its_adjoint(seed, shape):
    rng = numbers(seed)
    both, _ = prior_and_power(rng, shape)
    size = (2, *half(np.zeros(shape)).shape)
    waves = rng.normal(size=size) + 1j * rng.normal(size=size)
    unknown, image = Unknown(jnp.asarray(waves), jnp.asarray(rng.normal(size=2))), rng.normal(size=(2, *shape))
    there = float(np.sum(np.asarray(both.phase_rad(unknown)) * image))
    back = float(both.dot(unknown, both.transposed(jnp.asarray(image))))
    assert there == pytest.approx(back, abs=1e-10)  # the sums of 400 products of size 10 cancel
    assert abs(there) > 1e-6


class Twinkling(Sensor):
    """A random sensor whose light has a random log-amplitude of 0.3 nepers, in NumPy."""

    def __init__(self, seed, shape, oversampling):
        super().__init__(seed, shape, oversampling)
        self.both = np.stack([self.phase_rad, self.rng.normal(0, 0.3, self.cells)])

    def seen_through(self, both: np.ndarray) -> np.ndarray:
        near = self.pupil * np.exp(both[1] + 1j * both[0])
        far = travelled(near / np.sqrt(np.sum(abs(near) ** 2)), 0.2 / self.oversampling)
        light = blocks(abs(far) ** 2, self.oversampling)
        return self.counts[:, None, None] * light + self.background[:, None, None]


@eqx.filter_jit
def _linearised(level, scale, both, change, weights):
    counts, along = jax.linearize(lambda both: mean_counts(level, scale, both), both)
    return counts, along(change), jax.linear_transpose(along, both)(weights)[0]


def linearised(case: Twinkling, change: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    given = (jnp.asarray(one) for one in (case.both, change, weights))
    return [np.asarray(one) for one in _linearised(case.level, case.scale, *given)]


@few
@cases
def test_counts_are_those_of_the_amplitude_and_total_light_is_no_part_of_it(seed, shape, oversampling):
    case = Twinkling(seed, shape, oversampling)
    nothing = np.zeros_like(case.both), np.zeros((3, *shape))
    counts, _, _ = linearised(case, *nothing)
    np.testing.assert_allclose(counts, case.seen_through(case.both), atol=POLYNOMIAL * counts.max())
    assert np.max(abs(counts - case.seen_through(case.both * [[[1]], [[-1]]]))) > 0.01 * counts.max()
    case.both = case.both + np.array([0.0, 0.7])[:, None, None]  # twice the light of each star
    brighter, _, _ = linearised(case, *nothing)
    np.testing.assert_allclose(brighter, counts, atol=1e-11 * counts.max())


@few
@cases
def test_the_jacobian_of_both_is_that_of_finite_differences_and_its_transpose_the_adjoint(seed, shape, oversampling):
    """Central differences of the light in NumPy."""
    case = Twinkling(seed, shape, oversampling)
    change, weights = case.rng.normal(size=case.both.shape), case.rng.normal(size=(3, *shape))
    _, found, back = linearised(case, change, weights)
    step = 1e-5  # its cube leaves 1e-10 of the change, rounding 1e-11
    ahead, behind = (case.seen_through(case.both + sign * step * change) for sign in (1, -1))
    np.testing.assert_allclose(found, (ahead - behind) / (2 * step), atol=2 * POLYNOMIAL * abs(found).max())
    size = float(np.linalg.norm(found) * np.linalg.norm(weights))
    assert np.sum(found * weights) == pytest.approx(np.sum(change * back), abs=1e-13 * size)
    assert abs(found).max() > 1
    assert np.linalg.norm(back[:, case.pupil == 0]) == 0  # where no light is, no count knows
