"""Steps of segments as unknowns: adjoint, fit, and the prior and scores that use them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.segments import Segment, Segments
from nlcwfs.estimation.bayesian_unwrapping import unwrapped
from nlcwfs.estimation.segment_steps import SegmentSteps
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase
from nlcwfs.simulation.segment_score import segment_score

GRID = Grid((40, 48), 0.2)
DISCS = Segments((Segment(-1.2, -2.4, 3.0), Segment(1.1, 1.7, 4.0), Segment(-2.4, 1.8, 2.2)))
LABELS, PUPIL = DISCS.labels(GRID), DISCS.amplitude(GRID)


@pytest.fixture(scope="module")
def steps():
    return SegmentSteps.build(GRID, PUPIL**2, LABELS, piston_rms_rad=3.0, tilt_rms_rad=0.7)


@pytest.fixture(scope="module")
def prior(steps):
    power = jnp.asarray(1 / (0.1 + np.add.outer(np.fft.fftfreq(40) ** 2, np.fft.rfftfreq(48) ** 2)))
    return WhitenedPhase.build(GRID, power, tilt_rms_rad=2.0, diameter_m=8.0, steps=steps)


def test_a_unit_tilt_has_the_rms_of_nolls(steps):
    for number, width_m in enumerate((3.0, 4.0, 2.2)):
        one = jnp.zeros(9).at[3 + number].set(1.0)
        ramp = np.asarray(steps.phase_rad(one))
        own = (number == LABELS) * PUPIL**2
        wanted = np.where(number == LABELS, 0.7 * 4 / width_m * (GRID.y_m - DISCS.parts[number].y_m), 0)
        np.testing.assert_allclose(ramp[own > 0.9], wanted[own > 0.9], atol=0.03 * 1.4)
        # 4 %: the light of rim cells is the square of their amplitude.
        assert np.sqrt((own * ramp**2).sum() / own.sum()) == pytest.approx(0.7, rel=0.04)


def test_the_whole_cell_has_the_whole_piston(steps):
    """Antialiasing is for the amplitude: a rim cell with a tenth of the light has all of the step."""
    phase = np.asarray(steps.phase_rad(jnp.array([1.0, -2.0, 0.5, 0, 0, 0, 0, 0, 0])))
    np.testing.assert_array_equal(phase, np.choose(LABELS, [3.0, -6.0, 1.5]))


def test_transposed_is_the_adjoint_of_the_prior(prior):
    keys = jax.random.split(jax.random.key(1), 4)
    waves = jax.random.normal(keys[0], (40, 25)).astype(complex) + 1j * jax.random.normal(keys[1], (40, 25)).astype(
        complex
    )
    waves = waves.at[:, 0].set(jnp.fft.rfft2(jax.random.normal(keys[0], (40, 48)), norm="ortho")[:, 0])
    waves = waves.at[:, -1].set(jnp.fft.rfft2(jax.random.normal(keys[1], (40, 48)), norm="ortho")[:, -1])
    unknown = Unknown(waves, jax.random.normal(keys[2], (11,)))
    gradient = jax.random.normal(keys[3], (40, 48))
    along = jnp.sum(gradient * prior.phase_rad(unknown))
    back = prior.dot(prior.transposed(gradient), unknown)
    assert float(back) == pytest.approx(float(along), rel=1e-10)  # rounding of two FFTs


def test_a_start_holds_the_phase_that_it_was_given(prior):
    rng = np.random.default_rng(5)
    smooth = 0.5 * np.cos(2 * np.pi * (GRID.x_m / 6 + GRID.y_m / 9))
    phase = smooth + np.choose(LABELS, [2.0, -5.0, 9.0]) + np.choose(LABELS, [0.2, 0.0, -0.3]) * GRID.y_m
    phase = phase + 1e-6 * rng.normal(size=phase.shape)
    made = np.asarray(prior.phase_rad(prior.start(jnp.asarray(phase), noise_variance=1e-9)))
    lit = PUPIL**2 > 0.3
    np.testing.assert_allclose(made[lit], phase[lit], atol=1e-3)


def test_unwrapping_keeps_each_segment_whole_whatever_its_step(prior):
    ramp = np.choose(LABELS, [2.5, -2.0, 3.0]) * (GRID.x_m - np.choose(LABELS, [-2.4, 1.7, 1.8]))
    phase = ramp + np.choose(LABELS, [3.1, -3.1, 1.0])  # at the cut of the wrap
    wrapped = jnp.asarray(np.angle(np.exp(1j * phase)))
    lit = PUPIL**2 > 0.3
    found = np.asarray(unwrapped(wrapped, jnp.asarray(lit), prior))
    for number in range(3):
        own = lit & (number == LABELS)
        difference = (found - phase)[own]
        assert np.ptp(difference) < 1e-6  # one constant: nothing inside is a turn off
        assert difference[0] / (2 * np.pi) == pytest.approx(round(difference[0] / (2 * np.pi)), abs=1e-6)


def test_scores_part_steps_from_what_is_inside():
    rng = np.random.default_rng(2)
    weights = PUPIL**2
    lam = 650e-9
    ripple = 4e-9 * rng.normal(size=LABELS.shape)
    error_m = np.choose(LABELS, [0.0, 2 * lam + 30e-9, -lam]) + ripple
    score = segment_score(error_m, weights, LABELS, wavelength_m=lam)
    light = np.bincount(LABELS.ravel(), weights.ravel()) / weights.sum()
    means = np.array([np.average(ripple[n == LABELS], weights=weights[n == LABELS]) for n in range(3)])
    steps_m = np.array([0.0, 2 * lam + 30e-9, -lam]) + means
    spread = np.sqrt(np.sum(light * (steps_m - np.sum(light * steps_m)) ** 2))
    folded = np.array([0.0, 30e-9, 0.0]) + means
    assert score.piston_m == pytest.approx(spread, rel=1e-9)
    assert score.piston_modulo_m == pytest.approx(
        np.sqrt(np.sum(light * (folded - np.sum(light * folded)) ** 2)), rel=1e-6
    )
    inside = np.sqrt(sum(np.sum((weights * (ripple - means[n]) ** 2)[n == LABELS]) for n in range(3)) / weights.sum())
    assert score.inside_m == pytest.approx(inside, rel=1e-9)
    assert score.straightened_m < score.inside_m
    assert score.turns == (0, 2, -1)


def test_a_piston_of_the_whole_pupil_never_counts_and_pixels_without_truth_neither():
    error_m = np.where(LABELS == 1, np.nan, 5e-6)
    score = segment_score(error_m, PUPIL**2, LABELS, wavelength_m=650e-9)
    for one in (score.piston_m, score.piston_modulo_m, score.inside_m, score.straightened_m):
        assert one == pytest.approx(0.0, abs=1e-18)
    assert np.isnan(segment_score(np.full((40, 48), np.nan), PUPIL, LABELS, wavelength_m=1.0).piston_m)


def test_a_half_wave_apart_is_half_a_wave_whichever_way():
    error_m = np.choose(LABELS, [325e-9, -325e-9, 325e-9])
    score = segment_score(error_m, PUPIL**2, LABELS, wavelength_m=650e-9)
    assert score.piston_modulo_m == pytest.approx(0.0, abs=1e-12)  # 650 nm apart is one turn
