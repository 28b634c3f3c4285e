"""Kalman's filter of the lenslets: a textbook's gain, less error than the integrator, and what it does without wind."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from small_loop import small

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.moving_modes import Step, carried, displaced_covariance
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.feedback.controller import Telemetry
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop.carried_spots import CarriedSpots, CarriedSpotsState, settled_gain
from nlcwfs.simulation.closed_loop.lenslets import FollowedSpots
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, loop_bounds, run_loop
from nlcwfs.simulation.closed_loop.spots_air import coarser

LENSLETS = ("loop.sensor=shack-hartmann", "shack_hartmann.subapertures=10", "shack_hartmann.pixels=16")
CARRIED = (*LENSLETS, "feedback.controller=kalman", "loop.learn_after_s=0.2", "loop.seconds=0.4")
PLAIN = (*LENSLETS, "loop.seconds=0.4")
LEARNT = 110
"""By this exposure the wind is known."""


@functools.cache
def ran(*overrides: str) -> tuple[Loop, LoopTelemetry]:
    loop = Loop.build(small(*overrides))
    _, records = run_loop(loop)
    return loop, LoopTelemetry.of(records)


def textbook(
    again: np.ndarray, new: np.ndarray, slopes: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gain and covariance after many rounds of prediction and update (Kalman 1960), with one inverse for each."""
    covariance = np.eye(len(again))
    for _ in range(3000):
        covariance = again @ covariance @ again.T + new
        gain = covariance @ slopes.T @ np.linalg.inv(slopes @ covariance @ slopes.T + noise)
        covariance = (np.eye(len(again)) - gain @ slopes) @ covariance
    return gain, covariance


def test_the_gain_is_that_of_a_textbook():
    """Seven modes, five slopes, noise that is common to some: 1e-6 for rounding over 3000 rounds."""
    random = np.random.default_rng(11)
    again = random.normal(size=(7, 7))
    again *= 0.97 / np.abs(np.linalg.eigvals(again)).max()
    half, common = random.normal(size=(7, 7)), random.normal(size=(5, 2))
    slopes, own = random.normal(size=(5, 7)), random.uniform(0.2, 2.0, size=5)
    found = settled_gain(Step(again, half @ half.T), slopes, noise_rad2=own, finer_rad2=common @ common.T)
    gain, left = textbook(again, half @ half.T, slopes, common @ common.T + np.diag(own))
    np.testing.assert_allclose(found.gain, gain, atol=1e-6 * np.abs(gain).max())
    np.testing.assert_allclose(found.left_m2, left, atol=1e-6 * np.abs(left).max())


def test_larger_cells_have_the_same_covariance():
    """Modes of 8 and more of the larger cells a cycle, at an odd move. Means over cells leave sinc^4 of the variance of
    a wave, 0.9 at 8: 12 %. A mode after a move is right to 5 %, for what it loses now it loses later."""
    grid, air = Grid((61, 63), 0.04), Turbulence(0.2)
    pupil = (np.hypot(grid.y_m / 1.1, grid.x_m / 1.2) < 1.0).astype(float)
    basis = modal_basis(pupil, grid, diameter_m=2.4, count=40)
    coarse, large = coarser(basis, grid)
    times = large.pixel_m / grid.pixel_m
    assert times == round(times)
    assert 4 <= 2.4 / large.pixel_m / float(basis.cycles_per_aperture[-1]) < 8
    both = []
    for modes, pixel_m in ((basis, grid.pixel_m), (coarse, large.pixel_m)):
        now, later = (displaced_covariance(modes, pixel_m, air, [move]) for move in ((0.0, 0.0), (0.07, -0.1)))
        both.append((now, carried(now, later).again))
    (wanted, moved), (found, found_moved) = both
    slow = np.asarray(basis.cycles_per_aperture) <= 2.4 / large.pixel_m / 8
    assert 5 < slow.sum() < 40
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert np.abs((found - wanted) / scale)[np.ix_(slow, slow)].max() < 0.12
    rms = np.sqrt(np.diag(wanted))
    assert np.abs((found_moved - moved) * rms[None, :] / rms[:, None])[np.ix_(slow, slow)].max() < 0.05


def test_it_leaves_less_than_the_integrator():
    """The same air and photons, the same numbers until it has learnt; from 0.05 s after that on."""
    loop, told = ran(*CARRIED)
    _, plain = ran(*PLAIN)
    assert isinstance(loop.measurement, CarriedSpots)
    np.testing.assert_array_equal(told.rms_nm[:100], plain.rms_nm[:100])
    mine, theirs = (np.sqrt(np.mean(one.rms_nm[LEARNT + 25 :] ** 2)) for one in (told, plain))
    assert float(loop_bounds(loop.light)["fitting_nm"]) < mine < 0.8 * theirs


def test_the_error_is_what_it_expects():
    """Of the modes that the mirror makes, an exposure ahead. Half of it is in the slow modes below 4 cycles, of which
    65 exposures of one sky hold few independent moments: 40 % either way."""
    loop, told = ran(*CARRIED)
    sensor = loop.measurement
    assert isinstance(sensor, CarriedSpots)
    gain = sensor.air.gain(sensor.followed.noise_rad2(sensor.followed.begun, 2e6 / 500))
    step, seen = sensor.air.step, np.asarray(sensor.seen, float)
    ahead_m2 = seen @ (step.again @ gain.left_m2 @ step.again.T + step.new) @ seen.T
    found_nm = np.sqrt(np.mean(np.sum(told.group_nm[LEARNT + 25 :, :4] ** 2, axis=1)))
    assert 0.7 < found_nm / (1e9 * np.sqrt(np.trace(ahead_m2))) < 1.4


def test_the_wind_is_found():
    """10 m/s towards +x; 3 % is what a parabola through the peak of a correlation tells on 20 cells."""
    loop, _ = ran(*CARRIED)
    assert isinstance(loop.measurement, CarriedSpots)
    wind = loop.measurement.wind
    assert wind.x_m_per_s == pytest.approx(10, abs=0.3)
    assert wind.y_m_per_s == pytest.approx(0, abs=0.3)


def test_without_a_clear_wind_it_goes_on_as_an_integrator():
    """Telemetry of white noise: no wind is in it, and the next exposures are those of the integrator."""
    plain = Loop.build(small(*LENSLETS, "loop.seconds=0.03"))
    loop = Loop.build(small(*LENSLETS, "loop.seconds=0.03", "feedback.controller=kalman"))
    noise_m = 1e-7 * np.random.default_rng(5).normal(size=(100, loop.light.mirror.count))
    loop.learn(Telemetry(measured_m=noise_m, mirror_m=0 * noise_m))
    assert isinstance(loop.measurement, FollowedSpots)
    (_, wanted), (_, found) = run_loop(plain), run_loop(loop)
    np.testing.assert_array_equal([one.rms_nm for one in found], [one.rms_nm for one in wanted])
    assert wanted[-1].rms_nm < 0.5 * wanted[0].rms_nm


def test_while_exposures_are_lost_the_wind_goes_on():
    """The command that is due is that of the modes as they are carried; single precision."""
    loop, _ = ran(*CARRIED)
    sensor = loop.measurement
    assert isinstance(sensor, CarriedSpots)
    modes_m = 1e-7 * np.random.default_rng(2).normal(size=len(sensor.again))
    none = jnp.zeros((0, 0), jnp.float32)
    memory = CarriedSpotsState(jnp.asarray(modes_m, jnp.float32), none[None], none, 0.0, 9)
    command_m, after = sensor.skip(memory)
    assert command_m is not None
    again, ahead = np.asarray(sensor.again, float), np.asarray(sensor.ahead, float)
    carried_m = again @ modes_m
    np.testing.assert_allclose(after.modes_m, carried_m, atol=1e-5 * np.abs(carried_m).max())
    np.testing.assert_allclose(command_m, ahead @ carried_m, atol=1e-5 * np.abs(command_m).max())
    assert np.abs(carried_m - modes_m).max() > 1e-8


def test_an_exposure_in_the_dark_moves_nothing_but_the_wind():
    loop, _ = ran(*CARRIED)
    sensor, state = loop.measurement, loop.init()
    assert isinstance(sensor, CarriedSpots)
    memory = CarriedSpotsState(
        jnp.asarray(1e-7 * np.random.default_rng(3).normal(size=len(sensor.again)), jnp.float32),
        sensor.followed.begun,
        jnp.ones(sensor.interaction.shape[::-1], jnp.float32),
        1e-8,
        9,
    )
    flat_m = jnp.zeros_like(loop.light.weights)
    exposure = loop.light.expose(jnp.asarray(0, jnp.int32), state.control.line, state.image, flat_m).exposure
    dark = eqx.tree_at(lambda one: one.frames.electrons, exposure, 0 * exposure.frames.electrons)
    sight, after = sensor.measure(dark, jnp.ones(dark.frames.electrons.shape, bool), flat_m, memory)
    command_m, wanted = sensor.skip(memory)
    assert sight.outcome == Outcome.NO_LIGHT
    assert isinstance(after, CarriedSpotsState)
    np.testing.assert_array_equal(after.modes_m, wanted.modes_m)
    np.testing.assert_array_equal(sight.command_m, command_m)
    np.testing.assert_array_equal(after.spot, memory.spot)


def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path):
    settings = (*CARRIED, "loop.seconds=0.26")
    config = small(*settings)
    _, whole = run_loop(Loop.build(config))
    folder_of.prepare_folder(tmp_path / "run", config, resume=False)

    def stop(state, records):
        if len(records) == LEARNT + 15:
            folder_of.write_checkpoint(tmp_path / "run", config, state, records)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_loop(Loop.build(config), watch=stop)
    stopped = folder_of.read_checkpoint(tmp_path / "run", config)
    assert stopped is not None
    state, records = stopped
    assert isinstance(state.memory, CarriedSpotsState)
    _, resumed = run_loop(Loop.build(config), state=state, records=records)
    assert [one.rms_nm for one in resumed] == [one.rms_nm for one in whole]
    assert len(resumed) == 130


def test_other_sensors_without_a_filter_are_told():
    with pytest.raises(SettingsError, match=r"feedback\.controller: filters the air of loop\.sensor = shack-hartmann"):
        Loop.build(small("loop.sensor=ideal", "feedback.controller=kalman"))
