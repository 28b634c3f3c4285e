"""What the light and the air refuse: the key, the rule and the value in one line."""

import pytest

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.fresnel import fresnel_transfer
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.errors import SamplingError, SettingsError

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distance_m": INF}, "distance_m: must be a finite length, got inf"),
        ({"distance_m": NAN}, "distance_m: must be a finite length, got nan"),
        ({"wavelength_m": 0.0}, "wavelength_m: must be a positive length, got 0.0"),
        ({"wavelength_m": -1e-6}, "wavelength_m: must be a positive length, got -1e-06"),
        ({"wavelength_m": NAN}, "wavelength_m: must be a positive length, got nan"),
        ({"wavelength_m": INF}, "wavelength_m: must be a positive length, got inf"),
        ({"pixel_m": 0.0}, "grid.pixel_m: must be a positive length, got 0.0"),
    ],
)
def test_impossible_journeys_are_refused(change, message):
    journey = {"distance_m": 1e6, "wavelength_m": 0.85e-6, "pixel_m": 0.1} | change
    with pytest.raises(SamplingError) as refusal:
        fresnel_transfer((4, 5), **journey)
    assert str(refusal.value) == message


@pytest.mark.parametrize(
    ("wavelengths_m", "shares", "message"),
    [
        ((), (), "spectrum.wavelengths_m: must be positive lengths, got ()"),
        ((0.6e-6, 0.0), (0.5, 0.5), "spectrum.wavelengths_m: must be positive lengths, got (6e-07, 0.0)"),
        ((0.6e-6, NAN), (0.5, 0.5), "spectrum.wavelengths_m: must be positive lengths, got (6e-07, nan)"),
        ((INF,), (1.0,), "spectrum.wavelengths_m: must be positive lengths, got (inf,)"),
        ((0.6e-6,), (0.5, 0.5), "spectrum.shares: must be one per wavelength, got (0.5, 0.5)"),
        ((0.6e-6, 0.7e-6), (0.5, 0.6), "spectrum.shares: must be positive and sum to 1, got (0.5, 0.6)"),
        ((0.6e-6, 0.7e-6), (1.5, -0.5), "spectrum.shares: must be positive and sum to 1, got (1.5, -0.5)"),
        ((0.6e-6, 0.7e-6), (NAN, 0.5), "spectrum.shares: must be positive and sum to 1, got (nan, 0.5)"),
    ],
)
def test_impossible_colours_are_refused(wavelengths_m, shares, message):
    with pytest.raises(SettingsError) as refusal:
        Spectrum(wavelengths_m, shares)
    assert str(refusal.value) == message


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Turbulence(0.0), "atmosphere.fried_m: must be a positive length, got 0.0"),
        (lambda: Turbulence(NAN), "atmosphere.fried_m: must be a positive length, got nan"),
        (lambda: Turbulence(0.1, -5e-7), "atmosphere.wavelength_m: must be a positive length, got -5e-07"),
        (
            lambda: Turbulence(0.1, outer_scale_m=-25.0),
            "atmosphere.outer_scale_m: must be a positive length, got -25.0",
        ),
        (
            lambda: Turbulence.from_seeing(seeing_arcsec=0.0),
            "atmosphere.seeing_arcsec: must be a positive angle, got 0.0",
        ),
        (
            lambda: Turbulence.from_rms(opd_rms_m=-1e-9, diameter_m=8.0),
            "atmosphere.opd_rms_nm: must be a positive length, got -1.0",
        ),
        (
            lambda: Turbulence.from_rms(opd_rms_m=6e-7, diameter_m=-8.0),
            "diameter_m: must be a positive length, got -8.0",
        ),
    ],
)
def test_impossible_air_is_refused(make, message):
    with pytest.raises(SettingsError) as refusal:
        make()
    assert str(refusal.value) == message
