"""The integrator does what its difference equation says, and is refused where that diverges."""

import jax.numpy as jnp
import numpy as np
import pytest
from feedback_loops import closed_loop
from scipy.signal import lfilter

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.integrator import Integrator, largest_stable_gain
from nlcwfs.feedback.loop_transfer import IntegratorLoop


def integrator(*gains: float, latency_frames: float = 0.0, leak: float = 1.0, pseudo_open_loop: bool = False):
    loop = IntegratorLoop(latency_frames, leak, pseudo_open_loop)
    return Integrator.build(np.array(gains), loop=loop, dtype="float64")


def reference(air, noise, *, gain, leak, latency_frames, pseudo_open_loop):
    """Residuals of one mode, by the equations of the package docstring, in plain Python."""
    whole, part = int(latency_frames), latency_frames % 1
    commands, residuals = [0.0] * (whole + 2), []
    for here, error in zip(air, noise, strict=True):
        mean = (1 - part) * commands[-1 - whole] + part * commands[-2 - whole]
        residuals.append(here - mean)
        seen = residuals[-1] + error
        commands.append(leak * commands[-1] + gain * (seen + mean - commands[-1] if pseudo_open_loop else seen))
    return np.array(residuals)


@pytest.mark.parametrize("pseudo_open_loop", [False, True])
@pytest.mark.parametrize("latency_frames", [0.0, 0.4, 1.0, 1.7])
def test_a_loop_follows_its_equations(latency_frames, pseudo_open_loop):
    rng = np.random.default_rng(7)
    air, noise = rng.normal(size=(40, 2)).cumsum(0), rng.normal(size=(40, 2))
    options = {"leak": 0.93, "latency_frames": latency_frames, "pseudo_open_loop": pseudo_open_loop}
    residual, _ = closed_loop(integrator(0.3, 0.6, **options), air, noise)
    for mode, gain in enumerate((0.3, 0.6)):
        expected = reference(air[:, mode], noise[:, mode], gain=gain, **options)
        np.testing.assert_allclose(residual[:, mode], expected, atol=1e-12)  # rounding of 40 sums


def test_noise_of_an_integrator_without_latency_is_g_over_2_less_g():
    gains = np.array([0.2, 0.5, 1.0, 1.4])
    noise = np.random.default_rng(1).normal(size=(200_000, 4))
    residual, _ = closed_loop(integrator(*gains), np.zeros_like(noise), noise)
    variance = residual[200:].var(0)
    # 5 sigma of a variance from samples that are correlated over (1 + q^2) / (1 - q^2) frames, with q = 1 - g
    correlated = (1 + (1 - gains) ** 2) / (1 - (1 - gains) ** 2)
    assert np.all(abs(variance / (gains / (2 - gains)) - 1) < 5 * np.sqrt(2 * correlated / len(noise)))


@pytest.mark.parametrize(("latency_frames", "pseudo_open_loop"), [(0.0, False), (0.4, False), (1.3, True)])
def test_a_leak_leaves_its_share_of_what_stands_still(latency_frames, pseudo_open_loop):
    """u = l u + g (a - u), so that a - u = a (1 - l) / (1 - l + g)."""
    leak, gain = 0.9, 0.4
    controller = integrator(gain, latency_frames=latency_frames, leak=leak, pseudo_open_loop=pseudo_open_loop)
    residual, _ = closed_loop(controller, np.full((300, 1), 5.0))
    assert abs(residual[-1, 0] - 5.0 * (1 - leak) / (1 - leak + gain)) < 1e-12  # rounding; the rest died out


@pytest.mark.parametrize("latency_frames", [0.0, 0.4, 1.0, 2.7])
def test_a_step_is_corrected_once_when_the_delay_is_known(latency_frames):
    residual, command = closed_loop(
        integrator(1.0, latency_frames=latency_frames, pseudo_open_loop=True), np.full((12, 1), 3.0)
    )
    np.testing.assert_allclose(command, 3.0, atol=1e-14)  # the first command is the answer, and it stays
    whole, part = int(latency_frames), latency_frames % 1
    expected = np.zeros(12)
    expected[: whole + 1] = 3.0
    expected[whole + 1] = 3.0 * part
    np.testing.assert_allclose(residual[:, 0], expected, atol=1e-14)


def test_the_same_step_overshoots_when_the_delay_is_not_known():
    residual, _ = closed_loop(integrator(0.95, latency_frames=1.0), np.full((12, 1), 3.0))
    assert residual.min() < -1.5  # the second command corrects again what the first one has not yet reached


# ---------------------------------------------------------------------------------------------- stability


def grows(gain, *, latency_frames, leak):
    """Whether a bump is larger after thousands of frames; the loop as a filter, not as its roots."""
    whole, part = int(latency_frames), latency_frames % 1
    below = np.zeros(whole + 3)
    below[:2] = 1, -leak
    below[-2:] += gain * (1 - part), gain * part
    bump = lfilter([1.0], below, np.r_[1.0, np.zeros(3000)])
    return np.max(abs(bump[-100:])) > np.max(abs(bump[1000:1100]))


@pytest.mark.parametrize("leak", [1.0, 0.9])
@pytest.mark.parametrize("latency_frames", [0.0, 0.1, 0.4, 0.5, 1.0, 1.7, 2.0, 4.5])
def test_the_limit_parts_gains_that_forget_from_gains_that_grow(latency_frames, leak):
    limit = largest_stable_gain(latency_frames, leak=leak)
    options = {"latency_frames": latency_frames, "leak": leak}
    # Up to 0.99 of the limit a bump decays by more than rounding in 2000 frames; every tenth on the way is tried, so
    # that the limit is the first one.
    assert not any(grows(share * limit, **options) for share in [*np.arange(0.1, 1, 0.1), 0.99])
    assert grows(1.01 * limit, **options)


@pytest.mark.parametrize("whole", [0, 1, 2, 3, 10])
def test_the_limit_of_whole_latencies_is_levin_and_mays(whole):
    assert abs(largest_stable_gain(float(whole)) / (2 * np.sin(np.pi / (4 * whole + 2))) - 1) < 1e-9  # fifty halvings


def test_an_unstable_gain_is_refused_and_the_way_out_is_named():
    with pytest.raises(SettingsError, match=r"feedback\.gain: must be below 1 for a latency of 1 frames without feed"):
        integrator(0.3, 1.0, latency_frames=1.0)
    with pytest.raises(SettingsError, match=r"must be below 2 for a latency of 0 frames without .*, got 2"):
        integrator(2.0)
    with pytest.raises(SettingsError, match=r"must be below 1\.9 for a latency of 3 frames, got 1\.9"):
        integrator(1.9, latency_frames=3.0, leak=0.9, pseudo_open_loop=True)
    integrator(1.0, latency_frames=1.0, pseudo_open_loop=True)


# -------------------------------------------------------------------------------------------- lost exposures


def test_a_skipped_exposure_leaves_the_command_and_its_leak():
    controller = integrator(0.4, 0.8, leak=0.9, latency_frames=1.0, pseudo_open_loop=True)
    state, command = controller.step(controller.init(), jnp.array([1.0, -2.0]))
    state, kept = controller.skip(state)
    np.testing.assert_allclose(kept, 0.9 * command, atol=1e-15)
    np.testing.assert_array_equal(state.line.newest_m, kept)
    np.testing.assert_array_equal(state.line.after_m, command)
