"""`nlcwfs sensitivity`: table, page, resuming, and what it refuses."""

import numpy as np
from astropy.table import Table
from tests.stages.command_line import type_in

QUESTION = """
question = "Which?"
answer = "This one"
cycles_per_aperture = [2, 6]
rms_rad = [0, 3]
wavefronts = 2
flat = { across_pupil = 32, window = 2.0 }
rough = { across_pupil = 32, window = 2.0 }
[[case]]
name = "planes"
[[case]]
name = "near, linear"
reconstruction = "linear"
rms_rad = [3]
set = ["curvature_sensor.distances_km=[-1000, 1000]"]
"""


def asked(folder, text=QUESTION):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sensitivity.toml").write_text(text, encoding="utf-8")
    return folder


def test_a_question_becomes_table_figure_and_page_and_is_not_computed_twice(tmp_path):
    folder = asked(tmp_path / "s")
    result = type_in("sensitivity", folder)
    assert result.exit_code == 0, result.output
    assert "Curves: 3, 0 done before." in result.output
    table = Table.read(folder / "results.ecsv")
    assert len(table) == 6  # two planes, one near; two ripples each
    assert set(table["sensor"]) == {"planes", "near, linear"}
    np.testing.assert_allclose(table["beta_p"] ** 2, table["flux_factor"], rtol=1e-3)  # four digits each
    assert np.all(table["flux_factor"] > 1)
    assert (folder / "sensitivity.png").stat().st_size > 10_000
    assert (folder / "README.md").read_text(encoding="utf-8").startswith("# This one")
    again = type_in("sensitivity", folder)
    assert "Curves: 3, 3 done before." in again.output
    assert len(Table.read(folder / "results.ecsv")) == 6


def test_one_sensor_of_the_paper_is_chosen_by_a_part_of_its_name(tmp_path):
    typed = ("--sensor", "1000 km", "--rms-rad", 4, "--cpa", 2, "--out", tmp_path / "one")
    result = type_in("sensitivity", *typed, "--quiet")
    assert result.exit_code == 0, result.output
    (row,) = Table.read(tmp_path / "one" / "results.ecsv")
    assert row["rms_rad"] == 4
    assert 38 < row["flux_factor"] < 46  # a prototype found 42


def refused(*words):
    result = type_in("sensitivity", *words)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    (line,) = result.stderr.splitlines()
    return line


def test_what_cannot_be_is_told_in_a_line(tmp_path):
    out = ("--out", tmp_path / "out")
    one = ("--sensor", "1000 km", *out)
    assert "--sensor: must be a part of one of 'Shack-Hartmann, D/d 16'" in refused("--sensor", "shack", *out)
    assert refused("--rms-rad", "-1", *one) == "nlcwfs: --rms-rad: must be a number from 0 to 100, got -1.0"
    assert refused("--cpa", "0", *one).endswith("--cpa: must be a number above 0 and at most 1000, got 0.0")
    line = refused("--cpa", "600", "--rms-rad", "1", *one)
    assert "sensitivity.cycles_per_aperture: must be above 0 and at most 32 cycles per aperture" in line
    line = refused("--set", "beam.diameter_m=-3", *one)
    assert "beam.diameter_m: must be a number from 0.01 to 100" in line
    assert refused(tmp_path / "none.toml").endswith("none.toml: must exist, got no such file")
    wrong = asked(tmp_path / "w", QUESTION.replace("rms_rad = [0, 3]", "rms_rad = [-1]"))
    assert "sensitivity.toml: rms_rad" in refused(wrong)
    named = asked(tmp_path / "n", QUESTION.replace('name = "near, linear"', 'name = "planes"'))
    assert "case.name must be unique" in refused(named)


def test_a_sensor_that_sees_nothing_is_called_blind(tmp_path):
    text = QUESTION.replace("[-1000, 1000]", "[-1, 1]").replace(
        "cycles_per_aperture = [2, 6]", "cycles_per_aperture = [0.01]"
    )
    folder = asked(tmp_path / "b", text.replace("rms_rad = [3]", "rms_rad = [0]"))
    result = type_in("sensitivity", folder, "--sensor", "near")
    assert result.exit_code == 0
    assert "the sensor is blind to this mode" in result.stderr
    assert "| near, linear | 100 % | blind |" in (folder / "README.md").read_text(encoding="utf-8")
