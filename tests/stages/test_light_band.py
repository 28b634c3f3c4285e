"""Light of a band, and the few wavelengths that stand for it: against Gauss and Legendre, integrals, and bad tables."""

import numpy as np
import pytest
import scipy.integrate
from astropy.table import Table

from nlcwfs.beam.light_band import LightBand, read_spectrum_table
from nlcwfs.errors import FileFormatError, SettingsError

RED = {"wavelength_m": 0.85e-6, "bandwidth_m": 0.34e-6}
PLANCK_M_K = 1.438776877e-2  # second radiation constant h c / k, CODATA 2018


def planck_photons(wavelength_m, temperature_k):
    return wavelength_m**-4 / np.expm1(PLANCK_M_K / (wavelength_m * temperature_k))


@pytest.mark.parametrize("count", [1, 2, 5, 16, 64])
def test_flat_light_is_sampled_by_gauss_and_legendre(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    spectrum = LightBand.flat(**RED).spectrum(count)
    np.testing.assert_allclose(spectrum.wavelengths_m, 0.85e-6 + 0.17e-6 * nodes, rtol=1e-13)  # rounding
    np.testing.assert_allclose(spectrum.shares, weights / 2, rtol=1e-10)  # eigenvectors of a 64 x 64 matrix


@pytest.mark.parametrize("temperature_k", [300.0, 3000.0, 30000.0])
@pytest.mark.parametrize("power", [0, 1, -1, 7])
def test_a_black_body_has_the_means_of_its_photons(temperature_k, power):
    low_m, high_m = 0.68e-6, 1.02e-6

    def mean_of(weight):
        return scipy.integrate.quad(
            lambda x: weight(x) * planck_photons(x * 1e-6, temperature_k), low_m * 1e6, high_m * 1e6, epsrel=1e-12
        )[0]

    expected = mean_of(lambda x: x**power) / mean_of(lambda x: 1.0)
    spectrum = LightBand.black_body(**RED, temperature_k=temperature_k).spectrum(12)
    means = np.sum(np.array(spectrum.shares) * (np.array(spectrum.wavelengths_m) * 1e6) ** power)
    assert means == pytest.approx(expected, rel=1e-8)  # 1/x is no polynomial: 12 nodes leave 1e-17, the constants 1e-9


def test_a_very_cold_star_still_has_light():
    """Its exponentials are below the smallest number; it sends all its photons at the red end."""
    spectrum = LightBand.black_body(**RED, temperature_k=1.0).spectrum(3)
    assert sum(spectrum.shares) == pytest.approx(1, abs=1e-12)
    assert min(spectrum.wavelengths_m) > 1.015e-6


def test_a_table_is_linear_between_its_rows():
    wavelengths_um, photons = np.array([0.6, 0.7, 0.85, 0.9]), np.array([0.0, 3.0, 1.0, 2.0])
    spectrum = LightBand.tabulated(wavelengths_um * 1e-6, photons).spectrum(4)
    x = np.linspace(0.6, 0.9, 300_001)
    light = np.interp(x, wavelengths_um, photons)
    for power in range(8):  # four of Gauss's nodes are exact up to degree 7
        expected = scipy.integrate.trapezoid(light * x**power, x) / scipy.integrate.trapezoid(light, x)
        found = np.dot(spectrum.shares, np.array(spectrum.wavelengths_m) ** power) * 1e6**power
        assert found == pytest.approx(expected, rel=1e-8)  # steps of 1 pm


def test_two_bands_get_their_own_wavelengths():
    rows_um = np.array([0.5, 0.6, 0.6001, 0.7999, 0.8, 0.9])
    band = LightBand.tabulated(rows_um * 1e-6, np.array([1.0, 1.0, 0.0, 0.0, 1.0, 1.0]))
    spectrum = band.spectrum(6)
    blue = np.array(spectrum.wavelengths_m) < 0.7e-6
    assert blue.sum() == 3
    assert np.sum(np.array(spectrum.shares)[blue]) == pytest.approx(0.5, abs=1e-9)
    assert not [one for one in spectrum.wavelengths_m if 0.61e-6 < one < 0.79e-6]


def test_equal_steps_have_the_light_of_their_steps():
    spectrum = LightBand.tabulated(np.array([0.6e-6, 0.8e-6]), np.array([0.0, 1.0])).equal_steps(4)
    np.testing.assert_allclose(spectrum.wavelengths_m, [0.625e-6, 0.675e-6, 0.725e-6, 0.775e-6], rtol=1e-2)
    # A triangle: 1, 3, 5, 7 sixteenths; 16 points tell its integral to some 0.003.
    np.testing.assert_allclose(spectrum.shares, np.array([1, 3, 5, 7]) / 16, atol=0.01)


@pytest.mark.parametrize("count", [0, 129])
def test_a_number_of_wavelengths_that_cannot_be_is_refused(count):
    with pytest.raises(SettingsError, match=f"beam.spectrum.wavelengths: must be from 1 to 128, got {count}"):
        LightBand.flat(**RED).spectrum(count)


@pytest.mark.parametrize("bandwidth_m", [0.0, -1e-7, 1.7e-6, np.nan])
def test_a_band_down_to_no_wavelength_is_refused(bandwidth_m):
    with pytest.raises(SettingsError, match=r"^beam\.spectrum\.bandwidth_um: must be positive and less than 1.7"):
        LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=bandwidth_m)


# ------------------------------------------------------------------------------------------------- tables


def test_a_table_with_a_unit_and_one_without_say_the_same(tmp_path):
    wavelengths_um, photons = [0.6, 0.7, 0.8], [1.0, 4.0, 2.0]
    table = Table({"lambda": np.array(wavelengths_um) * 1e3, "flux": photons})
    table["lambda"].unit = "nm"
    table.write(tmp_path / "a.ecsv")
    (tmp_path / "b.csv").write_text("um,photons\n0.6,1\n0.7,4\n0.8,2\n")
    with_unit, without = (read_spectrum_table(tmp_path / name) for name in ("a.ecsv", "b.csv"))
    np.testing.assert_allclose(with_unit.wavelengths_m, without.wavelengths_m, rtol=1e-14)
    np.testing.assert_allclose(with_unit.shares, without.shares, rtol=1e-12)
    assert without.shares @ without.wavelengths_m == pytest.approx(0.70606e-6, rel=1e-4)
    # (0.05 (1 + 4) 0.66 + 0.05 (4 + 2) 0.7444) / 0.55, the centroids of the two trapezoids


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b,c\n1,2,3\n2,3,4\n", "must have two columns, wavelength and photons, got 3"),
        ("a,b\n0.6,1\n0.7,much\n", "must be a table of two columns of numbers"),
        ("a,b\n0.6,1\n", "must have at least two rows, got 1"),
        ("a,b\n0.7,1\n0.6,1\n", "must have wavelengths that are positive and ascend, got 0.6 um in row 2"),
        ("a,b\n-0.7,1\n0.6,1\n", "must have wavelengths that are positive and ascend, got -0.7 um in row 1"),
        ("a,b\n0.6,1\n0.7,-2\n", "must have photons that are finite and not negative, got -2"),
        ("a,b\n0.6,0\n0.7,0\n", "must have photons at some wavelength, got zeros everywhere"),
        ("a,b\n0.6,nan\n0.7,0\n", "must have photons that are finite and not negative, got nan"),
        ("", "must have two columns, wavelength and photons, got 0"),
        ("# %ECSV 1.0\n# ---\n# nonsense\n", "must be a table of two columns of numbers"),
    ],
)
def test_a_table_that_is_none_is_told_in_a_line(tmp_path, text, message):
    path = tmp_path / "filter.csv"
    path.write_text(text)
    with pytest.raises((SettingsError, FileFormatError)) as refusal:
        read_spectrum_table(path)
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_table_that_is_not_there_is_told(tmp_path):
    with pytest.raises(FileFormatError, match=r"none.csv: no such file$"):
        read_spectrum_table(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match=r"bytes.csv: must be readable as text"):
        read_spectrum_table(tmp_path / "bytes.csv")
