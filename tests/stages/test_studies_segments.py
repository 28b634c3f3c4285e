"""Study 11: its rows tell steps apart from what is inside, its figure and page show them."""

import numpy as np
import pytest

from nlcwfs.simulation.segment_score import SegmentScore
from nlcwfs.studies.segment_figures import draw_segments
from nlcwfs.studies.step_columns import step_columns, step_errors, steps_captured
from nlcwfs.studies.study_cases import read_study
from nlcwfs.studies.study_report import quick_lines, write_report
from nlcwfs.studies.study_run import run_study

STUDY = """
question = "q"
captured_nm = 5.0
score = "segments"
screens = 1
set = [
    "seed=1", "beam.wavelength_um=0.65", "beam.segments.layout=sparse", "beam.segments.pistons_nm=[0, 150, -100, 60]",
    "atmosphere.photons=2e8", "atmosphere.opd_rms_nm=60", "detector.pixels_across_pupil=24",
    "detector.window_pixels=48", "estimation.method=gerchberg-saxton", "estimation.gerchberg_saxton.filter=none",
    "estimation.gerchberg_saxton.scheme=serial", "estimation.gerchberg_saxton.amplitude=replace",
    "estimation.gerchberg_saxton.coarse_cutoffs_cpa=[]", "estimation.gerchberg_saxton.gain=1",
    "estimation.gerchberg_saxton.tolerance_rad=0", "estimation.unwrapping=slopes", "estimation.modes=80",
]
[groups]
one = "One"
[[case]]
name = "long"
group = "one"
set = ["estimation.gerchberg_saxton.iterations=60"]
[[case]]
name = "short"
group = "one"
set = ["estimation.gerchberg_saxton.iterations=1"]
"""


def test_a_study_of_segments_scores_its_steps(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    table = run_study(tmp_path, progress=lambda *_: None)
    long, short = table.rows
    assert 0 < long["piston_modulo_nm"] < 5 < short["piston_modulo_nm"]
    assert 0 < long["straightened_nm"] <= long["inside_nm"] < 15
    assert (long["captured_steps"], short["captured_steps"]) == (1.0, 0.0)
    study = read_study(tmp_path)
    assert quick_lines(study, table, ())[0].startswith("long: 100% of 1 captured, median ")
    page = write_report(tmp_path, study, table, {}).read_text()
    assert "| piston [nm] | worst | inside [nm] |" in page


def test_median_and_worst_over_screens_with_a_lost_one_in_it():
    scores = [SegmentScore(1e-6, nm * 1e-9, 2 * nm * 1e-9, nm * 1e-9, (0, turn)) for nm, turn in ((1, 0), (9, 1))]
    lost = SegmentScore(np.nan, np.nan, np.nan, np.nan, ())
    row = step_columns([*scores, lost], captured_nm=5.0)
    assert (row["piston_modulo_nm"], row["piston_modulo_worst_nm"], row["inside_nm"]) == (9.0, 1e6, 18.0)
    assert row["captured_steps"] == pytest.approx(1 / 3)
    assert steps_captured([*scores, lost], 5.0).tolist() == [True, False, False]


def test_errors_are_parted_by_the_pixels_of_the_light():
    labels, weights = np.array([[0, 0, 1, 1]]), np.array([[1.0, 1.0, 0.0, 2.0]])
    score = step_errors(np.array([[1e-9, -1e-9, 5e-6, 10e-9]]), (labels, weights), wavelength_m=650e-9)
    assert score is not None
    # Two equal halves, 10 nm apart: 5 nm; the first holds 1 nm in itself, the second nothing.
    assert score.piston_m == pytest.approx(5e-9, rel=1e-9)
    assert score.inside_m == pytest.approx(np.sqrt(0.5) * 1e-9, rel=1e-9)


def row(case, piston_nm, inside_nm, group="iterations"):
    return {
        "case": case,
        "group": group,
        "piston_modulo_nm": piston_nm,
        "piston_modulo_worst_nm": 2 * piston_nm,
        "inside_nm": inside_nm,
        "inside_worst_nm": 2 * inside_nm,
    }


def test_the_figure_shows_each_pupil_with_its_curves():
    rows = [row("discs-plain-20", 20, 5), row("discs-plain-10", 60, 10), row("discs-map", 0.1, 1), row("x", 1, 1, "o")]
    figure = draw_segments(rows)
    assert figure is not None
    upper = figure.axes[0]
    curve = upper.lines[0]
    np.testing.assert_array_equal(curve.get_xdata(), [10, 20])
    np.testing.assert_array_equal(curve.get_ydata(), [60, 20])
    assert upper.lines[1].get_ydata()[0] == 0.1
    assert draw_segments([row("x", 1, 1, "other")]) is None
