"""From `sweep.toml` to points: grids, names, digests, and what is said of a file that is wrong."""

import re
import tomllib
from pathlib import Path

import pytest
from tests.stages.command_line import type_in
from tests.sweep.small_sweep import written

from nlcwfs.config import load_config
from nlcwfs.studies.sweep_points import point_digest, read_sweep

DOCS = Path(__file__).parents[2] / "docs"


def points_of(folder, body, settings=()):
    return read_sweep(written(folder, body, list(settings)))[1]


TWO_SENSORS = """
[grid]
seed = [0, 1]
"loop.rate_hz" = [300, 500]
[[case]]
name = "curvature"
set = ["loop.seconds=2"]
[[case]]
name = "ideal"
set = ["loop.sensor=ideal"]
[case.grid]
loop.rate_hz = [1000]
mirror.cutoff_cpa = [5, 7, 9]
"""


def test_every_combination_is_a_point_and_a_case_has_its_own_lists(tmp_path):
    points = points_of(tmp_path, TWO_SENSORS, ["beam.diameter_m=2"])
    found = [(p.case, p.config.loop.rate_hz, p.config.mirror.cutoff_cpa, p.config.seed) for p in points]
    default = load_config().mirror.cutoff_cpa
    assert found == [
        *(("curvature", rate, default, seed) for rate in (300, 500) for seed in (0, 1)),
        *(("ideal", 1000, cutoff, seed) for cutoff in (5, 7, 9) for seed in (0, 1)),
    ]
    assert {p.config.beam.diameter_m for p in points} == {2}
    assert {p.config.loop.sensor for p in points if p.case == "ideal"} == {"ideal"}
    assert {p.config.loop.seconds for p in points if p.case == "curvature"} == {2}


def test_a_point_tells_every_setting_that_any_case_varies(tmp_path):
    points = points_of(tmp_path, TWO_SENSORS)
    default = load_config().mirror.cutoff_cpa
    assert points[1].columns == {"loop.rate_hz": 300, "mirror.cutoff_cpa": default, "seed": 1}
    assert points[-1].columns == {"loop.rate_hz": 1000, "mirror.cutoff_cpa": 9, "seed": 1}
    assert points[-1].name == "ideal,loop.rate_hz=1000,mirror.cutoff_cpa=9,seed=1"


def test_a_sweep_without_cases_is_one_case_and_without_a_grid_one_point(tmp_path):
    (point,) = points_of(tmp_path, "", ["loop.rate_hz=77"])
    assert (point.case, point.name, point.config.loop.rate_hz, point.config.seed) == ("all", "all", 77, 0)
    assert point.columns == {"seed": 0}


def test_a_file_of_settings_stands_behind_all_others(tmp_path):
    (tmp_path / "common.toml").write_text("[loop]\nrate_hz = 123\nseconds = 3\n")
    (point,) = points_of(tmp_path, 'config = "common.toml"', ["loop.seconds=2"])
    assert (point.config.loop.rate_hz, point.config.loop.seconds) == (123, 2)


def test_values_of_every_kind_make_names_that_folders_can_have(tmp_path):
    body = """
    [grid]
    curvature_sensor.distances_km = [[-219, -156, 156, 219], [-300, -156, 156, 300]]
    loop.follow = [true, false]
    detector.preset = ["EMCCD"]
    """
    points = points_of(tmp_path, body)
    assert len({p.name for p in points}) == 4
    assert all(re.fullmatch(r"[\w.,=~+-]{1,180}", p.name) for p in points)
    assert {p.config.curvature_sensor.distances_km[0] for p in points} == {-219, -300}
    assert {p.columns["loop.follow"] for p in points} == {"true", False}
    assert {p.columns["curvature_sensor.distances_km"] for p in points} == {
        "[-219.0, -156.0, 156.0, 219.0]",
        "[-300.0, -156.0, 156.0, 300.0]",
    }


def test_names_that_would_be_too_long_stay_different(tmp_path):
    lists = [[-219 - n * 1e-9, -156.123456789, 156.123456789, 219 + n * 1e-9] for n in range(3)]
    points = points_of(tmp_path, f"[grid]\ncurvature_sensor.distances_km = {lists}")
    assert len({p.name for p in points}) == 3


def test_a_digest_knows_settings_and_nothing_else():
    one = load_config(None, ["loop.rate_hz=300"])
    assert point_digest(one, keep=False) == point_digest(load_config(None, ["loop.rate_hz=300.0"]), keep=False)
    others = [
        point_digest(load_config(None, [*extra, "loop.rate_hz=300"]), keep=False)
        for extra in (["seed=1"], ["beam.diameter_m=2"], ["loop.seconds=0.5"])
    ]
    assert len({point_digest(one, keep=False), point_digest(one, keep=True), *others}) == 5


def test_the_digest_of_stored_rows_does_not_drift():
    """SHA-256 of `{"loop.rate_hz": 300.0, "seed": 4}`, by hashlib: what changes it makes every stored table stale."""
    assert point_digest(load_config(None, ["loop.rate_hz=300", "seed=4"]), keep=False) == "efdca33ee7c66eee"


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("colour = 'red'", 'sweep.toml: colour: unknown key, got "red"; known are question'),
        ("[grid]\nseed = 3", "sweep.toml: case all: grid.seed: must be a list of numbers, texts or lists, got 3"),
        ("[grid]\nseed = []", "grid.seed: must be a list of numbers, texts or lists, got []"),
        ("[grid]\nloop.rate_hz = [2020-01-01]", "grid.loop.rate_hz: must be a list of numbers, texts or lists"),
        ("[grid]\nseed = [0, 0]", "sweep.toml: points must differ in the letters or digits of a value, got twice all"),
        ("[grid]\nloop.rates_hz = [9]", "case all: loop.rates_hz: unknown key, got 9; did you mean rate_hz?"),
        ("[[case]]\nname = 'b'\n[case.grid]\nseed = [0, -3]", "case b: seed: must be a whole number of at least 0"),
        ("[[case]]\nname = 'b'\nset = ['loop.seconds=-1']", "sweep.toml: case b: loop.seconds: must be a number"),
        ("[[case]]\nname = 'b'\n[[case]]\nname = 'b'", "sweep.toml: case.name: must be unique, got ['b', 'b']"),
        ("[[case]]\nname = '../b'", "case ../b: name: must be letters, digits and . _ + -, got ../b"),
        ("[[case]]\nset = []", "sweep.toml: case[0].name: must be given"),
        ("config = 'none.toml'", "none.toml: no such file"),
        ("keep = 'yes'", 'sweep.toml: keep: must be true or false, got "yes"'),
        ("figures = ['rainbow']", "sweep.toml: figures: must be of"),
        ("[grid", "sweep.toml: must be TOML, got"),
    ],
)
def test_a_wrong_file_is_told_in_a_line_before_anything_starts(tmp_path, body, said):
    result = type_in("sweep", written(tmp_path / "s", body))
    assert result.exit_code == 2
    assert said in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "s" / "results.ecsv").exists()


def test_a_wrong_setting_of_all_points_is_told_as_that(tmp_path):
    result = type_in("sweep", written(tmp_path, "[[case]]\nname = 'b'", ["beam.diameter_m=-3"]))
    assert result.exit_code == 2
    assert "sweep.toml: set: beam.diameter_m: must be a number from 0.01 to 100 [m], got -3" in result.stderr


@pytest.mark.parametrize("path", ["nowhere", "."])
def test_a_sweep_that_is_not_there_is_told(tmp_path, path):
    result = type_in("sweep", tmp_path / path)
    assert result.exit_code == 2
    assert "must exist, got no such file" in result.stderr


def test_the_example_of_the_docs_is_a_sweep(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", (DOCS / "sweeps.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "sweep.toml").write_text(text, encoding="utf-8")
    sweep, points = read_sweep(tmp_path)
    assert [case.name for case in sweep.case] == [case["name"] for case in tomllib.loads(text)["case"]]
    told = (DOCS / "sweeps.md").read_text(encoding="utf-8")
    assert f"{len(points)} points" in told
