"""Kalman's filter in a loop: the wind is found in what was recorded, and latency costs hardly anything any more."""

import functools

import numpy as np
import pytest
from small_loop import SMALL, small

from nlcwfs.config import load_config
from nlcwfs.errors import SettingsError
from nlcwfs.feedback.controller import Telemetry
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop import air as loop_air
from nlcwfs.simulation.closed_loop.carried import CarriedCurvature, CarriedState
from nlcwfs.simulation.closed_loop.flow import filtered_basis
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, loop_bounds, run_loop

KALMAN = ("feedback.controller=kalman", "loop.learn_after_s=0.15", "loop.seconds=0.36")
UNTOLD = [setting for setting in SMALL if not setting.startswith("estimation.seeing_arcsec")]
LEARNT = 90
"""By this exposure, of 2 ms, the filter is at work."""


@functools.cache
def ran(*overrides: str) -> tuple[Loop, LoopTelemetry]:
    loop = Loop.build(small(*overrides))
    _, records = run_loop(loop)
    return loop, LoopTelemetry.of(records)


def rms_nm(told: LoopTelemetry, first: int = LEARNT + 20) -> float:
    return float(np.sqrt(np.mean(told.rms_nm[first:] ** 2)))


@pytest.mark.parametrize("latency", [0.0, 1.0, 1.5])
def test_it_finds_the_wind_and_leaves_less_than_any_integrator(latency):
    """The floor of an integrator holds the lag of one exposure; with latency it lags by more."""
    loop, told = ran(*KALMAN, f"feedback.latency_frames={latency:g}")
    assert isinstance(loop.measurement, CarriedCurvature)
    found = loop.measurement.wind
    assert np.hypot(found.x_m_per_s - 10, found.y_m_per_s) < 0.5  # of 10 m/s towards +x
    bounds = loop_bounds(loop.light)
    assert bounds["fitting_nm"] < rms_nm(told) < bounds["floor_nm"]
    measured = told.outcome[LEARNT:]
    assert np.all(np.isin(measured, [0, 1]))


def test_latency_hardly_matters():
    prompt, late = (rms_nm(ran(*KALMAN, f"feedback.latency_frames={frames:g}")[1]) for frames in (0.0, 1.5))
    assert late < 1.04 * prompt


def test_what_it_expects_of_itself_is_what_it_errs():
    """Error of the mirror's own modes: less than the whole, and not less than half of it."""
    _, told = ran(*KALMAN, "feedback.latency_frames=0")
    own = np.sqrt(np.mean(np.sum(told.group_nm[LEARNT + 20 :, :4] ** 2, axis=1)))
    expected = np.median(told.predicted_nm[LEARNT + 20 :])
    assert 0.4 * expected < own < 1.3 * expected


@pytest.mark.parametrize("fault", ["nan-frames", "lost-frames", "dead-plane", "bump"])
def test_it_survives(fault):
    """20 ms of trouble while the air is carried; 80 ms later it is near where it was."""
    _, told = ran(
        *KALMAN,
        "feedback.latency_frames=0",
        f"loop.fault={fault}",
        "loop.fault_at_s=0.22",
        "loop.fault_s=0.02",
        "loop.bump_nm=300",
    )
    assert (
        np.sqrt(np.mean(told.rms_nm[-15:] ** 2))
        < 1.6 * ran(*KALMAN, "feedback.latency_frames=0")[1].rms_nm[-15:].mean()
    )
    if fault in ("nan-frames", "lost-frames"):  # the wind goes on in the dark: the mirror follows it
        dark = told.rms_nm[110:120]
        assert dark.max() < 1.7 * np.median(told.rms_nm[95:109])


def test_a_bump_that_stays_is_told_from_air():
    """After it has been captured the filter takes it for what does not move: it is as good as before."""
    _, told = ran(
        "feedback.controller=kalman",
        "loop.learn_after_s=0.15",
        "loop.seconds=0.7",
        "loop.fault=bump",
        "loop.fault_at_s=0.3",
        "loop.bump_nm=250",
    )
    assert told.rms_nm[152] > 3 * np.median(told.rms_nm[120:149])
    assert np.median(told.rms_nm[-40:]) < 1.15 * np.median(told.rms_nm[120:149])


def test_a_wind_that_is_told_needs_no_learning():
    loop, told = ran(
        "feedback.controller=kalman", "estimation.prior.wind_direction_deg=0", "loop.start=closed", "loop.seconds=0.1"
    )
    assert not loop.learns
    assert isinstance(loop.measurement, CarriedCurvature)
    assert loop.measurement.wind[:2] == pytest.approx((0.0, 10.0))
    assert rms_nm(told, 10) < loop_bounds(loop.light)["floor_nm"]
    assert told.closed.all()


def test_without_a_clear_wind_it_goes_on_as_it_was(monkeypatch):
    monkeypatch.setattr(loop_air, "found_wind", lambda *_, **__: None)
    loop = Loop.build(small(*KALMAN, "loop.seconds=0.2"))
    state, records = run_loop(loop)
    assert isinstance(loop.measurement, FollowedCurvature)
    assert len(records) == 100
    assert not isinstance(state.memory, CarriedState)


def test_turbulence_that_is_not_told_is_seen_in_the_modes():
    """Within what half a second of a 2 m telescope tells of it."""
    loop, _ = ran(*KALMAN, "feedback.latency_frames=0")
    followed = loop.measurement.followed if isinstance(loop.measurement, CarriedCurvature) else loop.measurement
    assert isinstance(followed, FollowedCurvature)
    basis = filtered_basis(followed.reconstructor.solver, loop.light.mirror.count)
    rng = np.random.default_rng(3)
    air = loop.light.still.air
    rms_m = np.sqrt(np.asarray(basis.kolmogorov_rad2) * loop_air.unit_variance_m2(air, 2.0))
    modes_m = rng.standard_normal((400, basis.count)) * rms_m
    shapes = np.eye(basis.count, 60)
    config = load_config(None, UNTOLD)
    telemetry = Telemetry(modes_m[:, :60], np.zeros((400, 60)))
    seen = loop_air._seen_air(config, basis, telemetry.open_loop_m @ shapes.T, commands=60)
    assert seen.fried_m == pytest.approx(air.fried_m, rel=0.03)


def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path):
    config = small(*KALMAN, "loop.seconds=0.24")
    _, whole = run_loop(Loop.build(config))
    folder_of.prepare_folder(tmp_path / "run", config, resume=False)

    def stop(state, records):
        if len(records) == 105:
            folder_of.write_checkpoint(tmp_path / "run", config, state, records)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_loop(Loop.build(config), watch=stop)
    state, records = folder_of.read_checkpoint(tmp_path / "run", config)
    assert isinstance(state.memory, CarriedState)
    _, resumed = run_loop(Loop.build(config), state=state, records=records)
    assert [one.rms_nm for one in resumed] == [one.rms_nm for one in whole]


@pytest.mark.parametrize("override", ["loop.sensor=ideal", "loop.follow=false", "estimation.method=gerchberg-saxton"])
def test_it_filters_what_it_can_only(override):
    with pytest.raises(SettingsError, match=r"feedback\.controller: filters the air of"):
        Loop.build(small("feedback.controller=kalman", override))


def test_a_wind_that_is_told_needs_a_turbulence_that_is():
    config = load_config(None, [*UNTOLD, "feedback.controller=kalman", "estimation.prior.wind_direction_deg=0"])
    with pytest.raises(SettingsError, match=r"estimation\.seeing_arcsec: must be told"):
        Loop.build(config)
