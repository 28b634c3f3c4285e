"""The star: how many photons a second its magnitude sends into the telescope."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import scipy.constants

from nlcwfs.errors import SettingsError


@dataclass(frozen=True)
class Band:
    """A photometric band of the Johnson-Cousins-Glass system.

    Attributes:
        wavelength_um: Effective wavelength for a star of type A0.
        width_um: Full width at half maximum.
        flux_jy: Flux density of magnitude 0; a jansky is 1e-26 W / m^2 / Hz.

    Examples:
        >>> round(BANDS["V"].photons_per_s_m2_um / 1e10, 1)
        10.1
    """

    wavelength_um: float
    width_um: float
    flux_jy: float

    @property
    def photons_per_s_m2_um(self) -> float:
        """Photons of magnitude 0, per um of bandwidth: flux density over Planck's constant and the wavelength."""
        return self.flux_jy * 1e-26 / (scipy.constants.Planck * self.wavelength_um)


BANDS: Mapping[str, Band] = MappingProxyType(
    {
        "U": Band(wavelength_um=0.366, width_um=0.066, flux_jy=1790.0),
        "B": Band(wavelength_um=0.438, width_um=0.094, flux_jy=4063.0),
        "V": Band(wavelength_um=0.545, width_um=0.088, flux_jy=3636.0),
        "R": Band(wavelength_um=0.641, width_um=0.138, flux_jy=3064.0),
        "I": Band(wavelength_um=0.798, width_um=0.149, flux_jy=2416.0),
        "J": Band(wavelength_um=1.22, width_um=0.213, flux_jy=1589.0),
        "H": Band(wavelength_um=1.63, width_um=0.307, flux_jy=1021.0),
        "K": Band(wavelength_um=2.19, width_um=0.390, flux_jy=640.0),
    }
)
"""Wavelengths and flux densities: Bessell, Castelli & Plez 1998 (A&A 333, 231), table A2. Widths: Binney & Merrifield
1998 (Galactic Astronomy), table 2.1, after Bessell 1990 (PASP 102, 1181) and Bessell & Brett 1988 (PASP 100, 1134)."""


def collecting_area_m2(*, diameter_m: float, obstruction_ratio: float = 0.0) -> float:
    """Area of a round telescope without its central obstruction; vanes and dim edges are left out.

    Args:
        diameter_m: Diameter of the telescope.
        obstruction_ratio: Diameter of the obstruction over that of the telescope.

    Raises:
        SettingsError: If the diameter is not positive or the ratio outside 0 <= ratio < 1.

    Examples:
        >>> round(collecting_area_m2(diameter_m=8.0, obstruction_ratio=0.3), 2)
        45.74
    """
    if not (diameter_m > 0 and math.isfinite(diameter_m)):
        raise SettingsError("diameter_m", "must be a positive length", diameter_m)
    if not 0 <= obstruction_ratio < 1:
        raise SettingsError("obstruction_ratio", "must be at least 0 and below 1", obstruction_ratio)
    return math.pi / 4 * diameter_m**2 * (1 - obstruction_ratio**2)


def photons_per_s(
    magnitude: float, *, band: str, area_m2: float, throughput: float, bandwidth_um: float | None = None
) -> float:
    """Photons that a star brings to the detector each second.

    The photons per um are taken as those at the middle of the band over the whole bandwidth: good to 5 % in a band,
    and to some 20 % over the half micrometre of a wavefront sensor, where the colour of the star decides. Air is not
    in it: put its absorption into the throughput.

    Args:
        magnitude: Apparent magnitude, on Vega's scale.
        band: Name of the band, one of `BANDS`.
        area_m2: Area that collects, see `collecting_area_m2`.
        throughput: Share of the photons that are detected, from 0 to 1.
        bandwidth_um: Width of the light that is used; that of the band when left out.

    Raises:
        SettingsError: If a number breaks its rule, or there is no such band.

    Examples:
        >>> f"{photons_per_s(0.0, band='V', area_m2=1.0, throughput=1.0):.1e}"
        '8.9e+09'
        >>> area_m2 = collecting_area_m2(diameter_m=8.0)
        >>> f"{photons_per_s(13.0, band='V', area_m2=area_m2, throughput=0.2, bandwidth_um=0.5):.1e}"  # Guyon 2010
        '3.2e+06'
    """
    if band not in BANDS:
        raise SettingsError("star.band", f"must be one of {', '.join(BANDS)}", band)
    if not -30 <= magnitude <= 60:
        raise SettingsError("star.magnitude", "must be between -30 and 60", magnitude)
    if not (area_m2 > 0 and math.isfinite(area_m2)):
        raise SettingsError("star.area_m2", "must be a positive area", area_m2)
    if not 0 < throughput <= 1:
        raise SettingsError("star.throughput", "must be greater than 0 and at most 1", throughput)
    width_um = BANDS[band].width_um if bandwidth_um is None else bandwidth_um
    if not 0 < width_um <= 10:
        raise SettingsError("star.bandwidth_um", "must be greater than 0 and at most 10 um", width_um)
    return 10 ** (-0.4 * magnitude) * BANDS[band].photons_per_s_m2_um * width_um * area_m2 * throughput
