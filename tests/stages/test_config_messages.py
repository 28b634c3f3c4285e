"""Bad settings: each is one line with the path of the key, the rule and the value."""

import json
import pickle
import re
import tomllib
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nlcwfs.config import Config, load_config
from nlcwfs.config_messages import problems_in_words, unknown_key
from nlcwfs.config_text import plain_toml
from nlcwfs.detector.settings import DetectorSettings
from nlcwfs.errors import FileFormatError, SettingsError


def write(folder: Path, text: str) -> Path:
    path = folder / "star.toml"
    path.write_text(text)
    return path


def complaint(path: Path | None, *overrides: str) -> str:
    with pytest.raises(SettingsError) as caught:
        load_config(path, overrides)
    return str(caught.value)


BAD_VALUES = {
    # wrong type: neither text nor true passes for a number
    '[beam]\ndiameter_m = "8"': 'beam.diameter_m: must be a number from 0.01 to 100 [m], got "8"',
    "[atmosphere]\nphotons = true": "atmosphere.photons: must be a number greater than 0, got true",
    "seed = 1.5": "seed: must be a whole number of at least 0 and below 4294967296, got 1.5",
    "[beam]\npupil_map = 3": "beam.pupil_map: must be a path, as text, got 3",
    "[beam]\nspider_count = 2020-01-01": ('beam.spider_count: must be a whole number from 0 to 64, got "2020-01-01"'),
    "beam = 3": "beam: must be a section of keys, got 3",
    "[[beam]]\ndiameter_m = 8": "beam: must be a section of keys, got [{diameter_m = 8}]",
    "[curvature_sensor]\ndistances_km = 3500": (
        "curvature_sensor.distances_km: must be a list of 1 or more numbers from -1000000 to 1000000 [km], got 3500"
    ),
    '[curvature_sensor]\ndistances_km = [1, "2"]': (
        'curvature_sensor.distances_km[1]: must be a number from -1000000 to 1000000 [km], got "2"'
    ),
    # wrong value
    "[atmosphere]\nphotons = -3": "atmosphere.photons: must be a number greater than 0, got -3",
    "[atmosphere]\nphotons = inf": "atmosphere.photons: must be a finite number, got inf",
    "[atmosphere]\nphotons = nan": "atmosphere.photons: must be a finite number, got nan",
    "[atmosphere]\nseeing_arcsec = 12.0": (
        "atmosphere.seeing_arcsec: must be a number greater than 0 and at most 10 [arcsec], got 12.0"
    ),
    'precision = "half"': 'precision: must be "single" or "double", got "half"',
    "[simulation]\nlight_oversampling = 1": (
        "simulation.light_oversampling: must be a whole number from 2 to 32, got 1"
    ),
    # a value that makes sense in another unit only
    "[beam]\nwavelength_um = 0.85e-6": ("beam.wavelength_um: must be a number from 0.2 to 30 [um], got 8.5e-07"),
    "[beam]\nwavelength_um = 850": "beam.wavelength_um: must be a number from 0.2 to 30 [um], got 850",
    "[curvature_sensor]\ndistances_km = [3.5e6]": (
        "curvature_sensor.distances_km[0]: must be a number from -1000000 to 1000000 [km], got 3500000.0"
    ),
    "[curvature_sensor]\ndistances_km = []": (
        "curvature_sensor.distances_km: must be a list of 1 or more numbers from -1000000 to 1000000 [km], got []"
    ),
    "[beam]\ndiameter_m = 8000": "beam.diameter_m: must be a number from 0.01 to 100 [m], got 8000",
    # rules between keys
    "[curvature_sensor]\ndistances_km = [2, 2]": (
        "curvature_sensor.distances_km: must differ from each other, got [2, 2]"
    ),
    "[beam]\nspider_count = 4\ndiameter_m = 0.04": (
        "beam.spider_width_m: must be smaller than diameter_m, got its default"
    ),
    "[detector]\nwindow_pixels = 40": (
        "detector.window_pixels: must be at least detector.pixels_across_pupil (90) to hold the pupil, got 40"
    ),
}

UNKNOWN_KEYS = {
    # wrong unit in the name
    "[beam]\nwavelength_nm = 650": (
        "beam.wavelength_nm: unknown key, got 650; the unit is in the name: did you mean wavelength_um [um]?"
    ),
    "[beam]\nwavelength = 0.65": (
        "beam.wavelength: unknown key, got 0.65; the unit is in the name: did you mean wavelength_um [um]?"
    ),
    "[curvature_sensor]\ndistance_m = [3.5e6]": (
        "curvature_sensor.distance_m: unknown key, got [3500000.0]; "
        "the unit is in the name: did you mean distances_km [km]?"
    ),
    "[beam]\nseeing_mas = 600": (
        "beam.seeing_mas: unknown key, got 600; "
        "the unit is in the name: did you mean atmosphere.seeing_arcsec [arcsec]?"
    ),
    # misspelt
    "[beam]\nwavelenght_um = 0.65": "beam.wavelenght_um: unknown key, got 0.65; did you mean wavelength_um?",
    "[atmosfere]\nphotons = 3": "atmosfere: unknown key, got {photons = 3}; did you mean atmosphere?",
    "wavelenght_um = 0.65": "wavelenght_um: unknown key, got 0.65; did you mean beam.wavelength_um?",
    # in the wrong section
    "wavelength_um = 0.65": "wavelength_um: unknown key, got 0.65; did you mean beam.wavelength_um?",
    "[atmosphere]\ndiameter_m = 8": ("atmosphere.diameter_m: unknown key, got 8; did you mean beam.diameter_m?"),
    # nothing like it
    "[simulation]\nzzz = 1": (
        "simulation.zzz: unknown key, got 1; known are frames, light_oversampling, light_window, rate_hz, substeps"
    ),
    '[simulation]\n"two\\nlines" = 1': (
        'simulation."two\\nlines": unknown key, got 1; known are frames, light_oversampling, light_window, rate_hz, '
        "substeps"
    ),
}


@pytest.mark.parametrize(("text", "expected"), [*BAD_VALUES.items(), *UNKNOWN_KEYS.items()])
def test_a_bad_setting_is_one_line_with_its_path_the_rule_and_the_value(tmp_path, text, expected):
    assert complaint(write(tmp_path, text)) == expected


def test_every_problem_has_a_line(tmp_path):
    path = write(tmp_path, "seed = -1\n[beam]\ndiameter = 8\n[detector]\nbits = true\n")
    assert complaint(path, "atmosphere.photons=0").splitlines() == [
        "seed: must be a whole number of at least 0 and below 4294967296, got -1",
        "atmosphere.photons: must be a number greater than 0, got 0",
        "beam.diameter: unknown key, got 8; the unit is in the name: did you mean diameter_m [m]?",
        f"detector.bits: must be a whole number from 0 to {_most_bits()}, got true",
    ]


def _most_bits() -> int:
    return DetectorSettings.model_json_schema()["properties"]["bits"]["maximum"]


def test_a_long_value_is_cut(tmp_path):
    text = complaint(write(tmp_path, f"[beam]\ndiameter_m = {[0.5] * 1000}"))
    assert text.startswith("beam.diameter_m: must be a number from 0.01 to 100 [m], got [0.5, 0.5,")
    assert text.endswith("...")
    assert len(text) < 150


def test_the_lines_survive_the_way_to_another_process(tmp_path):
    with pytest.raises(SettingsError) as caught:
        load_config(None, ["beam.diameter_m=0"])
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.problems) == (str(caught.value), caught.value.problems)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"seed = 1\n\n[beam\ndiameter_m = 8\n", r"not valid TOML: .*line 3, column 6.*"),
        (b"seed = 1\nseed = 2\n", r"not valid TOML: cannot overwrite a value \(at line 2, column 9\)"),
        (b"seed = ", r"not valid TOML: invalid value \(at line 1, the end\)"),
        (b"a = " + b"[" * 100_000, r"not valid TOML: .*"),
        (b"seed = " + b"9" * 10_000, r"not valid TOML: .*"),
        ("# µm\n".encode("latin-1"), r"must be UTF-8 text, got byte 0xb5"),
    ],
)
def test_a_file_that_is_not_toml_is_one_line_that_names_it(tmp_path, content, expected):
    path = tmp_path / "star.toml"
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        load_config(path)
    assert re.fullmatch(re.escape(f"{path}: ") + expected, str(caught.value))


def test_a_file_that_cannot_be_read_is_one_line_that_names_it(tmp_path):
    with pytest.raises(FileFormatError) as caught:
        load_config(tmp_path / "none.toml")
    assert str(caught.value) == f"{tmp_path / 'none.toml'}: no such file"
    with pytest.raises(FileFormatError) as caught:
        load_config(tmp_path)
    assert str(caught.value) == f"{tmp_path}: cannot be read: Is a directory"


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("beam.diameter_m", "--set: must be section.key=value, got beam.diameter_m"),
        ("beam.pupil_map=\udcb5.fits", "--set: must be UTF-8 text, got 'beam.pupil_map=\\udcb5.fits'"),
        ("=3", "--set: must be section.key=value, got =3"),
        ("beam..diameter_m=3", "--set: must be section.key=value, got beam..diameter_m=3"),
        (
            "beam.aperture_m=",
            "beam.aperture_m: unknown key, got nothing; known are diameter_m, obstruction_ratio, "
            "spider_count, spider_width_m, spider_angle_deg, pupil_map, segments, wavelength_um, spectrum",
        ),
        ("beam.diameter_m.x=3", "beam.diameter_m: must be a number from 0.01 to 100 [m], got {x = 3}"),
        ("beam=3", "beam: must be a section of keys, got 3"),
        (
            "beam.diameter_m=8\nseed=3",
            'beam.diameter_m: must be a number from 0.01 to 100 [m], got "8\\nseed=3"',
        ),
        ("beam.diameter_m=eight", 'beam.diameter_m: must be a number from 0.01 to 100 [m], got "eight"'),
        ("atmosphere.photons=[1,", 'atmosphere.photons: must be a number greater than 0, got "[1,"'),
    ],
)
def test_a_bad_override_is_one_line(override, expected):
    assert complaint(None, override) == expected


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["inner"] = "inner"
    width_px: int = Field(default=2, multiple_of=2)


class Other(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["other"] = "other"


class Outer(BaseModel):
    """Kinds of settings that no stage has yet."""

    model_config = ConfigDict(extra="forbid")
    inner: Inner | Other = Inner()
    start: Literal["flat"] | Annotated[float, Field(gt=0)] = "flat"
    pair: tuple[float, float] = (1.0, 2.0)
    names: list[str] = Field(default=[], max_length=3)
    needed: int


@pytest.mark.parametrize(
    ("given_settings", "expected"),
    [
        ({}, ["needed: must be given"]),
        ({"needed": 1, "start": "x"}, ['start: must be "flat" or a number greater than 0, got "x"']),
        ({"needed": 1, "start": -1.0}, ['start: must be "flat" or a number greater than 0, got -1.0']),
        ({"needed": 1, "pair": [1, 2, 3]}, ["pair: must be a list of 2 numbers, got [1, 2, 3]"]),
        (
            {"needed": 1, "names": ["a"] * 4},
            ['names: must be a list of 0 to 3 texts, got ["a", "a", "a", "a"]'],
        ),
        (
            {"needed": 1, "inner": {"kind": "inner", "width_px": 3}},
            [
                "inner.width_px: must be a whole number divisible by 2, got 3",
                'inner.kind: must be "other", got "inner"',
                "inner.width_px: unknown key, got 3",
            ],
        ),
    ],
)
def test_other_kinds_of_settings_are_also_said_in_words(given_settings, expected):
    with pytest.raises(ValidationError) as caught:
        Outer.model_validate_json(json.dumps(given_settings), strict=True)
    assert problems_in_words(Outer, caught.value) == expected


def test_a_known_key_is_not_unknown():
    assert unknown_key(Config, ["beam", "diameter_m"], 3) is None


def test_sections_inside_sections_are_written_as_tables():
    text = plain_toml(Outer(needed=3))
    assert tomllib.loads(text) == Outer(needed=3).model_dump(mode="json")
