"""The table and the page of a sweep: what counts as done, what the page says of seeds, how runs are kept."""

import math

import pytest
from tests.sweep.small_sweep import written

from nlcwfs.errors import FileFormatError
from nlcwfs.interop import Provenance
from nlcwfs.studies.study_table import StudyTable
from nlcwfs.studies.sweep_points import read_sweep
from nlcwfs.studies.sweep_report import over_seeds, write_sweep_report
from nlcwfs.studies.sweep_run import keep_run, missing_points, rows_of

STAMP = Provenance.collect({}, seed=None, device="none")
GRID = "[grid]\nseed = [0, 1, 2]\nloop.rate_hz = [300, 500]\n"


def row_of(point, rms_nm=50.0, outcome="closed", error="", **others):
    told = {"point": point.name, "case": point.case, **point.columns, "outcome": outcome}
    told |= {} if error else {"rms_nm": rms_nm, "strehl": 0.9, "floor_nm": 40.0, "frames_to_close": 3}
    return told | {"error": error, "commit": "abc", "digest": point.digest} | others


@pytest.fixture
def sweep(tmp_path):
    return read_sweep(written(tmp_path, GRID))


@pytest.fixture
def table(tmp_path):
    return StudyTable(tmp_path / "results.ecsv", key="point")


def again(table):
    return StudyTable(table.path, key="point")


def test_points_with_numbers_are_done_and_others_are_missing(sweep, table):
    _, points = sweep
    table.put(row_of(points[0]), STAMP)
    table.put(row_of(points[1], error="no light, no wavefront"), STAMP)
    table.put(row_of(points[2]) | {"digest": "of other settings"}, STAMP)
    for each in (table, again(table)):
        assert missing_points(points, each) == list(points[1:])
        assert [row["point"] for row in rows_of(points, each)] == [points[0].name, points[1].name]


def test_errors_survive_the_file_even_where_there_were_none(sweep, table):
    """A column of empty texts reads as masked; it must not become NaN, which is true."""
    _, points = sweep
    table.put(row_of(points[0]), STAMP)
    read = again(table)
    assert read.rows[0]["error"] == ""
    read.put(row_of(points[1], error='a "quoted" error, with commas'), STAMP)
    assert [row["error"] for row in again(read).rows] == ["", 'a "quoted" error, with commas']
    assert math.isnan(again(read).rows[1]["rms_nm"])


def test_a_sorted_table_keeps_what_the_file_no_longer_asks_for(sweep, table):
    _, points = sweep
    for point in reversed(points):
        table.put(row_of(point), STAMP)
    wanted = [point.name for point in points[:3]]
    table.sort(wanted, STAMP, others=True)
    assert [row["point"] for row in again(table).rows][:3] == wanted
    assert len(again(table).rows) == 6


def test_the_table_of_a_study_is_not_that_of_a_sweep(tmp_path):
    other = StudyTable(tmp_path / "results.ecsv")
    other.put({"case": "a", "group": "g", "digest": "0"}, STAMP)
    with pytest.raises(FileFormatError, match="must have the columns point, case and digest"):
        StudyTable(tmp_path / "results.ecsv", key="point")


def test_seeds_are_told_by_their_median_and_range_of_closed_loops():
    def row(rate, rms, outcome="closed"):
        return {"loop.rate_hz": rate, "outcome": outcome, "rms_nm": rms, "strehl": rms / 100, "floor_nm": 1.0}

    rows = [row(300, 70.0), row(500, 52.0), row(300, 90.0), row(300, 10.0), row(300, 900.0, "lost")]
    rows.append({"loop.rate_hz": 500, "outcome": "failed"})
    slow, fast = over_seeds(rows, ["loop.rate_hz"])
    assert (slow["seeds"], slow["closed"]) == (4, 3)
    assert [slow[name] for name in ("rms_nm", "rms_least_nm", "rms_most_nm", "strehl")] == [70.0, 10.0, 90.0, 0.7]
    assert (fast["seeds"], fast["closed"], fast["failed"], fast["rms_nm"]) == (2, 1, 1, 52.0)
    (nothing,) = over_seeds([row(300, math.nan, "not closed")], ["loop.rate_hz"])
    assert nothing["closed"] == 0
    assert math.isnan(nothing["rms_nm"])


def test_the_page_has_a_table_for_each_case_and_its_own_settings(tmp_path):
    body = 'answer = "Fast."\nnotes = "The end."\n' + GRID
    body += "[[case]]\nname = 'a'\n[[case]]\nname = 'b'\n[case.grid]\nmirror.cutoff_cpa = [5]\n"
    sweep, points = read_sweep(written(tmp_path, body))
    rms = {300.0: 61.25, 500.0: 52.75}
    rows = [row_of(p, rms[p.config.loop.rate_hz] + p.config.seed) for p in points]
    text = write_sweep_report(tmp_path, sweep, rows, {"curve.png": "A curve."}).read_text(encoding="utf-8")
    assert text.startswith("# Fast.\n\nHow fast?\n\n![A curve.](curve.png)")
    first, second = text.split("## a\n")[1].split("## b\n")
    assert "| `loop.rate_hz` | seeds | closed | rms, median [nm] | least to most [nm] | Strehl | bound [nm] |" in first
    assert "| 300 | 3 | 3 | 62.2 | 61.2 to 63.2 | 0.900 | 40.0 | 3 |" in first
    assert "| 500 | 3 | 3 | 53.8 | 52.8 to 54.8 |" in first
    assert "cutoff" not in first
    assert "| `loop.rate_hz` | `mirror.cutoff_cpa` | seeds |" in second
    assert text.endswith("The end.\n")


def test_a_run_that_is_kept_replaces_the_one_before_it(tmp_path):
    folder = tmp_path / "runs" / "a,seed=0"
    keep_run(folder, {"psf.fits": b"old", "old.txt": b""})
    keep_run(folder, {"psf.fits": b"new"})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {"psf.fits": b"new"}
    assert [path.name for path in folder.parent.iterdir()] == ["a,seed=0"]


def test_a_run_that_cannot_be_kept_is_told(tmp_path):
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(FileFormatError, match="cannot be written"):
        keep_run(tmp_path / "runs" / "a", {"psf.fits": b""})
