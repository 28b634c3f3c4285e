"""How many photons a sensor needs over those of the quantum limit, by spatial frequency."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.errors import SettingsError


class FluxFactor(NamedTuple):
    """The flux factor q of a sensor: a wave of unit rms is measured with variance `q / (4 N)` rad^2 by N photons.

    q = 1 is the quantum limit (Haffert et al. 2023, arXiv 2310.10889). Infinite is blind.

    Attributes:
        sensor: Its name.
        cycles_per_aperture: Frequencies, increasing.
        factor: The flux factor at each.

    Examples:
        >>> curve = FluxFactor("pyramid", np.array([1.0, 4.0]), np.array([4.0, 2.0]))
        >>> round(float(curve.at(np.array([2.0]))[0]), 3)  # straight between the points on logarithmic axes
        2.828
    """

    sensor: str
    cycles_per_aperture: Float[np.ndarray, " point"]
    factor: Float[np.ndarray, " point"]

    def at(self, cycles_per_aperture: Float[np.ndarray, " wave"]) -> Float[np.ndarray, " wave"]:
        """The factor between the points, straight on logarithmic axes; infinite beside a point that is blind.

        A hundredth beyond the ends counts as the end.

        Raises:
            SettingsError: If a frequency is outside of the points.
        """
        asked = np.asarray(cycles_per_aperture, float)
        least, most = self.cycles_per_aperture[0], self.cycles_per_aperture[-1]
        outside = asked[(asked < least / ROUNDING) | (asked > most * ROUNDING)]
        if outside.size:
            rule = f"must be from {least:g} to {most:g} cycles per aperture, where {self.sensor} is known"
            raise SettingsError("cycles_per_aperture", rule, f"{outside.flat[0]:.4g}")
        place = np.log(np.clip(asked, least, most))
        points, blind = np.log(self.cycles_per_aperture), np.isinf(self.factor)
        found = np.exp(np.interp(place, points, np.log(np.where(blind, 1.0, np.maximum(self.factor, TINY)))))
        found = np.where(found > 2 * TINY, found, 0)
        return np.where(np.interp(place, points, blind.astype(float)) > 0, np.inf, found)


ROUNDING = 1.01
"""Angles are told in whole milliseconds of arc: 41 mas are 0.994 cycles per aperture."""


TINY = 1e-300
"""Stands for the zero of a sensor without noise, which has no logarithm."""


def constant_flux_factor(sensor: str, factor: float) -> FluxFactor:
    """A sensor that needs the same at every frequency.

    Examples:
        >>> float(constant_flux_factor("ideal", 1.0).at(np.array([16.0]))[0])
        1.0
    """
    return FluxFactor(sensor, np.array([1e-6, 1e6]), np.array([factor, factor]))


def shack_hartmann_flux_factor(
    cycles_per_aperture: Float[np.ndarray, " wave"], subapertures: int
) -> Float[np.ndarray, " wave"]:
    r"""Flux factor of square lenslets with the best centroid, for waves along x or y.

    A wave of f cycles per aperture tilts a lenslet of width d by its mean slope, :math:`2 \pi f\,\mathrm{sinc}(f d)`
    times the wave's amplitude, in quadrature. The light of n photons behind a square lenslet tells a slope s over its
    width with the quantum limit of a tilt, :math:`\sigma_s^2 = 12 / (4 n)`, for a ramp of unit slope has the rms
    :math:`1/\sqrt{12}`. Hence

    .. math:: q = \frac{12}{\left(2 \pi f d\, \mathrm{sinc}(f d)\right)^2} , \; \mathrm{sinc}(x) = \sin(\pi x)/(\pi x) .

    From half a cycle per lenslet on the slopes are those of a slower wave: there it is blind. Real spots, whose wings
    are cut off, need somewhat more. Turbulence that is too fine for the lenslets and passes for slow waves
    (aliasing) is no noise of photons and not counted.

    Args:
        cycles_per_aperture: Frequency, positive.
        subapertures: Lenslets across the aperture, D/d.

    Returns:
        Photons over those of the quantum limit; infinite where the lenslets are blind.

    Examples:
        >>> q = shack_hartmann_flux_factor(np.array([1.0, 8.0, 30.0]), 50)
        >>> [round(float(value), 1) for value in q]
        [760.9, 12.9, inf]
    """
    across = np.asarray(cycles_per_aperture, float) / subapertures
    slope = 2 * np.pi * across * np.sinc(across)
    seen = across < 0.5
    return np.where(seen, 12 / np.where(seen, slope, 1) ** 2, np.inf)


def shack_hartmann_curve(subapertures: int) -> FluxFactor:
    """The same as a curve, from a hundredth of a cycle per aperture to four cycles per lenslet.

    Examples:
        >>> shack_hartmann_curve(50).sensor
        'shack-hartmann-50'
    """
    waves = np.geomspace(0.01, 4.0 * subapertures, 2001)
    return FluxFactor(f"shack-hartmann-{subapertures}", waves, shack_hartmann_flux_factor(waves, subapertures))
