"""What a user may choose about the detector, and what a preset does to it."""

import math

import pytest
from pydantic import ValidationError

from nlcwfs.detector.presets import PRESETS
from nlcwfs.detector.settings import DetectorSettings


def test_the_default_detector_has_photon_noise_only():
    settings = DetectorSettings()
    assert (settings.preset, settings.quantum_efficiency, settings.em_gain) == ("ideal", 1.0, 1.0)
    assert settings.read_noise_electrons == settings.dark_electrons == settings.background_photons == 0
    assert settings.full_well_electrons == math.inf
    assert settings.bits == 0
    assert (settings.pixels_across_pupil, settings.window_pixels) == (90, 128)


def test_a_preset_fills_what_the_user_has_not_set_and_nothing_else():
    settings = DetectorSettings(preset="EMCCD", read_noise_electrons=50, window_pixels=64)
    assert settings.read_noise_electrons == 50
    assert settings.window_pixels == 64
    assert settings.em_gain == 600
    assert settings.bits == 14


def test_a_user_may_set_a_preset_s_number_back_to_ideal():
    settings = DetectorSettings(preset="qCMOS", quantum_efficiency=1.0, read_noise_electrons=0.0)
    assert settings.quantum_efficiency == 1
    assert settings.read_noise_electrons == 0
    assert settings.bits == 16


def test_custom_starts_from_the_ideal_detector():
    custom, ideal = DetectorSettings(preset="custom"), DetectorSettings()
    assert custom.model_dump(exclude={"preset"}) == ideal.model_dump(exclude={"preset"})


def test_none_removes_a_limit_that_a_preset_has():
    settings = DetectorSettings(preset="qCMOS", bits=None, full_well_electrons=None)
    assert settings.bits == 0
    assert settings.full_well_electrons == math.inf


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_written_out_whole_come_back_the_same(preset):
    settings = DetectorSettings(preset=preset, dark_electrons=0.25)
    assert DetectorSettings(**settings.model_dump()) == settings


@pytest.mark.parametrize("field", DetectorSettings.model_fields)
def test_every_key_explains_itself(field):
    description = DetectorSettings.model_fields[field].description
    assert description is not None
    assert description.endswith(".")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("pixels_across_pupil", 0),
        ("window_pixels", 1),
        ("window_pixels", 12.5),
        ("quantum_efficiency", 0.0),
        ("quantum_efficiency", 1.01),
        ("background_photons", -1.0),
        ("dark_electrons", math.nan),
        ("read_noise_electrons", math.inf),
        ("em_gain", 0.5),
        ("gain_electrons_per_adu", 0.0),
        ("full_well_electrons", 0.0),
        ("full_well_electrons", math.nan),
        ("bits", 21),
        ("bias_adu", -1.0),
        ("preset", "ccd"),
        ("preset", ["EMCCD"]),
        ("read_noise_e", 1.0),  # no such key
    ],
)
def test_a_bad_value_is_refused_under_its_own_key(key, value):
    with pytest.raises(ValidationError) as caught:
        DetectorSettings(**{key: value})
    assert [error["loc"] for error in caught.value.errors()] == [(key,)]


def test_a_bias_beyond_the_converter_is_refused():
    with pytest.raises(ValidationError, match="bias_adu must be below the highest code of 8 bits"):
        DetectorSettings(bits=8, bias_adu=255)
