r"""Where a plane lies in every colour: lenses whose power changes with the wavelength.

A lens of power P beside the pupil puts the plane that the detector sees at :math:`z = -1/P`. Achromatic lenses see the
same plane in all colours. Images of all colours are alike, for equal phase, if :math:`\lambda z` is the same: the
Fresnel factor :math:`\exp(-i \pi \lambda z |f|^2)` knows only this product. So the power has to grow as the wavelength
(Guyon 2010, sec. 2). Glass does the opposite, and its power hardly changes; two glasses of opposite powers whose
difference is small can come near the law.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from nlcwfs.curvature_sensor.glasses import refractive_index
from nlcwfs.errors import SettingsError

MOST_LENS_ERROR = 0.1
"""Largest error of wavelength times distance. Achromatic lenses reach it at the ends of a band of 20 %, in which a loop
with one wavelength in its reconstructor is not stable (Guyon 2010, sec. 4)."""

FIT_POINTS = 65


@dataclass(frozen=True)
class Doublet:
    """Two thin lenses in contact whose power together grows as the wavelength, as well as their glasses can.

    Attributes:
        glasses: Names of the two glasses.
        powers: Power of each at the reference wavelength over that of both; they sum to 1.
        wavelength_m: Reference wavelength.

    Examples:
        >>> doublet = Doublet.fitted(("N-FK51A", "N-SF66"), wavelength_m=0.85e-6, ends_m=(0.765e-6, 0.935e-6))
        >>> [round(power) for power in doublet.powers], f"{doublet.worst((0.765e-6, 0.935e-6)):.1%}"
        ([23, -22], '1.6%')
    """

    glasses: tuple[str, str]
    powers: tuple[float, float]
    wavelength_m: float

    @classmethod
    def fitted(cls, glasses: tuple[str, str], *, wavelength_m: float, ends_m: tuple[float, float]) -> "Doublet":
        """Find the two powers whose sum is nearest to the law over a band, by least squares of its relative error.

        Raises:
            SettingsError: If a glass is unknown, has no data in the band, or both are the same.
        """
        if glasses[0] == glasses[1]:
            raise SettingsError("curvature_sensor.glasses", "must be two different glasses", list(glasses))
        colours_m = np.linspace(*ends_m, FIT_POINTS)
        wanted = colours_m / wavelength_m
        each = np.stack([_power(glass, colours_m, wavelength_m) for glass in glasses], axis=-1)
        found = np.linalg.lstsq(each / wanted[:, None], np.ones(FIT_POINTS), rcond=None)[0]
        first, second = found / found.sum()
        return cls(glasses, (float(first), float(second)), wavelength_m)

    def power(self, wavelength_m: Float[np.ndarray, " colour"]) -> Float[np.ndarray, " colour"]:
        """Power of both over that at the reference wavelength."""
        both = zip(self.powers, self.glasses, strict=True)
        return np.sum([share * _power(glass, wavelength_m, self.wavelength_m) for share, glass in both], axis=0)

    def errors(self, wavelength_m: Float[np.ndarray, " colour"]) -> Float[np.ndarray, " colour"]:
        """Wavelength times distance over that at the reference wavelength, less 1."""
        return wavelength_m / self.wavelength_m / self.power(wavelength_m) - 1

    def worst(self, ends_m: tuple[float, float]) -> float:
        """The largest of these errors in a band."""
        return float(np.max(np.abs(self.errors(np.linspace(*ends_m, FIT_POINTS)))))


@dataclass(frozen=True)
class LensLaw:
    """From the wavelength to where the planes are.

    Attributes:
        kind: Achromatic, ideal (distance times wavelength is constant) or a doublet of glasses.
        wavelength_m: Reference wavelength, at which distances are quoted.
        doublet: The lenses, where they are of glass.

    Examples:
        >>> law = LensLaw("ideal", wavelength_m=0.85e-6)
        >>> law.distances_m((3.4e6,), (0.68e-6, 0.85e-6)).round().tolist()
        [[4250000.0], [3400000.0]]
    """

    kind: Literal["achromatic", "ideal", "doublet"]
    wavelength_m: float
    doublet: Doublet | None = None

    @classmethod
    def of_glasses(cls, glasses: tuple[str, str], *, wavelength_m: float, ends_m: tuple[float, float]) -> "LensLaw":
        """The law of a real doublet, best over a band.

        Raises:
            SettingsError: If a glass cannot be used, or the band is wider than the doublet can serve.
        """
        doublet = Doublet.fitted(glasses, wavelength_m=wavelength_m, ends_m=ends_m)
        worst = doublet.worst(ends_m)
        if not worst <= MOST_LENS_ERROR:
            where = max(ends_m, key=lambda end_m: abs(float(doublet.errors(np.array([end_m]))[0])))
            rule = f"must keep wavelength times distance within {MOST_LENS_ERROR:.0%} over the band".replace("%", " %")
            got = f"{worst:.0%} at {where * 1e6:.3g} um with {' and '.join(glasses)}".replace("%", " %", 1)
            raise SettingsError("curvature_sensor.glasses", rule, got)
        return cls("doublet", wavelength_m, doublet)

    def scale(self, wavelengths_m: Sequence[float]) -> Float[np.ndarray, " colour"]:
        """Distance in each colour over that at the reference wavelength."""
        colours_m = np.asarray(wavelengths_m, float)
        if self.doublet is not None:
            return 1 / self.doublet.power(colours_m)
        return self.wavelength_m / colours_m if self.kind == "ideal" else np.ones_like(colours_m)

    def distances_m(
        self, distances_m: Sequence[float], wavelengths_m: Sequence[float]
    ) -> Float[np.ndarray, "colour plane"]:
        """Where each plane is in each colour."""
        return self.scale(wavelengths_m)[:, None] * np.asarray(distances_m, float)[None, :]


def _power(glass: str, wavelength_m: Float[np.ndarray, " colour"], reference_m: float) -> Float[np.ndarray, " colour"]:
    """Power of a thin lens over its power at a reference wavelength: both are n - 1 times its curvatures."""
    return (refractive_index(glass, wavelength_m * 1e6) - 1) / (refractive_index(glass, reference_m * 1e6) - 1)
