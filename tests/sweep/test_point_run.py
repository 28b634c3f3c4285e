"""One point: a loop under another seed is the loop of that seed, and what goes wrong is a row."""

import json

import numpy as np
import pytest
from tests.loop.small_loop import small
from tests.sweep.small_sweep import written

from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, counted_from, run_loop, summary
from nlcwfs.simulation.closed_loop.seed import reseeded
from nlcwfs.studies import point_run
from nlcwfs.studies.point_run import PointRunner
from nlcwfs.studies.sweep_points import read_sweep

LEARNS = ["loop.sensor=ideal", "loop.seconds=0.15", "loop.learn_after_s=0.01", "feedback.controller=predictive"]
SPOTS = [
    "loop.sensor=shack-hartmann",
    "shack_hartmann.subapertures=10",
    "shack_hartmann.pixels=32",
    "loop.seconds=0.04",
]
CURVATURE = ["loop.seconds=0.012"]


def told(loop):
    return LoopTelemetry.of(run_loop(loop)[1])


@pytest.mark.parametrize("settings", [LEARNS, CURVATURE, SPOTS], ids=["learning", "curvature", "lenslets"])
def test_a_loop_under_another_seed_is_the_loop_of_that_seed(settings):
    first = Loop.build(small(*settings))
    before = told(first)
    other, built = reseeded(first, 5), Loop.build(small("seed=5", *settings))
    assert other.config == built.config
    found, expected = told(other), told(built)
    np.testing.assert_array_equal(found.rms_nm, expected.rms_nm)
    np.testing.assert_array_equal(found.command_m, expected.command_m)
    assert not np.array_equal(found.rms_nm, before.rms_nm)


def test_the_first_loop_is_as_it_was():
    first = Loop.build(small("loop.sensor=ideal", "loop.seconds=0.01"))
    before = told(first).rms_nm
    reseeded(first, 5)
    assert first.config.seed == 0
    np.testing.assert_array_equal(told(first).rms_nm, before)


def points_of(folder, body):
    return read_sweep(written(folder, body))[1]


def test_a_row_holds_the_numbers_of_the_loop(tmp_path):
    (point,) = points_of(tmp_path, "[grid]\nseed = [3]\n")
    row, files = PointRunner().run(point)
    loop = Loop.build(point.config)
    state, records = run_loop(loop)
    expected = summary(loop, state, records, 0.0)
    for name in ("outcome", "rms_nm", "strehl", "frames", "frames_to_close"):
        assert row[name] == expected[name]
    assert row["tip_tilt_nm"] == expected["rms_by_group_nm"]["tip_tilt"]
    assert row["floor_nm"] == expected["bounds"]["floor_nm"]
    counted = LoopTelemetry.of(records).rms_nm[counted_from(loop, state) :]
    assert row["worst_nm"] == pytest.approx(counted.max(), abs=0.005)  # rounded
    assert (row["seed"], row["digest"], row["error"], files) == (3, point.digest, "", {})


def test_a_mirror_serves_all_seeds_and_no_other_setting(tmp_path, monkeypatch):
    points = points_of(tmp_path, "[grid]\nmirror.cutoff_cpa = [5, 4]\nseed = [0, 1]\n")
    build, built = Loop.build, []
    monkeypatch.setattr(point_run.Loop, "build", lambda config, pupil: built.append(config) or build(config, pupil))
    runner = PointRunner()
    rows = [runner.run(point).row for point in points[:3]]
    assert [config.mirror.cutoff_cpa for config in built] == [5, 4]
    assert [row["seed"] for row in rows] == [0, 1, 0]
    assert len({row["rms_nm"] for row in rows}) == 3


def test_what_goes_wrong_is_a_row_and_the_next_point_runs(tmp_path, monkeypatch):
    good, faint = points_of(tmp_path, "[grid]\nmirror.cutoff_cpa = [5, 40]\n")
    runner = PointRunner()
    row = runner.run(faint).row
    assert row["outcome"] == "failed"
    assert row["error"].startswith("mirror.cutoff_cpa: must be at most 32")
    assert "rms_nm" not in row
    assert row["mirror.cutoff_cpa"] == 40
    with monkeypatch.context() as patch:
        patch.setattr(point_run, "run_loop", lambda loop: [][1])
        row = runner.run(good).row
    assert row["error"].startswith("IndexError: list index out of range (test_point_run.py, line")
    assert runner.run(good).row["error"] == ""


def test_a_run_that_is_kept_brings_its_files(tmp_path):
    (point,) = points_of(tmp_path, "keep = true\n")
    row, files = PointRunner().run(point)
    assert set(files) == {"config.toml", "frames.ecsv", "loop.png", "psf.fits", "summary.json", "telemetry.fits"}
    kept = json.loads(files["summary.json"])
    assert (kept["rms_nm"], kept["provenance"]["seed"]) == (row["rms_nm"], 0)
    assert sum(map(len, files.values())) < 1e6  # thousands of runs shall fit on a disk
