"""Whole turns that slip and come back, a step without bias, and the number that scores a wavefront."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.amplitude_constraint import FLOOR, LARGEST_FACTOR, modulus_factor
from nlcwfs.estimation.whole_turns import slip_filter, without_slips
from nlcwfs.simulation.score import wavefront_error_m

few = settings(max_examples=30, deadline=None)  # the first example compiles
seeds = st.integers(0, 2**32 - 1)
pistons = st.floats(-50, 50)

# ----------------------------------------------------------------------------------------- without_slips

PIXELS = Grid((60, 71), 8.0 / 45)
SMOOTH = jnp.asarray(slip_filter(PIXELS, diameter_m=8.0))
TURN = 2 * np.pi
RAD_ROUNDING = 1e-10  # of FFTs of numbers up to a few hundred


@jax.jit
def mended(phase_rad):
    return without_slips(phase_rad, SMOOTH)


def smooth_phase(seed: int, rms_rad: float) -> np.ndarray:
    """Waves of up to 2 cycles over 8 m, of which the filter misses (2 / 5)^4: 2.5 %."""
    rng = np.random.default_rng(seed)
    squared = np.fft.fftfreq(60, 8.0 / 45)[:, None] ** 2 + np.fft.fftfreq(71, 8.0 / 45) ** 2
    phase_rad = np.fft.ifft2(np.fft.fft2(rng.normal(size=PIXELS.shape)) * (squared < (2 / 8.0) ** 2)).real
    return phase_rad * rms_rad / phase_rad.std()


def slips(seed: int) -> np.ndarray:
    """Whole turns, one or two up or down, on one to four pixels in some of 25 cells of 12 x 14 pixels."""
    rng, turns = np.random.default_rng(seed), np.zeros(PIXELS.shape)
    for row, column in np.ndindex(5, 5):
        y, x = 12 * row + rng.integers(4), 14 * column + rng.integers(4)
        high, wide = rng.integers(1, 3, 2)
        single = high * wide == 1
        turns[y : y + high, x : x + wide] = rng.integers(2) * rng.choice([-2, -1, 1, 2] if single else [-1, 1])
    return turns * TURN


@few
@given(seed=seeds, rms_rad=st.floats(0, 15), piston_rad=pistons)
def test_a_smooth_phase_is_left_alone(seed, rms_rad, piston_rad):
    phase_rad = smooth_phase(seed, rms_rad) + piston_rad
    np.testing.assert_allclose(mended(phase_rad), phase_rad, atol=RAD_ROUNDING)


@few
@given(seed=seeds, rms_rad=st.floats(0, 15), piston_rad=pistons)
def test_slipped_groups_of_pixels_come_back(seed, rms_rad, piston_rad):
    phase_rad = smooth_phase(seed, rms_rad) + piston_rad
    found = mended(phase_rad + slips(seed + 1))
    np.testing.assert_allclose(found, phase_rad, atol=RAD_ROUNDING)
    np.testing.assert_allclose(mended(found), found, atol=RAD_ROUNDING)


def test_there_are_slips_to_bring_back():
    slipped = [np.mean(slips(seed) != 0) for seed in range(20)]
    assert min(slipped) > 0.002
    assert max(slipped) < 0.02


@few
@given(seed=seeds, rms_rad=st.floats(0, 10), piston_rad=pistons)
def test_only_whole_turns_are_taken_and_piston_goes_along(seed, rms_rad, piston_rad):
    """Whatever the phase, even one that no filter could know."""
    phase_rad = np.random.default_rng(seed).normal(0, rms_rad, PIXELS.shape)
    found = np.asarray(mended(phase_rad))
    turns = (found - phase_rad) / TURN
    np.testing.assert_allclose(turns, np.round(turns), atol=RAD_ROUNDING)
    raised = np.asarray(mended(phase_rad + piston_rad))
    # A pixel half a turn off may go either way by rounding.
    assert np.mean(abs(raised - found - piston_rad) > RAD_ROUNDING) < 1e-3


def test_groups_of_two_turns_side_by_side_come_back():
    """Found at 2e6 photons: up and down beside each other; what pulls at its neighbours has to go first."""
    found = """
        ..+++.......
        -.+2+.......
        ..+2.--.....
        ....-==-....
        ..---==-...-
        ...--==-...-
        .....--.....
    """
    worth = {".": 0, "+": 1, "2": 2, "-": -1, "=": -2}
    turns = np.zeros(PIXELS.shape)
    turns[10:17, 28:40] = [[worth[sign] for sign in line] for line in found.split()]
    for rms_rad in (0.0, 5.0):
        phase_rad = smooth_phase(3, rms_rad)
        np.testing.assert_allclose(mended(phase_rad + TURN * turns), phase_rad, atol=RAD_ROUNDING)


def test_a_step_wider_than_the_filter_stays():
    """A segment may be a turn off, and nobody can tell: it is not for the filter to move it."""
    y, x = np.indices(PIXELS.shape)
    segment = TURN * ((abs(y - 30) < 14) & (abs(x - 35) < 14))
    found = np.asarray(mended(segment.astype(float)))
    assert np.mean(found[18:43, 23:48] == TURN) > 0.9


def test_the_filter_is_a_fourth_order_low_pass_at_five_cycles():
    grid = Grid((40, 45), 0.2)
    expected = 1 / (1 + (np.hypot(grid.fy_per_m, grid.fx_per_m) * 8.0 / 5.0) ** 4)
    np.testing.assert_allclose(slip_filter(grid, diameter_m=8.0), expected[:, :23], rtol=1e-12)


# ------------------------------------------------------------------------- modulus_factor, at a photon a pixel


def mean_step(model, draws: int, *, known: bool, read_variance: float = 0.0, seed: int = 0) -> np.ndarray:
    """Mean and standard error of the step of every pixel, when the model is the truth."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(model, (draws, *model.shape)) + rng.normal(0, np.sqrt(read_variance), (draws, *model.shape))
    steps = modulus_factor(
        jnp.asarray(counts),
        jnp.broadcast_to(jnp.asarray(model), counts.shape),
        jnp.ones(counts.shape, bool),
        method="poisson",
        read_variance=read_variance,
        mean=jnp.full((draws, 1, 1), model.mean()),
        expected=jnp.broadcast_to(jnp.asarray(model), counts.shape) if known else None,
    )
    found = np.asarray(steps) - 1
    return np.array([found.mean(axis=0), found.std(axis=0) / np.sqrt(draws)])


@pytest.mark.parametrize("photons", [0.3, 3.0])
def test_with_the_noise_known_the_step_has_no_bias(photons):
    """But for the clip at three times the light, whose share is counted out: 0.011 at 0.3 photons."""
    model = photons * np.random.default_rng(1).uniform(0.5, 1.5, (5, 6))
    number = np.arange(60)[:, None, None]
    step = (number - model) / (2 * (model + FLOOR * model.mean()))
    clipped = np.clip(step, -1, LARGEST_FACTOR - 1)
    expected = np.sum(scipy.stats.poisson.pmf(number, model) * clipped, axis=0)
    mean, error = mean_step(model, 20000, known=True)
    assert np.all(abs(mean - expected) < 5 * error)
    assert np.max(abs(expected)) < 0.03
    assert abs(mean.mean()) < 0.015
    assert np.max(error) < 0.01


def test_with_the_noise_known_and_no_clip_there_is_no_bias_at_all():
    model = 0.3 * np.random.default_rng(1).uniform(0.5, 1.5, (5, 6))
    mean, error = mean_step(model, 20000, known=True, read_variance=4.0)
    assert np.all(abs(mean) < 5 * error)
    assert abs(mean.mean()) < 5 * np.sqrt(np.sum(error**2)) / mean.size
    assert np.max(error) < 0.002


def test_noise_guessed_from_the_count_itself_biases_the_step():
    """The reason for `expected`: a pixel without a photon counts as sure, one with a photon as noisy."""
    model = np.full((5, 6), 0.3)
    mean, _ = mean_step(model, 2000, known=False)
    numbers = np.arange(20)
    step = np.clip((numbers - 0.3) / (2 * ((numbers + 0.3) / 2 + FLOOR * 0.3)), -1, LARGEST_FACTOR - 1)
    expected = np.sum(scipy.stats.poisson.pmf(numbers, 0.3) * step)
    assert expected == pytest.approx(-0.33, abs=0.01)  # thirty times the other
    assert mean.mean() == pytest.approx(expected, abs=0.01)


@few
@given(seed=seeds)
def test_counts_that_stand_for_themselves_are_the_default(seed):
    rng = np.random.default_rng(seed)
    counts, model = rng.poisson(2.0, (2, 4, 5)) - 0.5, rng.exponential(2.0, (2, 4, 5))
    given_ = [jnp.asarray(counts), jnp.asarray(model), jnp.asarray(rng.uniform(size=counts.shape) > 0.2)]
    said = modulus_factor(*given_, method="poisson", expected=jnp.maximum(given_[0], 0))
    np.testing.assert_array_equal(said, modulus_factor(*given_, method="poisson"))


# ------------------------------------------------------------------------------------ wavefront_error_m

FRAME = Grid((14, 17), 0.6)
LIGHT = Grid((42, 51), 0.2)  # three cells to a pixel; the same centre
WAVELENGTH_M = 0.65e-6


def on(grid: Grid, function) -> np.ndarray:
    """Any wavefront y, x -> metres, on a grid."""
    return np.broadcast_to(function(grid.y_m, grid.x_m), grid.shape).astype(float)


def pupil_weights(seed: int) -> np.ndarray:
    """Light of no symmetry, three pixels away from the rim, where splines are not yet those of the inside."""
    weights = np.zeros(LIGHT.shape)
    weights[9:-9, 9:-9] = np.random.default_rng(seed).uniform(size=(24, 33))
    weights[9:18, 9:20] = 0
    return weights


def rms_m(difference_m: np.ndarray, weights: np.ndarray) -> float:
    mean = np.average(difference_m, weights=weights)
    return float(np.sqrt(np.average((difference_m - mean) ** 2, weights=weights)))


def score_m(estimate_m, truth_m, weights) -> float:
    return wavefront_error_m(estimate_m, FRAME, truth_m, weights, LIGHT)


def bumpy(y, x):
    """Smooth on the scale of the pixels, and of no symmetry."""
    return 1e-7 * (np.sin(0.7 * x + 0.3) + 0.6 * np.cos(0.5 * y - 0.4 * x) + 0.2 * y)


def test_the_same_wavefront_on_two_grids_has_no_error():
    error_m = score_m(on(FRAME, bumpy), on(LIGHT, bumpy), pupil_weights(1))
    assert 0 < error_m < 2e-3 * rms_m(on(LIGHT, bumpy), pupil_weights(1))  # splines: fourth order in 0.6 x 0.7 rad


@pytest.mark.parametrize("flipped", [np.s_[::-1], np.s_[:, ::-1], np.s_[::-1, ::-1]], ids=["y", "x", "both"])
def test_a_flipped_estimate_is_as_wrong_as_it_is(flipped):
    error_m = score_m(on(FRAME, bumpy)[flipped], on(LIGHT, bumpy), pupil_weights(1))
    expected = rms_m(on(LIGHT, bumpy)[flipped] - on(LIGHT, bumpy), pupil_weights(1))
    assert error_m == pytest.approx(expected, rel=2e-3)
    assert error_m > 0.5e-7


@few
@given(slope=st.tuples(*2 * [st.floats(-1e-6, 1e-6)]), piston_m=st.floats(-1e-3, 1e-3), seed=seeds)
def test_tilt_counts_and_piston_does_not(slope, piston_m, seed):
    def tilt(y, x):
        return slope[0] * y + slope[1] * x

    weights = pupil_weights(seed)
    error_m = score_m(on(FRAME, bumpy) + piston_m, on(LIGHT, lambda y, x: bumpy(y, x) - tilt(y, x)), weights)
    expected = rms_m(on(LIGHT, tilt), weights)
    assert abs(error_m - expected) < 3e-10  # what splines miss of the bumps


def test_a_whole_turn_is_an_error():
    """Nothing is wrapped: half the pupil a wavelength too high is half a wavelength rms, in truth or estimate."""
    weights = np.zeros(LIGHT.shape)
    weights[9:-9, 9:25] = weights[9:-9, 26:-9] = 1  # as much light left as right, none on the edge
    step = on(LIGHT, lambda y, x: np.where(x > 0, WAVELENGTH_M, 0.0) + 0 * y)
    assert score_m(np.zeros(FRAME.shape), step, weights) == pytest.approx(WAVELENGTH_M / 2, rel=1e-12)
    everywhere = score_m(np.full(FRAME.shape, WAVELENGTH_M), np.zeros(LIGHT.shape), weights)
    assert everywhere == pytest.approx(0, abs=1e-18)
    of_estimate = score_m(on(FRAME, lambda y, x: np.where(x > 0, WAVELENGTH_M, 0.0) + 0 * y), 0 * step, weights)
    assert of_estimate == pytest.approx(WAVELENGTH_M / 2, rel=0.06)  # the spline blurs the edge over a pixel of six


def test_what_the_pixels_cannot_show_is_an_error():
    """A ripple of a cell has no trace on the frame: all of it counts, and only where there is light."""
    ripple = 1e-7 * (-1.0) ** np.add.outer(np.arange(42), np.arange(51))
    weights = pupil_weights(2)
    error_m = score_m(np.zeros(FRAME.shape), ripple, weights)
    assert error_m == pytest.approx(rms_m(ripple, weights), rel=1e-12)
    assert error_m == pytest.approx(1e-7, rel=0.01)
    wild = np.where(weights > 0, ripple, 1.0)
    assert score_m(np.zeros(FRAME.shape), wild, 7 * weights) == pytest.approx(error_m, rel=1e-12)


def test_windows_of_odd_and_even_size_share_their_centre():
    """An estimate on 15 x 16 pixels, the light on 42 x 51 cells."""
    other = Grid((15, 16), 0.6)
    error_m = wavefront_error_m(on(other, bumpy), other, on(LIGHT, bumpy), pupil_weights(3), LIGHT)
    assert error_m < 2e-3 * rms_m(on(LIGHT, bumpy), pupil_weights(3))
