"""Glasses against the maker's n_d and Abbe number, and lenses against the law that they should follow."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlcwfs.curvature_sensor.chromatic_lenses import Doublet, LensLaw
from nlcwfs.curvature_sensor.glasses import GLASSES, refractive_index
from nlcwfs.errors import SettingsError

YELLOW, BLUE, RED = 0.5875618, 0.4861327, 0.6562725  # Fraunhofer's d, F and C in um

CATALOGUE = {  # n_d and Abbe number as printed by SCHOTT; the last two by their sellers (Heraeus, Corning)
    "N-BK7": (1.51680, 64.17),
    "N-FK51A": (1.48656, 84.47),
    "N-FK58": (1.45600, 90.90),
    "N-PK52A": (1.49700, 81.61),
    "N-LAK22": (1.65113, 55.89),
    "N-SK16": (1.62041, 60.32),
    "N-BAK4": (1.56883, 55.98),
    "N-KZFS4": (1.61336, 44.49),
    "F2": (1.62004, 36.37),
    "N-SF5": (1.67271, 32.25),
    "N-SF6": (1.80518, 25.36),
    "N-SF11": (1.78472, 25.68),
    "N-SF66": (1.92286, 20.88),
    "N-LASF9": (1.85025, 32.17),
    "silica": (1.45846, 67.82),
    "CaF2": (1.43384, 94.99),
}


def test_the_catalogue_of_the_test_is_that_of_the_package():
    assert set(CATALOGUE) == set(GLASSES)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_glass_has_the_index_and_the_abbe_number_of_its_data_sheet(name):
    index, abbe = CATALOGUE[name]
    yellow, blue, red = (float(refractive_index(name, line)) for line in (YELLOW, BLUE, RED))
    assert yellow == pytest.approx(index, abs=1.5e-5)  # five decimals are printed
    assert (yellow - 1) / (blue - red) == pytest.approx(abbe, abs=0.011)  # as printed


@given(name=st.sampled_from(sorted(GLASSES)), share=st.floats(0, 1), step=st.floats(1e-3, 0.5))
def test_the_index_falls_with_the_wavelength(name, share, step):
    low_um, high_um = GLASSES[name].range_um
    first = low_um + share * (high_um - low_um) / (1 + step)
    second = min(high_um, first * (1 + step))
    if second > first:
        assert refractive_index(name, first) > refractive_index(name, second) > 1


def test_a_glass_that_there_is_not_is_refused():
    with pytest.raises(SettingsError, match=r"^curvature_sensor\.glasses: must be two of N-BK7, .*, CaF2, got BK8$"):
        refractive_index("BK8", 0.6)


def test_a_wavelength_without_data_is_refused():
    message = "curvature_sensor.glasses: must have data at every wavelength of the light; those of N-SF66 are for 0.39 "
    with pytest.raises(SettingsError) as refusal:
        refractive_index("N-SF66", np.array([0.5, 0.38]))
    assert str(refusal.value) == f"{message}to 2.5 um, got light at 0.38 um"
    with pytest.raises(SettingsError, match=r"got light at nan um"):
        refractive_index("N-SF66", float("nan"))


# ------------------------------------------------------------------------------------------------- lenses


@given(wavelength_um=st.floats(0.4, 2.4), distance_m=st.floats(-4e6, 4e6))
def test_ideal_lenses_keep_wavelength_times_distance(wavelength_um, distance_m):
    law = LensLaw("ideal", wavelength_m=0.85e-6)
    there = law.distances_m((distance_m, 1.0), (wavelength_um * 1e-6,))[0, 0]
    assert there * wavelength_um == pytest.approx(distance_m * 0.85, rel=1e-14, abs=1e-300)  # rounding
    assert LensLaw("achromatic", 0.85e-6).distances_m((distance_m,), (wavelength_um * 1e-6,))[0, 0] == distance_m


@pytest.mark.parametrize("glasses", [("N-FK51A", "N-SF66"), ("N-SF11", "N-BK7"), ("silica", "CaF2")])
def test_the_powers_of_a_doublet_are_those_of_its_glasses(glasses):
    """The distance at a colour, from the lens maker's formula with curvatures that follow from the powers."""
    doublet = Doublet.fitted(glasses, wavelength_m=0.85e-6, ends_m=(0.765e-6, 0.935e-6))
    focus_m = 4.0
    total = 0.0
    for share, glass in zip(doublet.powers, glasses, strict=True):
        curvature = share / focus_m / (refractive_index(glass, 0.85) - 1)
        total += (refractive_index(glass, 0.8) - 1) * curvature
    law = LensLaw("doublet", 0.85e-6, doublet)
    assert law.distances_m((focus_m,), (0.8e-6,))[0, 0] == pytest.approx(1 / total, rel=1e-9)
    assert law.distances_m((focus_m,), (0.85e-6,))[0, 0] == pytest.approx(focus_m, rel=1e-12)  # the reference


def test_no_other_powers_are_nearer_to_the_law():
    ends_m = (0.7e-6, 1.0e-6)
    colours_m = np.linspace(*ends_m, 65)
    doublet = Doublet.fitted(("N-BK7", "F2"), wavelength_m=0.85e-6, ends_m=ends_m)
    indices = np.stack([refractive_index(glass, colours_m * 1e6) - 1 for glass in doublet.glasses])
    at_reference = np.array([refractive_index(glass, 0.85) - 1 for glass in doublet.glasses])

    def misfit(powers):
        return np.sum((powers @ (indices / at_reference[:, None]) / (colours_m / 0.85e-6) - 1) ** 2)

    best = min(np.linspace(0.9, 1.1, 2001), key=lambda scale: misfit(scale * np.array(doublet.powers)))
    least = misfit(best * np.array(doublet.powers))
    for step in ([0.05, 0.0], [0.0, 0.05], [-0.05, 0.0], [0.0, -0.05], [0.05, -0.05], [-0.05, 0.05]):
        assert misfit(best * np.array(doublet.powers) + step) > least


def test_a_doublet_is_nearer_to_the_law_than_achromatic_lenses():
    ends_m = (0.68e-6, 1.02e-6)
    law = LensLaw.of_glasses(("N-FK51A", "N-SF66"), wavelength_m=0.85e-6, ends_m=ends_m)
    errors = law.scale(ends_m) * np.array(ends_m) / 0.85e-6 - 1
    assert np.abs(errors).max() == pytest.approx(law.doublet.worst(ends_m))
    assert 0.05 < np.abs(errors).max() < 0.08  # achromatic: 0.2


def test_a_band_that_the_glasses_cannot_serve_is_refused_with_how_much():
    with pytest.raises(SettingsError) as refusal:
        LensLaw.of_glasses(("N-FK51A", "N-SF66"), wavelength_m=0.7e-6, ends_m=(0.5e-6, 1.0e-6))
    rule = "curvature_sensor.glasses: must keep wavelength times distance within 10 % over the band"
    assert str(refusal.value) == f"{rule}, got 25 % at 0.5 um with N-FK51A and N-SF66"


def test_two_lenses_of_one_glass_are_refused():
    with pytest.raises(SettingsError, match=r"must be two different glasses, got \['F2', 'F2'\]"):
        Doublet.fitted(("F2", "F2"), wavelength_m=0.85e-6, ends_m=(0.7e-6, 1e-6))
