"""Stars in photons a second, against numbers worked out by hand and those of the field."""

import itertools
from typing import get_args

import pytest

from nlcwfs.atmosphere.settings import AtmosphereSettings, StarSettings
from nlcwfs.atmosphere.star import BANDS, collecting_area_m2, photons_per_s
from nlcwfs.config import Config, digest, load_config
from nlcwfs.config_messages import ConfigError
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.starlight import starlight_per_s, with_exposures_of

# f_lambda of magnitude 0 in 1e-8 W / m^2 / um (Bessell, Castelli & Plez 1998, table A2): the same zero points, quoted
# per wavelength.
PER_MICROMETRE = {"U": 4.175, "B": 6.32, "V": 3.631, "R": 2.177, "I": 1.126, "J": 0.3147, "H": 0.1138, "K": 0.03961}


def test_magnitude_zero_is_8_8e9_photons_in_v():
    assert photons_per_s(0.0, band="V", area_m2=1.0, throughput=1.0) == pytest.approx(8.8e9, rel=0.02)


def test_guyon_s_star_of_magnitude_13():
    """An 8 m telescope, 20 % throughput, 0.5 um wide: about 3e6 photons a second (Guyon 2010)."""
    area_m2 = collecting_area_m2(diameter_m=8.0)
    found = photons_per_s(13.0, band="V", area_m2=area_m2, throughput=0.2, bandwidth_um=0.5)
    assert found == pytest.approx(3e6, rel=0.25)
    # By hand: 3636e-26 / 6.62607e-34 = 5.4874e10; / 0.545 * 0.5 = 5.0343e10; * 50.265 * 0.2 = 5.0610e11; * 10^-5.2.
    assert found == pytest.approx(5.0610e11 * 6.30957e-6, rel=1e-4)


@pytest.mark.parametrize("band", list(PER_MICROMETRE))
def test_zero_points_per_frequency_and_per_wavelength_agree(band):
    """Photons per um = f_lambda lambda / (h c), a way that does not pass through janskys."""
    photon_j = 6.62607015e-34 * 299792458 / (BANDS[band].wavelength_um * 1e-6)
    expected = PER_MICROMETRE[band] * 1e-8 / photon_j
    found = photons_per_s(0.0, band=band, area_m2=1.0, throughput=1.0, bandwidth_um=1.0)
    # The wavelength that turns one into the other is the pivot of the band, not the effective one of an A0 star.
    assert found == pytest.approx(expected, rel=0.05 if band == "U" else 0.03)


def test_bands_follow_each_other_and_do_not_lie_within_each_other():
    assert "".join(BANDS) == "UBVRIJHK"
    bands = list(BANDS.values())
    for blue, red in itertools.pairwise(bands):
        assert blue.wavelength_um < red.wavelength_um
        assert red.wavelength_um - blue.wavelength_um > 0.6 * (blue.width_um + red.width_um) / 2


def test_five_magnitudes_are_a_factor_of_a_hundred_and_the_rest_is_proportional():
    def star(magnitude=9.0, **changes):
        return photons_per_s(magnitude, **{"band": "I", "area_m2": 2.0, "throughput": 0.3, **changes})

    assert star(4.0) == pytest.approx(100 * star(9.0), rel=1e-12)
    assert star(area_m2=5.0) == pytest.approx(2.5 * star(), rel=1e-12)
    assert star(throughput=0.6) == pytest.approx(2 * star(), rel=1e-12)
    assert star(bandwidth_um=0.298) == pytest.approx(2 * star(), rel=1e-12)  # I is 0.149 um wide


def test_the_area_of_an_annulus():
    assert collecting_area_m2(diameter_m=2.0) == pytest.approx(3.14159265, rel=1e-8)
    assert collecting_area_m2(diameter_m=8.0, obstruction_ratio=0.5) == pytest.approx(50.26548 * 0.75, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"band": "v"}, "star.band: must be one of U, B, V, R, I, J, H, K, got v"),
        ({"magnitude": float("nan")}, "star.magnitude: must be between -30 and 60, got nan"),
        ({"area_m2": 0.0}, "star.area_m2: must be a positive area, got 0.0"),
        ({"throughput": 20.0}, "star.throughput: must be greater than 0 and at most 1, got 20.0"),
        ({"bandwidth_um": 500.0}, "star.bandwidth_um: must be greater than 0 and at most 10 um, got 500.0"),
    ],
)
def test_bad_numbers_give_one_line(changes, line):
    values = {"magnitude": 8.0, "band": "V", "area_m2": 50.0, "throughput": 0.2, **changes}
    with pytest.raises(SettingsError) as error:
        photons_per_s(values.pop("magnitude"), **values)
    assert str(error.value) == line


@pytest.mark.parametrize(
    ("shape", "line"),
    [
        ({"diameter_m": -1.0}, "diameter_m: must be a positive length, got -1.0"),
        ({"diameter_m": 8.0, "obstruction_ratio": 1.0}, "obstruction_ratio: must be at least 0 and below 1, got 1.0"),
    ],
)
def test_a_telescope_that_cannot_be_is_refused(shape, line):
    with pytest.raises(SettingsError) as error:
        collecting_area_m2(**shape)
    assert str(error.value) == line


def test_settings_know_every_band():
    (allowed,) = (one for one in get_args(StarSettings.model_fields["band"].annotation) if one is not type(None))
    assert set(get_args(allowed)) == set(BANDS)


def test_what_is_left_out_is_the_star_of_the_paper():
    """3.2e6 photons a second from m_V 13 on 8 m (Guyon 2010, Fig. 5); 2 %: its zero point and two digits."""
    config = load_config(None, ["atmosphere.star.magnitude=13"])
    assert starlight_per_s(config) == pytest.approx(3.2e6, rel=0.02)
    assert with_exposures_of(config, 250.0).atmosphere.photons == pytest.approx(3.2e6 / 250, rel=0.02)


def test_a_number_of_photons_stays_itself():
    assert starlight_per_s(Config()) is None
    assert with_exposures_of(Config(), 50.0) == Config()
    assert starlight_per_s(load_config(None, ["atmosphere.photons_per_s=7e5"])) == 7e5


def test_a_star_that_is_not_told_is_not_in_the_fingerprint():
    assert "star" not in AtmosphereSettings().model_dump()
    for change in ("atmosphere.star.magnitude=13", "atmosphere.star={magnitude=13, band='R'}"):
        changed = load_config(None, [change])
        assert digest(changed) != digest(Config())
        assert Config.model_validate(changed.model_dump()) == changed


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (
            ["atmosphere.star.magnitude=13", "atmosphere.photons_per_s=3e6"],
            "atmosphere.photons_per_s: must be left out with atmosphere.star.magnitude, which rules instead, "
            "got 3000000.0",
        ),
        (["atmosphere.star.magnitude=99"], "atmosphere.star.magnitude: must be a number from -30 to 60, got 99"),
        (
            ["atmosphere.star.magnitude=3", "atmosphere.star.band=Z"],
            'atmosphere.star.band: must be "U", "B", "V", "R", "I", "J", "H" or "K", got "Z"',
        ),
        (
            ["atmosphere.star.magnitude=3", "atmosphere.star.throughput=2"],
            "atmosphere.star.throughput: must be a number greater than 0 and at most 1, got 2",
        ),
    ],
)
def test_a_star_that_cannot_be_is_told_in_a_line(overrides, line):
    with pytest.raises(ConfigError) as error:
        load_config(None, overrides)
    assert str(error.value) == line
