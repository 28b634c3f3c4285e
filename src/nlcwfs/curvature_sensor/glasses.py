r"""Optical glasses: how the refractive index falls with the wavelength.

:math:`n^2 = 1 + \sum_i B_i \lambda^2 / (\lambda^2 - C_i)`, :math:`\lambda` in um (Sellmeier 1871, Ann. Phys. 219, 272),
with the coefficients that the makers publish. In air, at 20 to 24 degrees Celsius.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from nlcwfs.errors import SettingsError


@dataclass(frozen=True)
class Glass:
    """A glass and its dispersion.

    Attributes:
        strengths: The three B of the formula.
        poles_um2: The three C.
        range_um: Wavelengths for which it was measured and is clear.
    """

    strengths: tuple[float, float, float]
    poles_um2: tuple[float, float, float]
    range_um: tuple[float, float]

    def index(self, wavelength_um: Float[np.ndarray, "*shape"] | float) -> Float[np.ndarray, "*shape"]:
        """Refractive index; trusts that the wavelength is in the range, see `refractive_index`."""
        square = np.asarray(wavelength_um, float)[..., None] ** 2
        terms = np.array(self.strengths) * square / (square - np.array(self.poles_um2))
        return np.asarray(np.sqrt(1 + np.sum(terms, axis=-1)))


def _glass(strengths: tuple[float, float, float], poles_um2: tuple[float, float, float], shortest_um: float) -> Glass:
    return Glass(strengths, poles_um2, (shortest_um, 2.5))


GLASSES: Mapping[str, Glass] = MappingProxyType(
    {
        "N-BK7": _glass(
            (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653), shortest_um=0.3
        ),
        "N-FK51A": _glass(
            (0.971247817, 0.216901417, 0.904651666), (0.00472301995, 0.0153575612, 168.68133), shortest_um=0.29
        ),
        "N-FK58": _glass(
            (0.738042712, 0.363371967, 0.989296264), (0.00339065607, 0.0117551189, 212.842145), shortest_um=0.26
        ),
        "N-PK52A": _glass(
            (1.029607, 0.1880506, 0.736488165), (0.00516800155, 0.0166658798, 138.964129), shortest_um=0.29
        ),
        "N-LAK22": _glass(
            (1.14229781, 0.535138441, 1.04088385), (0.00585778594, 0.0198546147, 100.834017), shortest_um=0.31
        ),
        "N-SK16": _glass(
            (1.34317774, 0.241144399, 0.994317969), (0.00704687339, 0.0229005, 92.7508526), shortest_um=0.31
        ),
        "N-BAK4": _glass(
            (1.28834642, 0.132817724, 0.945395373), (0.00779980626, 0.0315631177, 105.965875), shortest_um=0.334
        ),
        "N-KZFS4": _glass(
            (1.35055424, 0.197575506, 1.09962992), (0.0087628207, 0.0371767201, 90.3866994), shortest_um=0.334
        ),
        "F2": _glass(
            (1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764), shortest_um=0.32
        ),
        "N-SF5": _glass(
            (1.52481889, 0.187085527, 1.42729015), (0.011254756, 0.0588995392, 129.141675), shortest_um=0.37
        ),
        "N-SF6": _glass(
            (1.77931763, 0.338149866, 2.08734474), (0.0133714182, 0.0617533621, 174.01759), shortest_um=0.37
        ),
        "N-SF11": _glass(
            (1.73759695, 0.313747346, 1.89878101), (0.013188707, 0.0623068142, 155.23629), shortest_um=0.37
        ),
        "N-SF66": _glass(
            (2.0245976, 0.470187196, 2.59970433), (0.0147053225, 0.0692998276, 161.817601), shortest_um=0.39
        ),
        "N-LASF9": _glass(
            (2.00029547, 0.298926886, 1.80691843), (0.0121426017, 0.0538736236, 156.530829), shortest_um=0.365
        ),
        "silica": Glass(
            (0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2), range_um=(0.21, 3.71)
        ),
        "CaF2": Glass(
            (0.5675888, 0.4710914, 3.8484723), (0.050263605**2, 0.1003909**2, 34.649040**2), range_um=(0.23, 9.7)
        ),
    }
)
"""Glasses of SCHOTT: its catalogue of 2017-01-20, as in the refractiveindex.info database (Polyanskiy 2024, Sci. Data
11, 94; public domain, CC0). Fused silica: Malitson 1965 (JOSA 55, 1205). Calcium fluoride: Malitson 1963 (Appl. Opt. 2,
1103)."""


def refractive_index(name: str, wavelength_um: Float[np.ndarray, "*shape"] | float) -> Float[np.ndarray, "*shape"]:
    """Refractive index of a glass in air.

    Args:
        name: One of `GLASSES`.
        wavelength_um: Wavelength, in the glass's range.

    Raises:
        SettingsError: If there is no such glass, or no data at a wavelength.

    Examples:
        >>> round(float(refractive_index("N-BK7", 0.5875618)), 5)  # the yellow line of helium
        1.5168
    """
    if name not in GLASSES:
        raise SettingsError("curvature_sensor.glasses", f"must be two of {', '.join(GLASSES)}", name)
    low_um, high_um = GLASSES[name].range_um
    colours = np.atleast_1d(np.asarray(wavelength_um, float))
    beyond = colours[~((colours >= low_um) & (colours <= high_um))]
    if beyond.size:
        rule = f"must have data at every wavelength of the light; those of {name} are for {low_um:g} to {high_um:g} um"
        raise SettingsError("curvature_sensor.glasses", rule, f"light at {beyond[0]:.4g} um")
    return GLASSES[name].index(wavelength_um)
