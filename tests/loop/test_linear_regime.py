"""The linear regime in a loop: it takes over, leaves as little, hands back when it fails, and holds a reference."""

import functools
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from astropy.table import Table
from small_loop import SMALL, small

sys.path.insert(0, str(Path(__file__).parents[1] / "stages"))
from command_line import type_in

from nlcwfs.beam.zernike import zernikes
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, run_loop, summary

HANDED = ("loop.handover=true", "curvature_sensor.static_rms_nm=425")
LINEAR = ("loop.sensor=linear-curvature", "linear_curvature.distances_km=[-62.5, 62.5]")
REFERENCE = "loop.reference_nm=[20, -30, 60, 0, 40]"


@functools.cache
def built(*overrides: str) -> Loop:
    return Loop.build(small(*overrides))


def ran(loop: Loop, *overrides: str) -> tuple[LoopTelemetry, dict]:
    """A run with other settings of the loop itself, on the same mirror, sensor and air."""
    loop.config = small(*overrides)
    state, records = run_loop(loop)
    return LoopTelemetry.of(records), summary(loop, state, records, 1.0)


def test_the_matrix_takes_over_and_leaves_as_little_as_the_method_that_captured():
    told, found = ran(built(*HANDED), *HANDED)
    assert found["outcome"] == "closed"
    assert (found["handovers"], found["handbacks"]) == (1, 0)
    first = int(np.argmax(told.linear))
    assert told.linear[first:].all()
    assert not told.ffts[first:].any()
    assert told.ffts[first - 1] == 97
    slow, _ = ran(built(HANDED[1]), HANDED[1])
    assert not slow.linear.any()
    late = slice(first, None)
    ratio = np.sqrt(np.mean(told.rms_nm[late] ** 2) / np.mean(slow.rms_nm[late] ** 2))
    assert 0.93 < ratio < 1.07  # 45 exposures; 1.00 +- 0.02 over five times as many and two skies


def test_a_bump_hands_back_and_the_matrix_comes_again():
    """400 nm at 60 ms: beyond the range, noticed at once, captured anew."""
    times = ("loop.fault=bump", "loop.bump_nm=400", "loop.fault_at_s=0.06", "loop.seconds=0.14")
    told, found = ran(built(*HANDED), *HANDED, *times)
    assert told.linear[29]
    assert told.rms_nm[30] > 350
    assert not told.linear[31:34].any()
    assert told.linear[-5:].all()
    assert found["handbacks"] == 1
    assert found["handovers"] == 2
    assert np.median(told.rms_nm[-15:]) < 1.2 * np.median(told.rms_nm[15:30])


@pytest.mark.parametrize("fault", ["nan-frames", "lost-frames", "dead-plane"])
def test_it_survives(fault):
    times = (f"loop.fault={fault}", "loop.fault_at_s=0.06", "loop.fault_s=0.01", "loop.seconds=0.14")
    told, found = ran(built(*HANDED), *HANDED, *times)
    assert np.isfinite(told.command_m).all()
    assert found["outcome"] == "closed"
    assert np.median(told.rms_nm[-15:]) < 1.2 * np.median(told.rms_nm[15:30])


def test_a_mode_is_measured_as_itself_and_its_range_is_known():
    """A brighter star, and the mirror pushed by 15 nm either way amid what the loop leaves; half the difference."""
    bright = (*HANDED, "atmosphere.photons_per_s=2e8")
    loop = built(*bright)
    loop.config = small(*bright, "loop.seconds=0.04")
    state, _ = run_loop(loop)
    assert state.memory.linear
    matrix, gains = loop.measurement.linear, []
    command_m = np.asarray(state.control.line.mean_m)
    for mode in (0, 3, 20):
        push_m = 1.5e-8 * (np.arange(loop.light.mirror.count) == mode)
        line = [state.control.push(jnp.asarray(command_m + sign * push_m, jnp.float32)).line for sign in (1, -1)]
        flat_m = jnp.zeros_like(loop.light.weights)
        shots = [loop.light.expose(jnp.asarray(state.frame, jnp.int32), one, state.image, flat_m) for one in line]
        less, more = (
            matrix.look(one.exposure.photons, jnp.ones(one.exposure.photons.shape, bool)).residual_m for one in shots
        )
        gains.append(float(more[mode] - less[mode]) / 3e-8)
    np.testing.assert_allclose(gains, 1, atol=0.12)  # the light of one residual bends it so much
    assert 60 < 1e9 * matrix.matrix.range.limit_m < 400


def test_a_reference_stays_on_the_sensor_and_the_star_is_flat():
    """With an ideal sensor the score is as without; the mirror differs by the reference, of which NumPy is asked."""
    ideal = ("loop.sensor=ideal", "loop.seconds=0.03")
    plain, _ = ran(built("loop.sensor=ideal"), *ideal)
    loop = built("loop.sensor=ideal", REFERENCE)
    told, _ = ran(loop, *ideal, REFERENCE)
    light = loop.light
    wave_m = 1e-9 * np.array([0, 20, -30, 60, 0, 40])
    shape_m = np.tensordot(wave_m, np.asarray(zernikes(6, light.part, diameter_m=2.0)), axes=1)
    wanted_m = np.asarray(light.mirror.fitted(jnp.asarray(shape_m, jnp.float32)))
    found_m = plain.command_m[5] - told.command_m[5]
    np.testing.assert_allclose(found_m, wanted_m, atol=0.5e-9)
    np.testing.assert_allclose(told.rms_nm[3:], plain.rms_nm[3:], rtol=0.02)  # the mirror makes all but a percent
    np.testing.assert_allclose(told.group_nm[3:], plain.group_nm[3:], atol=1.5)


def test_both_estimators_hold_a_reference():
    told, found = ran(built(*HANDED, REFERENCE), *HANDED, REFERENCE)
    plain, _ = ran(built(*HANDED), *HANDED)
    assert found["handovers"] == 1
    assert told.linear[-40:].all()
    assert np.median(told.rms_nm[-40:]) < 1.1 * np.median(plain.rms_nm[-40:])
    before = int(np.argmax(told.linear))
    assert np.median(told.rms_nm[2:before]) < 1.25 * np.median(plain.rms_nm[2:before])


def test_a_linear_curvature_sensor_closes_with_matrices_alone():
    """Matrices for the open and the closed loop; far above the non-linear sensor, for slow waves cost photons."""
    loop = built(*LINEAR)
    told, found = ran(loop, *LINEAR)
    assert found["outcome"] == "closed"
    assert 1 <= found["frames_to_close"] < 12
    assert told.rms_nm[0] > 300
    assert not told.ffts.any()
    assert found["bounds"]["floor_nm"] < found["rms_nm"] < 0.4 * found["bounds"]["open_loop_nm"]
    assert loop.light.still.sensor.transfer.shape[1] == 2


def test_a_run_tells_which_estimator_worked(tmp_path):
    out = tmp_path / "run"
    settings = [word for setting in [*SMALL, *LINEAR, "loop.seconds=0.03"] for word in ("--set", setting)]
    result = type_in("loop", "--out", out, *settings)
    assert result.exit_code == 0, result.output
    numbers = json.loads((out / "summary.json").read_text())
    table = Table.read(out / "frames.ecsv")
    assert numbers["frames_linear"] == np.sum(table["linear"])
    assert numbers["linear_range_nm"] > 0


@pytest.mark.parametrize(
    ("overrides", "rule"),
    [
        (("loop.handover=true", "estimation.method=linear"), r"loop\.handover: needs loop\.sensor = curvature with"),
        (("loop.handover=true", "loop.sensor=ideal"), r"loop\.handover: needs loop\.sensor = curvature with"),
        (("loop.handover=true", "loop.follow=false"), r"loop\.handover: needs loop\.sensor = curvature with"),
        (("loop.handover=true", "feedback.controller=kalman"), r"loop\.handover: must be false with"),
        (
            ("linear_curvature.distances_km=[-1000, 900]",),
            r"linear_curvature\.distances_km: must be pairs",
        ),
        (
            (*HANDED, "loop.reference_nm=[0, 0, 9000]"),
            r"loop\.reference_nm: must have a linear range of .* nm",
        ),
    ],
)
def test_settings_that_cannot_be(overrides, rule):
    with pytest.raises(SettingsError, match=rule):
        Loop.build(small(*overrides))
