r"""How the star looks from the telescope: where its colours come from, and how large it is.

Light from a direction :math:`\theta` makes the same image moved by :math:`z \theta`: exactly, in the paraxial
approximation. So a colour that the air has bent by :math:`\theta` has the Fresnel factor times
:math:`\exp(-2 \pi i z \theta f)`. A source of some size is the incoherent sum over its directions: the image is
smeared by the source's picture, scaled by z, and its spectrum is multiplied by the visibility at the baseline z f.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from nlcwfs.beam.grid import Grid

FWHM_IN_SIGMA = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a Gaussian over its standard deviation."""


@dataclass(frozen=True)
class ApparentStar:
    """Directions and size of a star.

    Attributes:
        directions_rad: Where each colour comes from, (y, x); light that comes from +x moves towards +x on its way.
            Empty if all come from one place.
        size_rad: Diameter of a uniform disc, or full width at half maximum of a Gaussian; 0 is a point.
        profile: Which of them.

    Examples:
        >>> star = ApparentStar(size_rad=1e-8, profile="gaussian")
        >>> visibility = star.visibility(Grid((4, 4), 0.5), distance_m=3.5e6)
        >>> visibility.shape, float(visibility[0, 0])
        ((4, 3), 1.0)
    """

    directions_rad: tuple[tuple[float, float], ...] = ()
    size_rad: float = 0.0
    profile: Literal["disc", "gaussian"] = "disc"

    @property
    def is_bent(self) -> bool:
        """Whether some colour comes from aside."""
        return any(angle != 0 for direction in self.directions_rad for angle in direction)

    def shift(self, grid: Grid, *, distance_m: float, colour: int) -> Complex[np.ndarray, "y x"]:
        """The factor of each frequency of a colour's field that moves its image to where the colour comes from."""
        y_rad, x_rad = self.directions_rad[colour]
        return np.exp(-2j * np.pi * distance_m * (grid.fy_per_m * y_rad + grid.fx_per_m * x_rad))

    def visibility(self, grid: Grid, *, distance_m: float) -> Float[np.ndarray, "y fx"]:
        """What the star's size leaves of each frequency of an image, in the order of `numpy.fft.rfft2`."""
        fx_per_m = np.fft.rfftfreq(grid.shape[1], grid.pixel_m)[None, :]
        return self.fading(abs(distance_m) * np.hypot(grid.fy_per_m, fx_per_m))

    def fading(self, cycles_per_rad: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """What the star's size leaves of a wave in an image: its visibility at the baseline z f.

        Args:
            cycles_per_rad: Distance of the plane times the frequency of the wave.

        Examples:
            >>> ApparentStar(size_rad=1e-7).fading(np.array([0.0, 1.21967e7])).round(4) + 0.0  # Airy's first zero
            array([1., 0.])
        """
        cycles = self.size_rad * np.asarray(cycles_per_rad, float)
        if self.profile == "gaussian":
            return np.exp(-2 * (np.pi * cycles / FWHM_IN_SIGMA) ** 2)
        angle = np.pi * np.where(cycles > 0, cycles, 1.0)
        return np.where(cycles > 0, 2 * scipy.special.j1(angle) / angle, 1.0)


POINT = ApparentStar()
"""A star without size, all of whose colours come from one place."""
