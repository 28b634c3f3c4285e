r"""A membrane that vibrates in the focus: one detector sees the planes one after the other, instead of beam splitters.

Its curvature moves the plane that the detector sees between +z and -z, as in curvature sensors that are in use
(Roddier, Northcott & Graves 1991, PASP 103, 131). While light is integrated the plane moves on: the image is the mean
over the distances of half a period. It vibrates thousands of times a second, many times in an exposure, so that the
air is the same for all moments.

- Sine: :math:`z(t) = \frac{\pi}{2} \bar z \sin(\pi t / T)` over half a period T, with the mean :math:`\bar z`.
- Square: at rest at :math:`\bar z`, with dead time while it moves.

In the dead time, half of it at each end of the half period, nothing is integrated; its light is lost.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.errors import SettingsError

Motion = Literal["none", "sine", "square"]


class Moments(NamedTuple):
    """Moments that stand for the half period in which a plane is seen.

    Attributes:
        scales: Distance of the plane in each, over its mean distance without dead time.
        shares: Share of the integrated light.
    """

    scales: Float[np.ndarray, " moment"]
    shares: Float[np.ndarray, " moment"]


def membrane_moments(motion: Motion, *, count: int, dead_share: float = 0.0) -> Moments:
    """Where the plane is in a few moments of the half period: Gauss and Legendre's of a quarter, of which it is twice.

    Args:
        motion: None and square stay where they are.
        count: How many moments, see `moments_needed`.
        dead_share: Of the half period, in which nothing is integrated.

    Raises:
        SettingsError: If there is no moment, or only dead time.

    Examples:
        The mean distance of a sine is the quoted one; dead time leaves out the near planes.

        >>> sine = membrane_moments("sine", count=6)
        >>> round(float(sine.scales @ sine.shares), 6), round(float(sine.scales.max()), 2)
        (1.0, 1.57)
        >>> late = membrane_moments("sine", count=6, dead_share=0.5)
        >>> round(float(late.scales @ late.shares), 3)
        1.414
    """
    if count < 1:
        raise SettingsError("curvature_sensor.membrane", "must have at least one moment", count)
    if not 0 <= dead_share < 1:
        raise SettingsError("curvature_sensor.membrane_dead_share", "must be at least 0 and below 1", dead_share)
    if motion != "sine":
        return Moments(np.ones(1), np.ones(1))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    phase = dead_share / 2 + (1 - dead_share) / 4 * (nodes + 1)
    return Moments(np.pi / 2 * np.sin(np.pi * phase), weights / 2)


def moments_needed(*, distance_m: float, wavelength_m: float, finest_per_m: float) -> int:
    r"""Moments that a sine needs, for ripples up to a frequency.

    The signal of a ripple turns by :math:`\pi \lambda z f^2`, from nothing to :math:`\pi / 2` times that of the mean
    distance; Gauss and Legendre's nodes follow half of it in radians with as many, and 6 more for rounding.

    Args:
        distance_m: Mean distance of the farthest plane.
        wavelength_m: Of the light.
        finest_per_m: Highest frequency, cycles per metre.

    Examples:
        >>> moments_needed(distance_m=3.5e6, wavelength_m=0.85e-6, finest_per_m=2.0)
        36
    """
    turns_rad = np.pi / 2 * np.pi * wavelength_m * abs(distance_m) * finest_per_m**2
    return math.ceil(turns_rad / 2) + 6
