"""Settings of the beam: the paper's defaults, and every wrong value named by its key."""

import pydantic
import pytest

from nlcwfs.beam.settings import BeamSettings


def test_defaults_are_table_1_of_the_paper():
    settings = BeamSettings()
    assert (settings.diameter_m, settings.wavelength_um) == (8.0, 0.85)
    assert (settings.obstruction_ratio, settings.spider_count, settings.pupil_map) == (0.0, 0, None)


def test_every_key_is_described():
    assert all(field.description for field in BeamSettings.model_fields.values())


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
