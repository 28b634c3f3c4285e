"""`nlcwfs sweep` with processes of this machine: rows, page, exit codes, resuming, Ctrl-C."""

import json
import re

import pytest
from tests.sweep.small_sweep import Sweeping, numbers, rows_in, swept, written

TWO = "[grid]\nseed = [0, 1]\n"
BESIDE_A_BAD_ONE = (
    TWO + "[[case]]\nname = 'good'\nkeep = true\n[[case]]\nname = 'bad'\nset = ['mirror.cutoff_cpa=40']\n"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = written(tmp_path_factory.mktemp("sweep") / "s", BESIDE_A_BAD_ONE)
    return folder, swept(folder, "--workers", 2)


def test_a_point_that_fails_does_not_stop_the_others(run):
    folder, result = run
    assert result.exit_code == 1
    rows = rows_in(folder)
    assert list(rows) == ["good,seed=0", "good,seed=1", "bad,seed=0", "bad,seed=1"]
    assert [row["outcome"] for row in rows.values()] == ["closed", "closed", "failed", "failed"]
    assert rows["bad,seed=1"]["error"].startswith("mirror.cutoff_cpa: must be at most 32")
    assert "bad,seed=0 failed: mirror.cutoff_cpa: must be at most 32" in result.stderr
    assert "2 of 4 points failed" in result.stderr
    assert "Traceback" not in result.output


def test_a_line_for_each_point_and_the_dashboard_are_told(run):
    folder, result = run
    lines = result.stdout.splitlines()
    assert lines[0] == "4 points, 0 done before."
    assert re.fullmatch(r"Dashboard: http://[\d.]+:\d+/status", lines[1])
    row = rows_in(folder)["good,seed=1"]
    told = f"good,seed=1: closed, {row['rms_nm']:.1f} nm, Strehl {row['strehl']:.3f} ("
    assert any(told in line and line.startswith("[") for line in lines)


def test_runs_are_kept_where_that_is_asked_for(run):
    folder, _ = run
    assert sorted(path.name for path in (folder / "runs").iterdir()) == ["good,seed=0", "good,seed=1"]
    kept = json.loads((folder / "runs" / "good,seed=1" / "summary.json").read_text())
    row = rows_in(folder)["good,seed=1"]
    assert kept["rms_nm"] == row["rms_nm"]
    assert kept["provenance"]["seed"] == 1
    assert (row["device"], row["commit"]) == (kept["provenance"]["device"], kept["provenance"]["commit"])


def test_the_page_counts_seeds_and_failures(run):
    folder, _ = run
    page = (folder / "README.md").read_text(encoding="utf-8")
    assert "| 2 | 2 |" in page.split("## good")[1].split("## bad")[0]
    assert "| seeds | closed | failed |\n|---|---|---|\n| 2 | 0 | 2 |" in page


def test_again_only_what_failed_is_tried(run):
    folder, _ = run
    before = rows_in(folder)
    result = swept(folder, "--workers", 1)
    assert result.exit_code == 1
    assert result.stdout.splitlines()[0] == "4 points, 2 done before."
    assert sum(line.startswith("warning: [") for line in result.stderr.splitlines()) == 2
    after = rows_in(folder)
    for name in ("good,seed=0", "good,seed=1"):
        assert after[name] == before[name]  # the seconds, too: not run again


def test_one_worker_finds_the_same_and_rows_elsewhere_stay(run, tmp_path):
    folder, _ = run
    others = written(tmp_path / "s", TWO + "[[case]]\nname = 'good'\n")
    result = swept(others, "--workers", 1, "--out", tmp_path / "there" / "deep")
    assert result.exit_code == 0, result.output
    found, expected = rows_in(tmp_path / "there" / "deep"), rows_in(folder)
    for name in ("good,seed=0", "good,seed=1"):
        # those were to be kept, which is in their digest; whole columns of numbers turn real beside failed points
        assert numbers(found[name]) | {"digest": ""} == numbers(expected[name]) | {"digest": ""}
    assert sorted(path.name for path in others.iterdir()) == ["sweep.toml"]
    written(others, "[grid]\nseed = [1]\n[[case]]\nname = 'good'\n")
    done = swept(others, "--out", tmp_path / "there" / "deep")
    assert done.exit_code == 0
    assert "Dashboard" not in done.stdout
    assert "1 rows of points that the file no longer asks for stay in it" in done.stdout
    assert len(rows_in(tmp_path / "there" / "deep")) == 2
    assert "| 1 | 1 |" in (tmp_path / "there" / "deep" / "README.md").read_text(encoding="utf-8")


def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on(tmp_path):
    folder = written(tmp_path, "[grid]\nseed = [0, 1, 2]\n")
    sweeping = Sweeping(folder, "--workers", 1)
    sweeping.read_until("[1/3]")
    sweeping.press_ctrl_c()
    assert sweeping.end() == 130
    assert "Traceback" not in sweeping.said
    before = rows_in(folder)
    assert 1 <= len(before) < 3
    assert f"{len(before)} of 3 points are in {folder / 'results.ecsv'}; the same command goes on" in sweeping.said
    assert sweeping.left_over() == []
    again = swept(folder, "--workers", 1)
    assert again.exit_code == 0
    assert f"3 points, {len(before)} done before." in again.stdout
    after = rows_in(folder)
    assert list(after) == ["all,seed=0", "all,seed=1", "all,seed=2"]
    assert {name: after[name] for name in before} == before


def test_workers_and_a_scheduler_are_not_both_asked_for(tmp_path):
    result = swept(written(tmp_path, TWO), "--workers", 2, "--scheduler", "tcp://127.0.0.1:1")
    assert result.exit_code == 2
    assert "--workers: must be left out with --scheduler" in result.stderr


def test_a_folder_that_cannot_be_written_is_told_first(tmp_path):
    (tmp_path / "file").write_text("")
    result = swept(written(tmp_path / "s", TWO), "--out", tmp_path / "file" / "deep")
    assert result.exit_code == 2
    assert "must be a folder that can be written" in result.stderr
