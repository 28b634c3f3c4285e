"""Settings read from a file and the command line, written, and fingerprinted."""

import json
import math
import re
import tomllib
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from nlcwfs.config import Config, default_toml, digest, load_config, to_toml
from nlcwfs.config_text import toml_value
from nlcwfs.detector.presets import EMCCD, IDEAL
from nlcwfs.detector.settings import DetectorSettings


def sections(model: type[BaseModel], path: str = "") -> dict[str, type[BaseModel]]:
    """Every section, with those inside it behind it."""
    found = {}
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            found[path + name] = field.annotation
            found |= sections(field.annotation, f"{path}{name}.")
    return found


SECTIONS = sections(Config)


def write(folder: Path, text: str) -> Path:
    path = folder / "star.toml"
    path.write_text(text)
    return path


def test_a_byte_order_mark_and_windows_line_ends_are_fine(tmp_path):
    path = tmp_path / "star.toml"
    path.write_bytes("\ufeffseed = 3\r\n".encode())
    assert load_config(path) == Config(seed=3)


def test_overrides_are_stronger_than_the_file_and_the_last_one_wins(tmp_path):
    path = write(tmp_path, "seed = 1\n[beam]\ndiameter_m = 2\nspider_count = 3\n[atmosphere]\nopd_rms_nm = 609")
    config = load_config(
        path,
        ["beam.diameter_m=4", "beam.diameter_m = 6.5", "beam={spider_width_m=0.1}", "atmosphere.opd_rms_nm="],
    )
    assert (config.seed, config.beam.diameter_m, config.beam.spider_count) == (1, 6.5, 3)
    assert (config.beam.spider_width_m, config.atmosphere.opd_rms_nm) == (0.1, None)


def test_a_preset_from_the_command_line_replaces_what_the_file_says_of_its_keys(tmp_path):
    path = write(tmp_path, to_toml(Config(detector=DetectorSettings(window_pixels=100, em_gain=3))))
    assert load_config(path).detector.em_gain == 3
    config = load_config(path, ["detector.bias_adu=7", "detector.preset=EMCCD"])
    assert config.detector.window_pixels == 100
    assert {key: getattr(config.detector, key) for key in EMCCD} == {**EMCCD, "bias_adu": 7}


@given(
    diameter_m=st.floats(0.01, 100),
    distances_km=st.lists(st.floats(-1e6, 1e6).filter(bool), min_size=1, max_size=6, unique=True),
    seed=st.integers(0, 2**32 - 1),
    bare=st.from_regex(r"[a-zA-Z/_][a-zA-Z0-9/_.,: -]*[a-z]", fullmatch=True).filter(
        lambda text: text not in ("true", "false", "inf", "nan")
    ),
)
def test_what_is_set_is_what_is_used(diameter_m, distances_km, seed, bare):
    config = load_config(
        None,
        [
            f"beam.diameter_m={diameter_m!r}",
            f"curvature_sensor.distances_km={distances_km!r}",
            f"seed={seed}",
            f"beam.pupil_map={bare}",
        ],
    )
    assert (config.beam.diameter_m, config.curvature_sensor.distances_km) == (diameter_m, tuple(distances_km))
    assert (config.seed, config.beam.pupil_map) == (seed, Path(bare))
    assert tomllib.loads(to_toml(config))["seed"] == seed
    with_all = [f"{section}={toml_value(value)}" for section, value in tomllib.loads(to_toml(config)).items()]
    assert load_config(None, with_all) == config


@given(text=st.text(st.characters(exclude_categories=["Cs"])))
def test_any_text_survives_as_toml(text):
    assert tomllib.loads(f"x = {toml_value(text)}") == {"x": text}


def test_the_default_text_reads_back_as_the_defaults(tmp_path):
    assert load_config(write(tmp_path, default_toml())) == Config()


def test_the_default_text_names_every_key_under_a_comment():
    lines = default_toml().splitlines()
    for name, section in SECTIONS.items():
        start = lines.index(f"[{name}]")
        for key in section.model_fields:
            if f"{name}.{key}" not in SECTIONS:
                line = next(n for n, text in enumerate(lines) if n > start and re.match(rf"#?{key} = ", text))
                assert lines[line - 1].startswith("# ")
    assert [text[1:-1] for text in lines if text.startswith("[")] == list(SECTIONS) == sorted(SECTIONS)
    assert max(map(len, lines)) <= 100


def test_each_commented_key_of_the_default_text_can_be_uncommented_alone(tmp_path):
    lines = default_toml().splitlines()
    commented = [n for n, text in enumerate(lines) if re.match(r"#\w+ = ", text)]
    assert len(commented) >= len(IDEAL) + 4  # outer scale, rms, pupil map, flux fractions
    for n in commented:
        text = "\n".join([*lines[:n], lines[n][1:], *lines[n + 1 :]])
        used = to_toml(load_config(write(tmp_path, text))).splitlines()
        if lines[n].startswith("#defocus_waves"):  # becomes distances: 64 / (8 * 0.85e-6 * 2) is 4706 km
            assert any(line.startswith("distances_km = [-4705.88") for line in used)
        else:
            assert lines[n][1:] in used


def test_a_configuration_as_used_reads_back_as_itself(tmp_path):
    config = load_config(
        None,
        [
            "detector.preset=qCMOS",
            "beam.pupil_map='a \"b\".fits'",
            "atmosphere.outer_scale_m=1e-7",
            "curvature_sensor.flux_fractions=[0.1,0.2,0.3,0.4]",
        ],
    )
    again = load_config(write(tmp_path, to_toml(config)))
    assert again == config
    assert digest(again) == digest(config)


def test_no_optional_key_has_a_default_that_toml_cannot_take_away():
    for section in SECTIONS.values():
        for key, field in section.model_fields.items():
            if type(None) in get_args(field.annotation):
                assert field.default is None, key


@pytest.mark.parametrize("name", SECTIONS)
def test_every_section_refuses_unknown_keys_changes_and_infinite_numbers(name):
    section = SECTIONS[name]
    assert section.model_config["extra"] == "forbid"
    assert section.model_config["frozen"]
    assert section.model_fields
    for key, field in section.model_fields.items():
        if float in (field.annotation, *get_args(field.annotation)):
            for bad in [math.nan, math.inf, -math.inf]:
                if key == "full_well_electrons" and bad == math.inf:  # no limit
                    continue
                with pytest.raises(ValidationError):
                    section(**{key: bad})


@pytest.mark.parametrize("name", SECTIONS)
def test_every_key_has_a_description_and_optional_ones_an_example(name):
    for key, field in SECTIONS[name].model_fields.items():
        if f"{name}.{key}" in SECTIONS:
            continue
        assert field.description, key
        assert field.get_default() is not None or field.examples, key


def test_the_digest_does_not_know_the_order_of_keys(tmp_path):
    one = load_config(write(tmp_path, "seed = 4\n[beam]\ndiameter_m = 2\nspider_count = 1"))
    other = load_config(write(tmp_path, "beam = {spider_count = 1, diameter_m = 2.0}\nseed = 4"))
    assert digest(one) == digest(other)
    assert re.fullmatch(r"[0-9a-f]{16}", digest(one))


@pytest.mark.parametrize("override", ["seed=1", "precision=double", "beam.diameter_m=8.1", "detector.bias_adu=1"])
def test_the_digest_sees_every_change(override):
    assert digest(load_config(None, [override])) != digest(Config())


def test_the_schema_is_json():
    schema = json.loads(json.dumps(Config.model_json_schema()))
    assert list(schema["properties"]) == list(Config.model_fields)
    assert schema["additionalProperties"] is False
