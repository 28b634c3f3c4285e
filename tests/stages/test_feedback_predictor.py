"""Prediction comes to the bound that Kalman's filter sets, and copes with what has no model."""

import numpy as np
import pytest
from feedback_loops import closed_loop, first_order, first_order_spectrum

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.integrator import Integrator
from nlcwfs.feedback.loop_transfer import IntegratorLoop, mirror_transfer
from nlcwfs.feedback.predictor import Predictor, prediction_taps


def predictor(modes: int, *, order: int, latency_frames: float = 0.0, gain: float = 0.4) -> Predictor:
    loop = IntegratorLoop(latency_frames, 1.0, True)
    return Predictor(Integrator.build(np.full(modes, gain), loop=loop, dtype="float64"), order)


def kalman_bound(*, correlation: float, noise_variance: float, horizon: int) -> float:
    """Variance of the best prediction of an AR(1) process of variance 1 that is seen in white noise."""
    new = 1 - correlation**2
    # p = c^2 p r / (p + r) + q, the stationary equation of Riccati, is a quadratic one
    half = (noise_variance * (1 - correlation**2) - new) / 2
    once = -half + np.sqrt(half**2 + new * noise_variance)
    for _ in range(horizon - 1):
        once = correlation**2 * once + new
    return once


@pytest.mark.parametrize(
    ("correlation", "noise_variance"), [(0.99, 0.01), (0.99, 0.1), (0.9, 0.5), (0.5, 0.2), (-0.6, 0.1)]
)
@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_first_order_process_is_predicted_to_kalmans_bound(correlation, noise_variance, latency):
    rng = np.random.default_rng(4)
    frames, modes = 20_000, 20

    def air_and_noise():
        air = first_order(rng, correlation=correlation, frames=frames, modes=modes)
        return air, np.sqrt(noise_variance) * rng.normal(size=(frames, modes))

    learnt = predictor(modes, order=15, latency_frames=float(latency)).learn(sum(air_and_noise()))
    residual, _ = closed_loop(learnt, *air_and_noise())  # other air of the same kind
    expected = kalman_bound(correlation=correlation, noise_variance=noise_variance, horizon=1 + latency)
    # 15 taps learnt from 20000 frames cost 0.1 %, what they forget (0.64^30) nothing; the residual is known to
    # sqrt(2 * memory / 4e5), 1.6 % for the slowest at the longest horizon.
    assert abs(residual[50:].var() / expected - 1) < 0.03


def test_prediction_beats_the_best_integrator_where_there_is_inertia():
    """A wave of 100 frames and a vibration: an integrator lags, and amplifies what is fast."""
    rng = np.random.default_rng(8)
    order, noise_rms, waves = 20, 0.05, ((1.0, 1 / 100), (0.3, 1 / 4.3))
    time = np.arange(9000)[:, None]
    air = sum(size * np.cos(2 * np.pi * (time * per_frame + rng.random(20))) for size, per_frame in waves)
    noise = noise_rms * rng.normal(size=air.shape)
    learnt = predictor(20, order=order, latency_frames=1.0).learn((air + noise)[:6000])
    left = closed_loop(learnt, air, noise)[0][6000:].var()
    # Wiener: what is left is C(0) - c R^-1 c, with R the covariance of the last measurements and c that with the air
    # two frames later
    lag = np.arange(order + 2)
    covariance = sum(size**2 / 2 * np.cos(2 * np.pi * lag * per_frame) for size, per_frame in waves)
    seen = covariance[abs(lag[:order, None] - lag[None, :order])] + noise_rms**2 * np.eye(order)
    expected = covariance[0] - covariance[2:] @ np.linalg.solve(seen, covariance[2:])
    # 20 taps learnt from 6000 frames cost 20 / 6000 of the noise, 1 % of what is left; 6e4 values with a memory of 20
    # frames are known to 5 sigma = 10 %, less by the waves, which are the same all the time.
    assert -0.05 < left / expected - 1 < 0.06
    gains = np.linspace(0.02, 1.5, 60)
    integrators = Integrator.build(gains, loop=IntegratorLoop(1.0, 1.0, True), dtype="float64")
    best = closed_loop(integrators, air[:, :1] * np.ones(60), noise[:, :1] * np.ones(60))[0][6000:].var(0).min()
    assert best > 10 * left


@pytest.mark.parametrize("latency_frames", [0.4, 1.7])
def test_a_part_of_a_frame_is_predicted_and_the_residual_is_that_of_the_spectrum(latency_frames):
    rng = np.random.default_rng(6)
    frames, modes, correlation = 20_000, 20, 0.97
    air = first_order(rng, correlation=correlation, frames=frames, modes=modes)
    noise = 0.2 * rng.normal(size=air.shape)
    learnt = predictor(modes, order=12, latency_frames=latency_frames).learn(air + noise)
    residual, _ = closed_loop(learnt, air, noise)
    frequency = (np.arange(20_000) + 0.5) / 20_000
    late = np.exp(-2j * np.pi * frequency[:, None] * np.arange(1, 13)) @ np.asarray(learnt.taps)
    mirror = mirror_transfer(frequency[:, None], latency_frames=latency_frames) * late
    air_power = first_order_spectrum(frequency, correlation=correlation)[:, None]
    expected = np.mean(abs(1 - mirror) ** 2 * air_power + 0.04 * abs(mirror) ** 2)
    assert abs(residual[50:].var() / expected - 1) < 0.03  # 4e5 values with a memory of some 10 frames: 5 sigma
    # between the bounds of the whole latencies around it, since it sees no less and no more
    whole = [
        kalman_bound(correlation=correlation, noise_variance=0.04, horizon=int(latency_frames) + more)
        for more in (1, 2)
    ]
    assert whole[0] < expected < whole[1]


def test_taps_are_those_of_least_squares_with_weights():
    rng = np.random.default_rng(3)
    series, order, forgetting = rng.normal(size=(90, 2)).cumsum(0), 3, 0.97
    taps = prediction_taps(series, order=order, latency_frames=1.25, forgetting=forgetting)
    for mode in range(2):
        rows, wanted = [], []
        for now in range(order - 1, 90 - 3):
            share = np.sqrt(forgetting ** (90 - 4 - now))
            rows.append(share * series[now - np.arange(order), mode])
            wanted.append(share * (0.75 * series[now + 2, mode] + 0.25 * series[now + 3, mode]))
        expected = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
        np.testing.assert_allclose(taps[:, mode], expected, atol=1e-4)  # the ridge, over the part of white noise


def test_what_stands_still_is_predicted_to_stand_still():
    learnt = predictor(2, order=4, latency_frames=2.0).learn(np.full((100, 2), [3.0, 0.0]))
    residual, command = closed_loop(learnt, np.full((30, 2), [3.0, 0.0]))
    np.testing.assert_allclose(command[10:], np.full((20, 2), [3.0, 0.0]), atol=1e-6)  # the ridge, 1e-7
    np.testing.assert_allclose(residual[13:], 0, atol=1e-6)


def test_until_it_has_learnt_and_seen_enough_it_is_the_integrator():
    rng = np.random.default_rng(9)
    air = rng.normal(size=(12, 2)).cumsum(0)
    unlearnt = predictor(2, order=5, latency_frames=1.0)
    _, plain = closed_loop(unlearnt.fallback, air)
    _, before = closed_loop(unlearnt, air)
    np.testing.assert_array_equal(before, plain)
    learnt = unlearnt.learn(rng.normal(size=(200, 2)).cumsum(0))
    _, after = closed_loop(learnt, air)
    np.testing.assert_array_equal(after[:4], plain[:4])
    expected = np.einsum("tm,tm->m", learnt.taps, air[4::-1])  # the fifth exposure and those before it
    np.testing.assert_allclose(after[4], expected, atol=1e-12)


def test_a_bump_is_gone_when_it_has_been_seen_and_forgotten():
    """No feedback in a predictor whose mirror is known: after the order and the delay nothing is left."""
    learnt = predictor(1, order=5, latency_frames=1.4).learn(np.random.default_rng(1).normal(size=(400, 1)).cumsum(0))
    air = np.zeros((40, 1))
    air[10] = 1.0
    residual, _ = closed_loop(learnt, air)
    assert np.max(abs(residual[11:18])) > 0.05
    np.testing.assert_allclose(residual[18:], 0, atol=1e-12)


def test_a_lost_exposure_is_bridged_by_the_prediction():
    turn = np.cos(0.1 * np.arange(400))[:, None]
    learnt = predictor(1, order=4).learn(turn)
    state = learnt.init()
    for number in range(20):
        state, _ = learnt.step(state, turn[number] - state.line.mean_m)
    state, _ = learnt.skip(state)
    state, command = learnt.step(state, turn[21] - state.line.mean_m)
    assert abs(float(command[0]) - turn[22, 0]) < 1e-3  # the ridge; the wave moves by 0.1 a frame


def test_too_few_frames_are_refused_with_how_many_would_do():
    series = np.random.default_rng(1).normal(size=(52, 2))
    with pytest.raises(SettingsError, match=r"open_loop_m: must be at least 52 frames for 10 taps, got 51"):
        prediction_taps(series[:51], order=10, latency_frames=1.5)
    assert prediction_taps(series, order=10, latency_frames=1.5).shape == (10, 2)
