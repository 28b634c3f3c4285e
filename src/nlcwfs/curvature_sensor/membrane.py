r"""A membrane that vibrates in the focus: one detector sees the planes one after the other, instead of beam splitters.

Its curvature moves the plane that the detector sees between +z and -z, as in curvature sensors that are in use
(Roddier, Northcott & Graves 1991, PASP 103, 131). While light is integrated the plane moves on: the image is the mean
over the distances of half a period. It vibrates thousands of times a second, many times in an exposure, so that the
air is the same for all moments.

- Sine: :math:`z(t) = \frac{\pi}{2} \bar z \sin(\pi t / T)` over half a period T, with the mean :math:`\bar z`.
- Square: at rest at :math:`\bar z`, with dead time while it moves.

In the dead time, half of it at each end of the half period, nothing is integrated; its light is lost.
"""

import dataclasses
import math
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.colour_sampling import FINEST_RIPPLE_CPA
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.apparent_star import ApparentStar
from nlcwfs.errors import SettingsError

Motion = Literal["none", "sine", "square"]

ERROR_ALLOWED = 0.1
"""Of the ripples of a model's images, rms."""

RIPPLES = 2000
"""Frequencies at which ripples are looked at: at 3500 km the finest turn by less than 1 rad from one to the next."""

MOST_IN_A_MODEL = 64
"""Moments that a reconstructor's model may have, see `estimation.map.membrane_moments`."""


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


def moving_light(
    spectrum: Spectrum, distances_m: Float[np.ndarray, "colour plane"], star: ApparentStar, moments: Moments
) -> tuple[Spectrum, Float[np.ndarray, "light plane"], ApparentStar]:
    """Light behind a membrane, as light of more colours: each colour once for every moment.

    Args:
        spectrum: Colours of the light.
        distances_m: Mean distance of every plane in each of them.
        star: Where each comes from.
        moments: Of the membrane.

    Examples:
        >>> red, sine = Spectrum.monochromatic(0.85e-6), membrane_moments("sine", count=3)
        >>> lights, places_m, _ = moving_light(red, np.array([[-1e6, 1e6]]), ApparentStar(), sine)
        >>> len(lights.shares), round(lights.shares @ places_m[:, 1])
        (3, 1000008)
    """
    count = len(moments.scales)
    shares = tuple(colour * moment for colour in spectrum.shares for moment in moments.shares.tolist())
    wavelengths_m = tuple(colour_m for colour_m in spectrum.wavelengths_m for _ in range(count))
    moved_m = np.einsum("cp,m->cmp", distances_m, moments.scales).reshape(len(shares), -1)
    directions = tuple(one for one in star.directions_rad for _ in range(count))
    return Spectrum(wavelengths_m, shares), moved_m, dataclasses.replace(star, directions_rad=directions)


def ripple_error(
    count: int, *, distance_m: float, wavelength_m: float, diameter_m: float, dead_share: float = 0.0
) -> float:
    r"""Error of the images of Kolmogorov's ripples in so many moments of a sine, over these images; rms.

    A ripple whose signal turns by x at the mean distance keeps the mean of :math:`\sin(x\, z / \bar z)`; without dead
    time that is Struve's :math:`\mathrm{H}_0(\pi x / 2)`. Few moments follow slow ripples; those that are too fine
    for them are missed whole, so that the error falls only about as fast as the moments grow.

    Args:
        count: Moments.
        distance_m: Mean distance of the plane.
        wavelength_m: Of the light.
        diameter_m: Of the telescope, whose ripples have one cycle and more.
        dead_share: Of the half period.

    Examples:
        >>> far = {"distance_m": 3.5e6, "wavelength_m": 0.85e-6, "diameter_m": 8.0}
        >>> [round(ripple_error(count, **far), 2) for count in (1, 4, 8, 16)]
        [0.56, 0.17, 0.09, 0.05]
    """
    cycles = np.geomspace(1, FINEST_RIPPLE_CPA, RIPPLES)
    frequency_per_m, finest_per_m = cycles / diameter_m, FINEST_RIPPLE_CPA / diameter_m
    turns_rad = np.pi * wavelength_m * distance_m * frequency_per_m**2
    enough = moments_needed(distance_m=distance_m, wavelength_m=wavelength_m, finest_per_m=finest_per_m)
    true, seen = (
        np.sin(turns_rad[:, None] * few.scales) @ few.shares
        for few in (membrane_moments("sine", count=one, dead_share=dead_share) for one in (enough, count))
    )
    weight = cycles ** (-5 / 3)  # Kolmogorov's -11/3, and f^2 for the area of a step in log f
    return float(np.sqrt(weight @ (seen - true) ** 2 / (weight @ true**2)))


def moments_of_model(
    motion: Motion, *, distance_m: float, wavelength_m: float, diameter_m: float, dead_share: float = 0.0
) -> int:
    """The fewest moments with which a model's images are right to `ERROR_ALLOWED`, see `ripple_error`.

    Args:
        motion: Of the membrane.
        distance_m: Mean distance of the farthest plane.
        wavelength_m: Of the light.
        diameter_m: Of the telescope.
        dead_share: Of the half period.

    Examples:
        >>> light = {"wavelength_m": 0.85e-6, "diameter_m": 8.0}
        >>> [moments_of_model("sine", distance_m=z_m, **light) for z_m in (0.5e6, 3.5e6)]
        [6, 8]
        >>> moments_of_model("square", distance_m=3.5e6, **light)
        1
    """
    if motion != "sine":
        return 1
    light = {"distance_m": distance_m, "wavelength_m": wavelength_m, "diameter_m": diameter_m}
    counts = range(1, MOST_IN_A_MODEL)
    good = (count for count in counts if ripple_error(count, **light, dead_share=dead_share) <= ERROR_ALLOWED)
    return next(good, MOST_IN_A_MODEL)
