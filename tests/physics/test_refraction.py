"""Dispersion of the air against two other models of its index, and what correctors leave of it."""

import numpy as np
import pytest

from nlcwfs.atmosphere.refraction import Site, residual_dispersion_rad
from nlcwfs.atmosphere.settings import DispersionSettings
from nlcwfs.errors import SettingsError

ARCSEC = 180 / np.pi * 3600
COLOURS_UM = np.array([0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.5, 2.2])

CIDDOR = np.array(
    [181.256064, 178.825270, 177.547887, 176.791408, 176.125626, 175.739881, 175.186411, 174.951104]
)  # (n - 1) 1e6 of Ciddor 1996 at 616 hPa, 273.15 K, humidity 0.3, 400 ppm CO2: AstroAtmosphere 1.6, Observatory.n_tph


def filippenko_arcsec(wavelength_um, *, pressure_hpa, celsius, humidity, zenith_deg):
    """Filippenko 1982, eqs. 1 to 4; saturation by Magnus."""
    inverse, pressure_mm = wavelength_um**-2.0, pressure_hpa * 0.750062
    vapour_mm = humidity * 6.11 * 10 ** (7.5 * celsius / (237.3 + celsius)) * 0.750062
    index = 64.328 + 29498.1 / (146 - inverse) + 255.4 / (41 - inverse)
    index *= pressure_mm * (1 + (1.049 - 0.0157 * celsius) * 1e-6 * pressure_mm) / (720.883 * (1 + 0.003661 * celsius))
    index -= (0.0624 - 0.000680 * inverse) / (1 + 0.003661 * celsius) * vapour_mm
    return 206265e-6 * index * np.tan(np.radians(zenith_deg))


@pytest.mark.parametrize(("pressure_hpa", "celsius", "humidity"), [(616.0, 0.0, 0.3), (1013.25, 15.0, 0.5)])
@pytest.mark.parametrize(("zenith_deg", "tolerance"), [(30.0, 0.011), (60.0, 0.014), (75.0, 0.03)])
def test_dispersion_is_filippenkos(pressure_hpa, celsius, humidity, zenith_deg, tolerance):
    """Edlen's index is 0.8 % steeper at 0.4 um; the cube of the tangent, not in it, is 1.6 % at 75 degrees."""
    site = Site(pressure_hpa, celsius + 273.15, humidity)
    found = site.refraction_rad(COLOURS_UM, zenith_deg=zenith_deg) * ARCSEC
    air = {"pressure_hpa": pressure_hpa, "celsius": celsius, "humidity": humidity, "zenith_deg": zenith_deg}
    expected = filippenko_arcsec(COLOURS_UM, **air)
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=tolerance)


def test_dispersion_is_ciddors():
    found = Site(616.0, 273.15, 0.3).refraction_rad(COLOURS_UM, zenith_deg=45.0)
    np.testing.assert_allclose(
        np.diff(found), np.diff(CIDDOR) * 1e-6, rtol=0.01
    )  # Edlen and Barrell & Sears part at 0.4 um


@pytest.mark.parametrize(("pressure_hpa", "temperature_k"), [(616.0, 273.15), (1013.25, 288.15)])
def test_towards_the_horizon_the_curvature_of_the_air_counts(pressure_hpa, temperature_k):
    """dR/dn = (1 - b) tan Z - (b - (n - 1)) tan^3 Z, b the height of the air over the Earth's radius (Stone 1996)."""
    site, height = Site(pressure_hpa, temperature_k, 0.3), 0.001254 * temperature_k / 273.15
    thin = 287e-6 * pressure_hpa / 1013.25 * 273.15 / temperature_k  # n - 1 near 1 um

    def expected(zenith_deg):
        tangent = np.tan(np.radians(zenith_deg))
        return (1 - height) * tangent - (height - thin) * tangent**3

    def found(zenith_deg):
        return np.diff(site.refraction_rad(np.array([0.7, 1.0]), zenith_deg=zenith_deg))[0]

    assert found(75.0) / found(30.0) == pytest.approx(expected(75.0) / expected(30.0), rel=2e-3)  # the cube is 1.5e-2


SETTINGS = {"zenith_deg": 45.0, "pressure_hpa": 616.0, "temperature_k": 273.15, "humidity_ratio": 0.3}
COLOURS_M = (0.5e-6, 0.7e-6, 0.85e-6, 1.0e-6)


def residual_mas(**settings) -> np.ndarray:
    dispersion = DispersionSettings(**{**SETTINGS, **settings})
    return residual_dispersion_rad(dispersion, COLOURS_M, wavelength_m=0.85e-6) * ARCSEC * 1e3


def test_without_a_corrector_all_is_left_and_the_reference_stays():
    expected = (CIDDOR[[1, 3, 4, 5]] - CIDDOR[4]) * 1e-6 * ARCSEC * 1e3
    np.testing.assert_allclose(residual_mas(), expected, rtol=0.01, atol=1e-9)
    assert residual_mas()[2] == 0
    np.testing.assert_array_equal(residual_mas(zenith_deg=0.0), 0)


def test_a_share_is_a_share():
    np.testing.assert_allclose(residual_mas(corrector="share", remaining_share=0.03), 0.03 * residual_mas(), rtol=1e-12)


def test_a_corrector_with_two_nulls_leaves_equal_directions_there_and_takes_out_a_line():
    left = residual_mas(corrector="two-nulls", nulls_um=(0.7, 1.0))
    assert left[1] == pytest.approx(left[3], abs=1e-9)  # both nulls look along one direction
    taken = residual_mas() - left
    slopes = np.diff(taken) / np.diff(COLOURS_M)
    np.testing.assert_allclose(slopes, slopes[0], rtol=1e-9)
    assert left[0] > 5 * abs(left[1])  # the blue end, beyond the nulls


@pytest.mark.parametrize("zenith_deg", [75.5, -1.0, float("nan")])
def test_a_zenith_angle_beyond_the_model_is_refused(zenith_deg):
    with pytest.raises(SettingsError, match=r"^atmosphere\.dispersion\.zenith_deg: must be from 0 to 75, where the mo"):
        Site(616.0, 273.0, 0.3).refraction_rad(np.array([0.5]), zenith_deg=zenith_deg)


def test_a_wavelength_beyond_the_model_is_refused():
    with pytest.raises(SettingsError) as refusal:
        residual_dispersion_rad(DispersionSettings(zenith_deg=30.0), (3.4e-6,), wavelength_m=2.2e-6)
    rule = "must be 0 for light beyond 0.3 to 2.5 um, where the model of refraction ends"
    assert str(refusal.value) == f"atmosphere.dispersion.zenith_deg: {rule}, got 30 with light at 3.4 um"
