"""Settings of the beam: the paper's defaults, and every wrong value named by its key."""

import pydantic
import pytest

from nlcwfs.beam.settings import BeamSettings, SegmentsSettings, SpectrumSettings


def test_defaults_are_table_1_of_the_paper():
    settings = BeamSettings()
    assert (settings.diameter_m, settings.wavelength_um) == (8.0, 0.85)
    assert (settings.obstruction_ratio, settings.spider_count, settings.pupil_map) == (0.0, 0, None)


def test_every_key_is_described():
    parts = {"spectrum": SpectrumSettings, "segments": SegmentsSettings}
    assert all(field.description for name, field in BeamSettings.model_fields.items() if name not in parts)
    assert all(field.description for part in parts.values() for field in part.model_fields.values())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("diameter_m", 0.0),
        ("diameter_m", float("inf")),
        ("diameter_m", "eight"),
        ("obstruction_ratio", 1.0),
        ("spider_count", -1),
        ("spider_width_m", 0.0),
        ("spider_angle_deg", 400.0),
        ("wavelength_um", 850.0),
        ("wavelength_nm", 850.0),
    ],
)
def test_a_wrong_value_is_named_by_its_key(key, value):
    with pytest.raises(pydantic.ValidationError) as caught:
        BeamSettings(**{key: value})
    assert [error["loc"] for error in caught.value.errors()] == [(key,)]


def test_a_vane_wider_than_the_telescope_is_refused():
    with pytest.raises(pydantic.ValidationError, match="spider_width_m must be smaller"):
        BeamSettings(spider_count=1, spider_width_m=9.0)


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"shape": "flat"}, "bandwidth_um must be given for light of shape flat"),
        ({"shape": "black-body"}, "bandwidth_um must be given for light of shape black-body"),
        ({"shape": "table"}, "table must be given for light of shape table"),
        ({"bandwidth_um": 0.1, "bandwidth_ratio": 0.1}, "bandwidth_ratio must be left out with bandwidth_um"),
        ({"bandwidth_ratio": 2.0}, "less than 2"),
        ({"temperature_k": 0.0}, "greater than 0"),
        ({"wavelengths": 129}, "less than or equal to 128"),
    ],
)
def test_colours_that_are_not_told_are_refused(values, problem):
    with pytest.raises(pydantic.ValidationError, match=problem):
        SpectrumSettings(**values)


def test_a_width_is_told_in_two_ways():
    assert SpectrumSettings(bandwidth_um=0.3).bandwidth_um_at(0.85) == 0.3
    assert SpectrumSettings(bandwidth_ratio=0.5).bandwidth_um_at(0.65) == pytest.approx(0.325)
    assert SpectrumSettings().bandwidth_um_at(0.65) == 0
