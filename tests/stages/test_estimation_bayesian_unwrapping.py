"""Unwrapping of turbulence drawn in NumPy: right to the last turn, with noise, gaps and pixels that lie."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.bayesian_unwrapping import unwrapped
from nlcwfs.estimation.whitened_phase import WhitenedPhase

SHAPE = (45, 50)  # odd and even, not square
DIAMETER = 34.0  # pixels
EXACT = 1e-9  # rounding: what is left after whole turns is the phase that was given


def frequency(shape: tuple[int, int]) -> np.ndarray:
    return np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))


def kolmogorov(shape: tuple[int, int], fried: float) -> np.ndarray:
    """Power of each wave where white noise has 1 (Noll 1976, eq. 21), Fried's parameter in pixels; no piston."""
    lowest = 0.5 / max(shape)
    return 0.0229 * fried ** (-5 / 3) * np.maximum(frequency(shape), lowest) ** (-11 / 3)


def turbulence(seed: int, fried: float) -> np.ndarray:
    """Cut from a screen three times as wide, which does not repeat itself in the window; with a tilt."""
    rng = np.random.default_rng(seed)
    size = (3 * SHAPE[0], 3 * SHAPE[1])
    waves = np.fft.fft2(rng.normal(size=size)) * np.sqrt(kolmogorov(size, fried))
    tilt = rng.normal(0, 0.3, 2)
    whole = np.fft.ifft2(waves).real[: SHAPE[0], : SHAPE[1]]
    return whole + tilt[0] * np.arange(SHAPE[0])[:, None] + tilt[1] * np.arange(SHAPE[1])


def pupil() -> np.ndarray:
    """An obstructed disc out of the middle, with a spider's leg."""
    y, x = np.arange(SHAPE[0])[:, None] - 21.0, np.arange(SHAPE[1]) - 26.5
    radius = np.hypot(y, x)
    lit = (radius < DIAMETER / 2) & (radius > DIAMETER / 8)
    lit[21, 27:] = False
    return lit


LIT = pupil()


def steepest(phase_rad: np.ndarray) -> float:
    down = abs(np.diff(phase_rad, axis=0))[LIT[1:] & LIT[:-1]]
    right = abs(np.diff(phase_rad, axis=1))[LIT[:, 1:] & LIT[:, :-1]]
    return max(down.max(), right.max())


@functools.cache
def compiled(fried: float):
    power = jnp.asarray(kolmogorov(SHAPE, fried)[:, : SHAPE[1] // 2 + 1])
    prior = WhitenedPhase.build(Grid(SHAPE, 1.0), power, tilt_rms_rad=5.0, diameter_m=DIAMETER)
    return jax.jit(lambda phase_rad: unwrapped(phase_rad, jnp.asarray(LIT), prior))


def wrapped(phase_rad: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * phase_rad))


def turns_off(found: np.ndarray, truth_rad: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The difference less its median: a piston is nobody's to know."""
    apart = (np.asarray(found) - truth_rad)[where]
    return apart - np.median(apart)


@pytest.mark.parametrize("seed", range(6))
def test_turbulence_is_unwrapped_exactly_where_neighbours_differ_by_less_than_pi(seed):
    truth_rad = turbulence(seed, fried=4.0)
    truth_rad *= min(1.0, 0.95 * np.pi / steepest(truth_rad))
    given_rad = np.where(LIT, wrapped(truth_rad + 2.0), np.random.default_rng(seed).uniform(-3, 3, SHAPE))
    assert np.ptp(truth_rad[LIT]) > 3 * np.pi  # several turns
    found = compiled(4.0)(jnp.asarray(given_rad))
    np.testing.assert_allclose(turns_off(found, truth_rad, LIT), 0, atol=EXACT)


@pytest.mark.parametrize("seed", range(6))
def test_noise_passes_and_takes_no_turn_with_it(seed):
    """0.5 rad in every pixel: 100 photons would do better. What comes out is what was given, noise and all."""
    truth_rad = turbulence(seed, fried=6.0) + np.random.default_rng(100 + seed).normal(0, 0.5, SHAPE)
    found = compiled(6.0)(jnp.asarray(wrapped(truth_rad)))
    assert np.mean(abs(turns_off(found, truth_rad, LIT)) > EXACT) == 0


@pytest.mark.parametrize("seed", range(4))
def test_pixels_that_lie_cost_nothing_but_themselves(seed):
    """One in five holds any phase at all. Least squares without doubt takes up to a fifth of the others along."""
    rng = np.random.default_rng(200 + seed)
    truth_rad = turbulence(seed, fried=6.0)
    lies = rng.uniform(size=SHAPE) < 1 / 5
    given_rad = np.where(lies, rng.uniform(-np.pi, np.pi, SHAPE), wrapped(truth_rad))
    found = compiled(6.0)(jnp.asarray(given_rad))
    np.testing.assert_allclose(turns_off(found, truth_rad, LIT & ~lies), 0, atol=EXACT)


def test_a_torn_phase_is_mended_on_the_far_side_of_the_tear():
    """A cut from the rim to the middle, a whole turn deep: the turbulence has no such step, so the light has none."""
    truth_rad = turbulence(9, fried=8.0)
    above = np.zeros(SHAPE)
    above[:21, 27:] = 2 * np.pi
    found = np.asarray(compiled(8.0)(jnp.asarray(truth_rad + above)))
    np.testing.assert_allclose(turns_off(found, truth_rad, LIT), 0, atol=EXACT)


def test_beyond_the_pupil_the_phase_goes_on_smoothly():
    truth_rad = turbulence(3, fried=6.0)
    wild = np.random.default_rng(1).uniform(-3, 3, SHAPE)
    found, also = (
        np.asarray(compiled(6.0)(jnp.asarray(np.where(LIT, wrapped(truth_rad), dark)))) for dark in (0.0, wild)
    )
    np.testing.assert_allclose(found, also, atol=EXACT)  # nobody looks there
    across_rim = np.abs(np.diff(found, axis=1))[LIT[:, 1:] != LIT[:, :-1]]
    assert np.median(across_rim) < 1.0
    assert np.median(across_rim) > 1e-3
