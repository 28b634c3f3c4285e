r"""Refraction by the air, by colour: at a zenith angle the air bends blue light more, and its corrector leaves some.

The bending is :math:`A \tan Z + B \tan^3 Z`, with A and B of the wavelength, pressure, temperature and humidity from
ERFA, the library of the IAU's SOFA (after Hohenkerk & Sinclair 1985, NAO Technical Note 63; index of Barrell & Sears
1939). At 45 degrees its dispersion is that of Filippenko 1982 (PASP 94, 715) and of Ciddor 1996 (Appl. Opt. 35, 1566)
within 1 % from 0.4 to 2.2 um. A corrector (ADC) takes out a share of the dispersion; or it makes it vanish at two
wavelengths, and takes out what is linear in the wavelength between and beyond them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import erfa
import numpy as np
from jaxtyping import Float

from nlcwfs.atmosphere.settings import FARTHEST_ZENITH_DEG, DispersionSettings
from nlcwfs.errors import SettingsError

SHORTEST_UM, LONGEST_UM = 0.3, 2.5
"""Beyond, the air is opaque, or its water vapour bends light in a way that this model does not know (Mathar 2007)."""


@dataclass(frozen=True)
class Site:
    """Air at the telescope.

    Attributes:
        pressure_hpa: Pressure.
        temperature_k: Temperature.
        humidity_ratio: Relative humidity, 0 to 1.
    """

    pressure_hpa: float
    temperature_k: float
    humidity_ratio: float

    def refraction_rad(
        self, wavelengths_um: Float[np.ndarray, " colour"], *, zenith_deg: float
    ) -> Float[np.ndarray, " colour"]:
        """By how much light is bent towards the zenith.

        Args:
            wavelengths_um: The colours.
            zenith_deg: Observed angle from the zenith.

        Raises:
            SettingsError: If the angle or a wavelength is beyond the model.

        Examples:
            >>> bent_rad = Site(1013.25, 283.15, 0.5).refraction_rad(np.array([0.574]), zenith_deg=45.0)
            >>> round(float(bent_rad[0]) * 206265, 1)  # arcsec
            58.0
        """
        if not 0 <= zenith_deg <= FARTHEST_ZENITH_DEG:
            rule = f"must be from 0 to {FARTHEST_ZENITH_DEG:g}, where the model of refraction ends"
            raise SettingsError("atmosphere.dispersion.zenith_deg", rule, zenith_deg)
        colours_um = np.asarray(wavelengths_um, float)
        beyond = colours_um[~((colours_um >= SHORTEST_UM) & (colours_um <= LONGEST_UM))]
        if beyond.size:
            rule = (
                f"must be 0 for light beyond {SHORTEST_UM:g} to {LONGEST_UM:g} um, where the model of refraction ends"
            )
            got = f"{zenith_deg:g} with light at {beyond[0]:.4g} um"
            raise SettingsError("atmosphere.dispersion.zenith_deg", rule, got)
        celsius = self.temperature_k - 273.15
        first, third = erfa.refco(self.pressure_hpa, celsius, self.humidity_ratio, colours_um)
        tangent = math.tan(math.radians(zenith_deg))
        return np.asarray(first * tangent + third * tangent**3)


def residual_dispersion_rad(
    settings: DispersionSettings, wavelengths_m: Sequence[float], *, wavelength_m: float
) -> Float[np.ndarray, " colour"]:
    """Where each colour comes from behind the corrector, relative to the reference wavelength; positive is bluer light.

    Args:
        settings: Zenith angle, air and corrector.
        wavelengths_m: The colours.
        wavelength_m: Reference wavelength, at which there is no tilt.

    Raises:
        SettingsError: If the angle or a wavelength is beyond the model.

    Examples:
        >>> low = DispersionSettings(zenith_deg=45.0)
        >>> bent_rad = residual_dispersion_rad(low, (0.68e-6, 1.02e-6), wavelength_m=0.85e-6)
        >>> [round(206265e3 * one) for one in bent_rad]  # milliarcseconds
        [163, -88]
    """
    site = Site(settings.pressure_hpa, settings.temperature_k, settings.humidity_ratio)
    nulls_m = () if settings.nulls_um is None else tuple(1e-6 * one for one in settings.nulls_um)
    colours_m = np.array([*wavelengths_m, wavelength_m, *nulls_m])
    bent = site.refraction_rad(colours_m * 1e6, zenith_deg=settings.zenith_deg)
    if settings.corrector == "two-nulls":
        slope = (bent[-1] - bent[-2]) / (colours_m[-1] - colours_m[-2])
        bent = bent - slope * (colours_m - colours_m[-1])
    count = len(wavelengths_m)
    left = settings.remaining_share if settings.corrector == "share" else 1.0
    return left * (bent[:count] - bent[count])
