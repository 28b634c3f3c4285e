"""How much a star twinkles: closed forms of weak scintillation."""

import math
from collections.abc import Sequence

import numpy as np
import scipy.integrate
import scipy.special

from nlcwfs.atmosphere.phase_screen import Turbulence

WEAKEST_TOLD = 1e-6
"""Where the integral over u = f sqrt(pi lambda h) begins; slower waves focus no light."""

FASTEST_TOLD = 60.0
"""Where it ends; beyond, sin^2 is one half on the mean, and the rest of a point's index is known."""


def scintillation_index(
    air: Turbulence,
    heights_m: Sequence[float],
    fractions: Sequence[float],
    *,
    wavelength_m: float,
    diameter_m: float = 0.0,
) -> float:
    r"""Variance of a star's intensity over its mean squared, behind weak turbulence.

    :math:`4 \sum_l \int W_l(f)\, \sin^2(\pi \lambda h_l f^2)\, (2 J_1(\pi D f) / (\pi D f))^2\, 2 \pi f\, df`
    with the phase spectrum :math:`W_l` of each layer (Roddier 1981, Progress in Optics 19, 281, sec. 5.3).

    Args:
        air: The whole turbulence.
        heights_m: Height of each layer.
        fractions: Share of each layer in the turbulence.
        wavelength_m: Wavelength of the light.
        diameter_m: Of the disc that gathers the light; 0 for a point.

    Examples:
        >>> air = Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> layers = {"heights_m": (0.0, 10e3), "fractions": (0.5, 0.5), "wavelength_m": 0.85e-6}
        >>> f"{scintillation_index(air, **layers):.3f} {scintillation_index(air, **layers, diameter_m=8.0):.1e}"
        '0.073 1.9e-06'
    """
    total, per_m = 0.0, 2 * math.pi / wavelength_m
    slow = np.geomspace(WEAKEST_TOLD, 1, 20000)
    fast = np.linspace(1, FASTEST_TOLD, 24001)
    for height_m, fraction in zip(heights_m, fractions, strict=True):
        if height_m == 0:
            continue
        scale_m = math.sqrt(math.pi * wavelength_m * height_m)

        def density(u, scale_m=scale_m):
            frequency = u / scale_m
            angle = np.maximum(np.pi * diameter_m * frequency, 1e-9)
            seen = (2 * scipy.special.j1(angle) / angle) ** 2
            return air.opd_spectrum(frequency) * np.sin(u**2) ** 2 * seen * 2 * np.pi * frequency / scale_m

        found = sum(scipy.integrate.trapezoid(density(u), u) for u in (slow, fast))
        if diameter_m == 0:  # W 2 pi f falls as u^(-8/3)
            end = FASTEST_TOLD / scale_m
            found += 0.5 * 0.6 * end * 2 * np.pi * end * float(air.opd_spectrum(np.array([end]))[0])
        total += 4 * per_m**2 * fraction * float(found)
    return total


def amplitude_variance(
    air: Turbulence,
    heights_m: Sequence[float],
    fractions: Sequence[float],
    *,
    wavelength_m: float,
    finest_per_m: float,
) -> float:
    r"""Variance of the logarithm of the amplitude, of its waves up to a frequency.

    :math:`\sum_l \int W_l(f)\, \sin^2(\pi \lambda h_l f^2)\, 2 \pi f\, df` (Roddier 1981, sec. 5.2); a quarter of the
    index of a point when all waves are counted.

    Args:
        air: The whole turbulence.
        heights_m: Height of each layer.
        fractions: Share of each layer in the turbulence.
        wavelength_m: Wavelength of the light.
        finest_per_m: Highest frequency that counts.

    Examples:
        >>> air = Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> layers = {"heights_m": (0.0, 10e3), "fractions": (0.5, 0.5), "wavelength_m": 0.85e-6}
        >>> [round(4 * amplitude_variance(air, **layers, finest_per_m=finest), 3) for finest in (2.75, 1e3)]
        [0.006, 0.073]
    """
    frequency = np.geomspace(1e-4, 1, 100001) * finest_per_m
    power = air.opd_spectrum(frequency) * (2 * math.pi / wavelength_m) ** 2
    total = 0.0
    for height_m, fraction in zip(heights_m, fractions, strict=True):
        density = power * np.sin(np.pi * wavelength_m * height_m * frequency**2) ** 2 * 2 * np.pi * frequency
        total += fraction * float(scipy.integrate.trapezoid(density, frequency))
    return total
