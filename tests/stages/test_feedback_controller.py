"""One interface: every controller is linear, learns from what it has recorded, and goes on from where it was."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from feedback_loops import closed_loop, first_order
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.controller import Controller, Telemetry
from nlcwfs.feedback.integrator import Integrator
from nlcwfs.feedback.loop_transfer import IntegratorLoop
from nlcwfs.feedback.modal_gains import optimal_gains
from nlcwfs.feedback.settings import FeedbackSettings

RATE_HZ = 500.0
CONTROLLERS = ["integrator", "modal-gains", "predictive"]


def controller(modes: int = 3, **options) -> Controller:
    return Controller.build(FeedbackSettings(**options), modes, RATE_HZ, dtype="float64")


def recorded(seed: int = 1, *, frames: int = 300, modes: int = 3) -> Telemetry:
    """Air and noise, part of which a mirror has taken away."""
    rng = np.random.default_rng(seed)
    seen = first_order(rng, correlation=0.98, frames=frames, modes=modes) + rng.normal(size=(frames, modes)) / 3
    mirror = rng.normal(size=seen.shape)
    return Telemetry(jnp.asarray(seen - mirror), jnp.asarray(mirror))


def learnt(name: str, **options) -> Controller:
    return controller(controller=name, prediction_order=4, **options).learn(recorded())


def mixed(one, other, factors):
    """Sum of two states and measurements; what counts exposures is no number of metres."""
    return jax.tree.map(
        lambda a, b: factors[0] * a + factors[1] * b if jnp.issubdtype(a.dtype, jnp.floating) else a, one, other
    )


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    factors=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    latency_frames=st.sampled_from([0.0, 0.4, 2.5]),
    name=st.sampled_from(CONTROLLERS),
    frames=st.integers(0, 4),
)
def test_a_step_is_linear(seed, factors, latency_frames, name, frames):
    one = learnt(name, latency_frames=latency_frames)
    rng = np.random.default_rng(seed)

    def drawn(leaf):
        random = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.asarray(rng.normal(size=leaf.shape)) if random else jnp.asarray(frames, leaf.dtype)

    inputs = [jax.tree.map(drawn, (one.init(), jnp.zeros(3))) for _ in range(2)]
    apart = mixed(*(one.step(*each) for each in inputs), factors)
    together = one.step(*mixed(*inputs, factors))
    for got, expected in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)  # rounding of numbers up to about 100


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("latency_frames", [0.0, 0.4, 2.0])
def test_until_it_learns_a_controller_is_the_integrator(name, latency_frames):
    air = np.random.default_rng(2).normal(size=(30, 3)).cumsum(0)
    options = {"gain": 0.6, "leak": 0.98, "latency_frames": latency_frames}
    loop = IntegratorLoop(latency_frames, 0.98, pseudo_open_loop=True)
    _, plain = closed_loop(Integrator.build(np.full(3, 0.6), loop=loop, dtype="float64"), air)
    _, command = closed_loop(controller(controller=name, **options), air)
    np.testing.assert_array_equal(command, plain)


def loop(one: Controller, air: np.ndarray, state=None):
    """The loop as a simulation runs it: residuals, what it recorded, and the state that it leaves."""
    state = one.init() if state is None else state
    step = eqx.filter_jit(one.step)
    measured, mirror = [], []
    for here in air:
        mirror.append(state.line.mean_m)
        measured.append(jnp.asarray(here) - mirror[-1])
        state, _ = step(state, measured[-1])
    return np.array(measured), Telemetry(jnp.array(measured), jnp.array(mirror)), state


@pytest.mark.parametrize("name", ["modal-gains", "predictive"])
@pytest.mark.parametrize("latency_frames", [0.0, 1.3])
def test_a_closed_loop_teaches_what_an_open_one_does(name, latency_frames):
    air = recorded(frames=400).open_loop_m
    one = controller(controller=name, gain=0.3, latency_frames=latency_frames)
    _, telemetry, _ = loop(one, air)
    np.testing.assert_allclose(telemetry.open_loop_m, air, atol=1e-14)  # rounding
    closed, opened = one.learn(telemetry), one.learn(Telemetry(air, np.zeros_like(air)))
    weights = [each.law.taps if name == "predictive" else each.law.gain for each in (closed, opened)]
    np.testing.assert_allclose(*weights, rtol=1e-6, atol=1e-9)  # rounding of the best of a flat bottom
    assert np.max(abs(np.asarray(weights[0]) - 0.3)) > 0.05  # it has learnt


@pytest.mark.parametrize("name", ["modal-gains", "predictive"])
def test_it_learns_without_letting_go_and_is_better_for_it(name):
    rng = np.random.default_rng(7)
    noisy = np.array([0.05, 0.5, 2.0])
    air = first_order(rng, correlation=0.99, frames=6000, modes=3) + noisy * rng.normal(size=(6000, 3))
    one = controller(controller=name, gain=1.0, latency_frames=1.0)
    before, telemetry, state = loop(one, air[:3000])
    wiser = one.learn(telemetry)
    after, _, _ = loop(wiser, air[3000:], state)
    # What is measured is the residual and noise, of which at gain 1 the noise is doubled. The first exposures after the
    # change are no worse either: the mirror is where it was.
    assert np.all(after[:2] == loop(one, air[3000:3002], state)[0][:2])  # these commands were on their way
    assert np.all(after[2:].var(0)[1:] < 0.8 * before.var(0)[1:])
    assert after[2:].var(0)[0] < 1.05 * before.var(0)[0]
    assert np.max(abs(after[2:12])) < np.max(abs(before[100:]))


def test_only_the_last_training_frames_count():
    telemetry = recorded(frames=300)
    one = controller(controller="modal-gains", training_frames=100)
    expected = optimal_gains(telemetry.open_loop_m[-100:], loop=one.law.loop).gain
    np.testing.assert_allclose(one.learn(telemetry).law.gain, expected, rtol=1e-12)  # rounding
    assert controller().learn(telemetry).law.gain.tolist() == [1.0, 1.0, 1.0]  # there is nothing to learn


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_wave_in_hertz_is_rejected_as_told(name):
    one = learnt(name, latency_frames=1.4, gain=0.35)
    angle = 2 * np.pi * 31.0 / RATE_HZ * np.arange(3000)
    residual, _ = closed_loop(one, np.cos(angle)[:, None] * np.ones(3))
    expected = one.rejection_transfer(np.array([31.0]))
    assert expected.shape == (1, 3)
    # the start has died out: (1 - 0.02)^2000, 0.02 being the least gain that is learnt here
    np.testing.assert_allclose(residual[2000:], (np.exp(1j * angle)[:, None] * expected).real[2000:], atol=1e-8)
    np.testing.assert_allclose(one.noise_transfer(np.array([31.0])), 1 - expected, atol=1e-12)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_single_precision_follows_double_precision(name):
    air = 1e-7 * np.random.default_rng(2).normal(size=(50, 3)).cumsum(0)
    double = learnt(name, latency_frames=0.4)
    single = jax.tree.map(lambda leaf: leaf.astype("float32"), double)
    state, commands = single.init(), []
    for here in air:
        state, command = single.step(state, jnp.asarray(here, "float32") - state.line.mean_m)
        assert command.dtype == jnp.float32
        commands.append(command)
    _, expected = closed_loop(double, air)
    # 6e-8 of the largest command, a few dozen times
    np.testing.assert_allclose(np.array(commands), expected, atol=1e-5 * np.max(abs(expected)))


# --------------------------------------------------------------------------------------------- what is refused


def test_a_gain_that_its_latency_does_not_bear_is_refused():
    with pytest.raises(SettingsError, match=r"feedback\.gain: must be below 1 for a latency of 1 frames without"):
        controller(latency_frames=1.0, pseudo_open_loop=False)
    controller(latency_frames=1.0)


@pytest.mark.parametrize(("modes", "rate_hz"), [(0, 500.0), (3, 0.0), (3, float("nan"))])
def test_a_loop_without_modes_or_rate_is_refused(modes, rate_hz):
    with pytest.raises(SettingsError, match="rate_hz and modes: must be positive"):
        Controller.build(FeedbackSettings(), modes, rate_hz)


@pytest.mark.parametrize("name", ["modal-gains", "predictive"])
def test_too_little_telemetry_is_refused(name):
    with pytest.raises(SettingsError, match=r"open_loop_m: must be at least \d+ frames"):
        controller(controller=name).learn(recorded(frames=40))


@pytest.mark.parametrize(
    "wrong",
    [
        {"gain": 0.0},
        {"gain": 2.1},
        {"gain": float("nan")},
        {"gains": 1.0},
        {"leak": 1.01},
        {"latency_frames": -0.1},
        {"latency_frames": 10.5},
        {"controller": "pid"},
        {"forgetting": 0.0},
        {"prediction_order": 0},
    ],
    ids=str,
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        FeedbackSettings(**wrong)
