"""An ideal loop leaves what the air did in the meantime: closed forms of the lag of one exposure, and another package.

Exposure n lasts from n to n + 1. Without noise, at gain 1, the mirror is for one exposure at the mean of the air over
the exposure before; the loops are simulated in small steps of time, within which air and mirror move.
"""

import equinox as eqx
import hcipy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad

from nlcwfs.feedback.controller import Controller
from nlcwfs.feedback.settings import FeedbackSettings

RATE_HZ = 500.0


def residual_in_time(air: np.ndarray, **options) -> np.ndarray:
    """Air less mirror, `[exposure, substep, mode]`, of a loop that measures means over exposures."""
    controller = Controller.build(FeedbackSettings(**options), air.shape[2], RATE_HZ, dtype="float64")
    moment = (np.arange(air.shape[1]) + 0.5)[:, None] / air.shape[1]

    def expose(state, air):
        shape = jnp.where(jnp.asarray(moment < state.line.share_before), state.line.before_m, state.line.after_m[None])
        residual = air - shape
        state, _ = controller.step(state, residual.mean(0))
        return state, residual

    _, residual = eqx.filter_jit(lambda air: jax.lax.scan(expose, controller.init(), air))(jnp.asarray(air))
    return np.asarray(residual)


@pytest.mark.parametrize("latency_frames", [0.0, 0.4, 1.0])
def test_a_wave_of_the_air_is_left_as_its_way_in_the_meantime_says(latency_frames):
    """Mean square over time of exp(iwt) less its mean, s exp(iw/2), of 1 + L exposures before: 1 + s^2 - 2 s^2 cos."""
    turn = np.array([0.02, 0.3, 0.9, 2.2, 4.0])  # radians per exposure
    steps, exposures = 50, 2000
    time = ((np.arange(exposures * steps) + 0.5) / steps).reshape(exposures, steps, 1)
    both = [residual_in_time(wave(time * turn), latency_frames=latency_frames) for wave in (np.cos, np.sin)]
    left = np.mean(both[0][10:] ** 2 + both[1][10:] ** 2, (0, 1))
    seen = np.sin(turn / 2) / (turn / 2)
    expected = 1 + seen**2 - 2 * seen**2 * np.cos(turn * (1 + latency_frames))
    # Sums for integrals over an exposure: (w / 50)^2 / 12 of 1, less than 1e-3 of each of these
    np.testing.assert_allclose(left, expected, rtol=2e-3)


def kolmogorov_in_time(rng, *, steps: int, exposures: int, points: int) -> np.ndarray:
    """Frozen Kolmogorov air that passes over points: a random path with D(t) = t^(5/3), t in exposures.

    Its increments are stationary; they are drawn exactly by embedding their covariance in a circle (Davies & Harte
    1987, Biometrika 74, 95).
    """
    count = steps * exposures
    lag = np.arange(count + 1.0)
    covariance = (abs(lag + 1) ** (5 / 3) + abs(lag - 1) ** (5 / 3) - 2 * lag ** (5 / 3)) / 2 * steps ** (-5 / 3)
    power = np.fft.fft(np.r_[covariance, covariance[-2:0:-1]]).real
    assert power.min() > 0
    white = rng.normal(size=(2, points, 2 * count))
    drawn = np.fft.fft(np.sqrt(power / (2 * count)) * (white[0] + 1j * white[1]))[:, :count].real
    path = np.cumsum(drawn, axis=1)
    return path.T.reshape(exposures, steps, points)


def structure(air: np.ndarray, exposures: int) -> float:
    """D that was drawn; Kolmogorov's air forgets slowly, and 300 exposures of 400 points scatter by 1.5 %."""
    return float(np.mean((air[exposures:] - air[:-exposures]) ** 2))


def mean_structure(shift: float) -> float:
    """Mean of D between the moments of two exposures, the second `shift` later."""
    return dblquad(lambda first, second: abs(shift + first - second) ** (5 / 3), 0, 1, 0, 1)[0]


# Over what was drawn of D at the same lag: 1.000 with a scatter of 0.08 to 0.18 % from seed to seed (16 of them); 5
# sigma. Sums of 16 for integrals change these by 0.1 %.
DRAWN = 0.01


def test_frozen_kolmogorov_air_leaves_its_structure_function_over_one_exposure():
    air = kolmogorov_in_time(np.random.default_rng(3), steps=16, exposures=300, points=400)
    drawn = structure(air, 1)
    assert abs(drawn - 1) < 0.075  # D(1 exposure) = 1, 5 sigma
    residual = residual_in_time(air)[5:]
    # E (a(t) - mean of the exposure before)^2, and the same for the mean of a over its exposure. They are 0.992 and
    # 0.890: within one percent the lag is that of one exposure, from middle to middle.
    at_a_time = mean_structure(1) - mean_structure(0) / 2
    of_means = mean_structure(1) - mean_structure(0)
    assert abs(at_a_time - 0.992) < 1e-3
    assert abs(np.mean(residual**2) / drawn / at_a_time - 1) < DRAWN
    assert abs(np.mean(residual.mean(1) ** 2) / drawn / of_means - 1) < DRAWN


def test_a_latency_of_one_frame_leaves_the_structure_function_over_two():
    air = kolmogorov_in_time(np.random.default_rng(4), steps=16, exposures=300, points=400)
    residual = residual_in_time(air, latency_frames=1.0)[5:]
    drawn = structure(air, 2) / 2 ** (5 / 3)
    expected = mean_structure(2) - mean_structure(0) / 2
    assert abs(np.mean(residual**2) / drawn / expected - 1) < DRAWN


@pytest.mark.parametrize("latency", [0, 1])
def test_the_ideal_loop_of_hcipy_leaves_the_same(latency):
    """HCIPy's `lag` counts from exposure to exposure: 1 is the least that a loop can do, our latency 0."""
    grid = hcipy.make_pupil_grid(24, 1.1)
    modes = hcipy.make_zernike_basis(9, 1.1, grid, starting_mode=2)

    def air():
        return hcipy.InfiniteAtmosphericLayer(
            grid, hcipy.Cn_squared_from_fried_parameter(0.1, 500e-9), 20.0, [7.0, 4.0], seed=12
        )

    theirs, wind = hcipy.ModalAdaptiveOpticsLayer(air(), modes, lag=latency + 1), air()
    project = hcipy.inverse_tikhonov(modes.transformation_matrix, 1e-7)
    settings = FeedbackSettings(latency_frames=float(latency))
    controller = Controller.build(settings, 9, RATE_HZ, dtype="float64")
    state = controller.init()
    for number in range(12):
        if number:  # a new layer is at time 0, and HCIPy has measured it there
            theirs.evolve_until(number / RATE_HZ)
            wind.evolve_until(number / RATE_HZ)
        expected = project.dot(theirs.phase_for(1.0))
        residual = jnp.asarray(project.dot(wind.phase_for(1.0))) - state.line.mean_m
        if number > latency:
            np.testing.assert_allclose(residual, expected, atol=1e-9 * np.max(abs(wind.phase_for(1.0))))  # rounding
        state, _ = controller.step(state, residual)
    assert np.max(abs(expected)) > 1e-3 * np.max(abs(project.dot(wind.phase_for(1.0))))
