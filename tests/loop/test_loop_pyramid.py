"""The pyramid in the loop: the same light as any sensor's, gain 1 amid residuals, what it leaves, and its faults."""

import functools
import json
import sys
from pathlib import Path

import aotpy
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_loop import SMALL, small

sys.path.insert(0, str(Path(__file__).parents[1] / "stages"))
from command_line import type_in

from nlcwfs.errors import SettingsError
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.pyramid_regimes import Residuals
from nlcwfs.simulation.closed_loop.run import MISSING, LoopTelemetry, run_loop, summary

PYRAMID = ("loop.sensor=pyramid", "pyramid.pixels=16", "pyramid.margin_pixels=4", "simulation.light_oversampling=3")
MODULATED = ("pyramid.modulation_lambda_over_d=1.5", "pyramid.modulation_points=12")
FIXED = ("pyramid.modulation_lambda_over_d=0",)
BRIGHT = 1e9


@functools.cache
def built(*overrides: str) -> Loop:
    return Loop.build(small(*PYRAMID, *(overrides or MODULATED)))


def ran(loop: Loop, *overrides: str) -> tuple[LoopTelemetry, dict]:
    """A run with other settings of the loop itself, on the same mirror, sensor and air."""
    loop.config = small(*PYRAMID, *MODULATED, *overrides)
    state, records = run_loop(loop)
    return LoopTelemetry.of(records), summary(loop, state, records, 1.0)


def exposed(loop: Loop, frame: int, command_m: np.ndarray):
    """An exposure behind a mirror of this shape."""
    state = loop.init()
    line = state.control.push(jnp.asarray(command_m, jnp.float32)).line
    return loop.light.expose(jnp.asarray(frame, jnp.int32), line, state.image, jnp.zeros_like(loop.light.weights))


def measured_m(loop: Loop, wavefront_m: np.ndarray, memory=None) -> np.ndarray:
    """Modes that are seen in very many photons, each where it is expected."""
    photons = loop.light.optics.images(jnp.asarray(wavefront_m, jnp.float32), BRIGHT)
    exposure = exposed(loop, 0, np.zeros(loop.light.mirror.count)).exposure
    exposure = eqx.tree_at(lambda one: one.frames.electrons, exposure, photons)
    usable = jnp.ones(photons.shape, bool)
    sight, _ = loop.measurement.measure(exposure, usable, jnp.zeros_like(loop.light.weights), memory)
    return np.asarray(sight.residual_m)


def test_the_air_and_the_score_are_those_of_the_curvature_sensor():
    loop, other = built(), Loop.build(small("loop.sensor=ideal", "simulation.light_oversampling=3"))
    command_m = np.linspace(-1e-7, 1e-7, loop.light.mirror.count)
    ours, theirs = exposed(loop, 3, command_m), exposed(other, 3, command_m)
    np.testing.assert_array_equal(ours.exposure.opd_m, theirs.exposure.opd_m)
    np.testing.assert_array_equal(ours.exposure.truth_m, theirs.exposure.truth_m)
    assert float(ours.square_m2) == float(theirs.square_m2)


def test_photons_are_counted_and_those_that_miss_are_told():
    loop = built()
    exposure = exposed(loop, 0, np.zeros(loop.light.mirror.count)).exposure
    photons, electrons = np.asarray(exposure.photons), np.asarray(exposure.frames.electrons)
    assert photons.shape == (4, 24, 24)
    assert np.all(np.equal(np.mod(electrons, 1), 0))
    assert photons.sum() == pytest.approx(4000 * (1 - float(exposure.lost[0])), rel=1e-5)
    assert 0.005 < float(exposure.lost[0]) < 0.15
    assert electrons.sum() == pytest.approx(photons.sum(), abs=5 * float(np.sqrt(photons.sum())))


@pytest.mark.parametrize("settings", [MODULATED, FIXED], ids=["modulated", "fixed"])
def test_gain_is_one_amid_what_the_loop_leaves(settings):
    """Light linear in a mode more or less, mean over residuals that the sensor was not made with: its own modes.

    15 %: eight residuals, and a response that differs from one to the next.
    """
    loop = built(*settings)
    mirror, residuals = loop.light.mirror, Residuals(loop.config, loop.light, loop.measurement.drive)
    amid = [residuals.draw_m(0.0, number) for number in range(100, 108)]
    begun = measured_m(loop, amid[0])
    assert np.isfinite(begun).all()
    gains = []
    for mode in (0, 1, 5, 20):
        push_m = np.asarray(mirror.opd_m(1e-8 * (np.arange(mirror.count) == mode)))
        both = [measured_m(loop, one + push_m)[mode] - measured_m(loop, one - push_m)[mode] for one in amid]
        gains.append(np.mean(both) / 2e-8)
    np.testing.assert_allclose(gains, 1, atol=0.15)


@pytest.mark.parametrize("settings", [MODULATED, FIXED], ids=["modulated", "fixed"])
def test_it_closes_from_a_flat_mirror_and_stays_near_the_floor(settings):
    told, found = ran(built(*settings))
    assert found["outcome"] == "closed"
    assert 2 <= found["frames_to_close"] < 20
    assert told.rms_nm[0] > 300
    floor_nm = found["bounds"]["floor_nm"]
    assert floor_nm < found["rms_nm"] < 1.6 * floor_nm
    assert not told.closed[0]


def test_the_same_seed_gives_the_same_numbers():
    loop = built()
    first, _ = ran(loop, "loop.seconds=0.03")
    again, _ = ran(loop, "loop.seconds=0.03")
    np.testing.assert_array_equal(first.command_m, again.command_m)


@pytest.mark.parametrize("fault", ["nan-frames", "lost-frames", "doubled-frames", "dead-plane", "bump"])
def test_it_survives(fault):
    """20 ms of trouble at 80 ms; at 200 ms it is where it was."""
    times = ("loop.seconds=0.2", "loop.fault_at_s=0.08", "loop.fault_s=0.02")
    told, found = ran(built(), f"loop.fault={fault}", *times, "loop.bump_nm=400")
    trouble = slice(40, 50)
    if fault == "nan-frames":
        assert set(told.outcome[trouble]) == {int(Outcome.NO_LIGHT)}
        assert np.ptp(told.command_m[trouble], axis=0).max() == 0
    if fault == "lost-frames":
        assert set(told.outcome[trouble]) == {MISSING}
    if fault == "bump":
        assert told.rms_nm[40] > 350
    assert np.isfinite(told.command_m).all()
    assert found["outcome"] == "closed"
    assert np.median(told.rms_nm[-20:]) < 1.4 * np.median(told.rms_nm[30:40])


def test_a_star_without_light_is_told_and_nothing_moves():
    loop = built()
    dim = small(*PYRAMID, *MODULATED, "atmosphere.photons_per_s=0.01", "loop.give_up_s=0.02")
    dark = Loop.build(dim)
    state, records = run_loop(dark)
    assert summary(dark, state, records, 1.0)["outcome"] == "not closed"
    assert set(LoopTelemetry.of(records).outcome) == {int(Outcome.NO_LIGHT)}
    assert not LoopTelemetry.of(records).command_m.any()
    assert loop.light.mirror.count == dark.light.mirror.count


def test_modes_beyond_the_cutoff_are_not_driven_and_actuators_are():
    driven = (*MODULATED, "pyramid.cutoff_cpa=3", "mirror.kind=karhunen-loeve")
    loop = Loop.build(small(*PYRAMID, *driven, "loop.seconds=0.02"))
    told = LoopTelemetry.of(run_loop(loop)[1])
    cycles = np.asarray(loop.light.mirror.cycles_per_aperture)
    assert told.command_m[-1][cycles <= 3].all()
    assert not told.command_m[:, cycles > 3].any()
    pushed = small(*PYRAMID, *MODULATED, "mirror.kind=actuators", "mirror.actuators_across=11")
    loop = Loop.build(pushed)
    state, records = run_loop(loop)
    assert summary(loop, state, records, 1.0)["outcome"] == "closed"


def test_what_does_not_fit_is_refused_in_one_line():
    with pytest.raises(SettingsError) as refusal:
        Loop.build(small(*PYRAMID, "pyramid.pixels=60"))
    rule = "must be at most 48, the cells of the light across the telescope, got 60"
    assert str(refusal.value) == f"pyramid.pixels: {rule}"
    with pytest.raises(SettingsError, match=r"pyramid\.cutoff_cpa: must be at least 0\.\d+, the tilt's, got 0\.55"):
        Loop.build(small(*PYRAMID, *FIXED, "pyramid.cutoff_cpa=0.55"))
    with pytest.raises(SettingsError, match=r"feedback\.controller: filters the air of loop\.sensor = shack-hartmann"):
        Loop.build(small(*PYRAMID, *FIXED, "feedback.controller=kalman"))


def test_a_run_leaves_a_folder_that_the_standard_reads(tmp_path):
    out = tmp_path / "run"
    settings = [word for one in [*SMALL, *PYRAMID, *MODULATED, "loop.seconds=0.04"] for word in ("--set", one)]
    result = type_in("loop", "--out", out, *settings)
    assert result.exit_code == 0, result.output
    assert json.loads((out / "summary.json").read_text())["outcome"] == "closed"
    system = aotpy.AOSystem.read_from_file(str(out / "telemetry.fits"))
    (sensor,) = system.wavefront_sensors
    assert isinstance(sensor, aotpy.Pyramid)
    assert sensor.n_sides == 4
    assert sensor.modulation == pytest.approx(1.5 * 0.85e-6)
    assert np.asarray(system.loops[0].residual_commands.data).shape[0] == 20


def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path):
    config = small(*PYRAMID, *MODULATED, "loop.seconds=0.04")
    loop = built()
    loop.config = config
    _, whole = run_loop(loop)
    folder_of.prepare_folder(tmp_path / "run", config, resume=False)

    def stop(state, records):
        if len(records) == 12:
            folder_of.write_checkpoint(tmp_path / "run", config, state, records)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_loop(loop, watch=stop)
    state, records = folder_of.read_checkpoint(tmp_path / "run", config)
    _, resumed = run_loop(loop, state=state, records=records)
    assert [one.rms_nm for one in resumed] == [one.rms_nm for one in whole]
    assert jax.tree.all(jax.tree.map(lambda leaf: bool(np.isfinite(leaf).all()), state.memory))
