r"""How many wavelengths stand for a band: enough, so that the images of neighbours hardly differ.

A wave of frequency f in the image at z comes from pairs of points of the pupil that are :math:`s = \lambda z f` apart.
Its phase is that of the pair, :math:`k\,(\mathrm{OPD}(u + s/2) - \mathrm{OPD}(u - s/2))`. From one colour to another it
changes because k does, and because s does unless the lenses keep :math:`\lambda z`. For Gaussian wavefronts of
structure function D the images keep the coherence :math:`\exp(-V/2)`,

.. math::

    V = k^2 D(s) + k'^2 D(s') - 2 k k' \left[D\left(\tfrac{s + s'}{2}\right) - D\left(\tfrac{s - s'}{2}\right)\right],

which knows that a common tilt moves all colours alike. A star whose colours come from directions that are
:math:`\theta` apart adds the factor :math:`J_0(k s \theta)`. A weak wavefront instead shows the signal
:math:`k \sin(\pi \lambda z f^2)` of each ripple. From such a coherence C the mean square error of a sum over
wavelengths follows as :math:`c^T C c`, c the shares less those of a much denser sum; relative to that of the images
themselves, :math:`p^T C p`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Float

from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.spectrum import Spectrum

ERROR_ALLOWED = 0.03
"""Of the images' fluctuations, rms: photon noise in a bright frame (1e3 photons a pixel) is as large."""

DENSER = 2
"""The sum that a sum is compared with has so many times its wavelengths: Gauss's nodes converge exponentially."""

SEPARATIONS = 48
RIPPLES = 300
FINEST_RIPPLE_CPA = 32.0
"""Kolmogorov's ripples of more cycles per aperture hold 0.3 % of the variance."""

MOST_BY_DEFAULT = 64
"""More wavelengths than that are a user's choice."""

StructureFunction = Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]]
"""From the distance of two points to the mean square difference of the OPD in m^2, as `Turbulence.structure_m2`."""


@dataclass(frozen=True)
class ColouredImage:
    """What decides how an image changes with the wavelength.

    Attributes:
        diameter_m: Of the telescope.
        distance_m: Of the plane, as a function of the wavelength.
        structure_m2: Of the wavefront.
        direction_rad: Where a colour comes from, (y, x) as a function of the wavelength; all from one place if
            left out.

    Examples:
        >>> image = ColouredImage(8.0, lambda wavelength_m: 2.5e6, lambda apart_m: 1e-14 * np.abs(apart_m) ** (5 / 3))
        >>> band = LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=0.17e-6)
        >>> bool(sampling_error(image, band, band.spectrum(6)) < 0.02 < sampling_error(image, band, band.spectrum(3)))
        True
    """

    diameter_m: float
    distance_m: Callable[[float], float]
    structure_m2: StructureFunction
    direction_rad: Callable[[float], tuple[float, float]] = lambda wavelength_m: (0.0, 0.0)

    def speckle_coherence(self, wavelengths_m: Sequence[float]) -> Float[np.ndarray, "colour colour"]:
        """How alike strongly aberrated images of two colours are; 1 is alike."""
        colours = np.asarray(wavelengths_m)
        k = 2 * np.pi / colours
        reach = colours * [self.distance_m(colour) for colour in wavelengths_m]
        ratio = reach / reach[len(reach) // 2] if np.any(reach) else np.ones_like(reach)
        share = (np.arange(SEPARATIONS) + 0.5) / SEPARATIONS
        weight = share * (np.arccos(share) - share * np.sqrt(1 - share**2))  # pairs of a disc that are so far apart
        s = (share * self.diameter_m)[:, None, None] * ratio[None, :, None]
        other = np.swapaxes(s, 1, 2)
        mean, half = self.structure_m2((s + other) / 2), self.structure_m2(np.abs(s - other) / 2)
        both = k[:, None] ** 2 * self.structure_m2(s) + k[None, :] ** 2 * self.structure_m2(other)
        variance = both - 2 * k[:, None] * k[None, :] * (mean - half)
        towards = np.array([self.direction_rad(colour) for colour in wavelengths_m])
        apart = np.linalg.norm(towards[:, None] - towards[None], axis=-1)
        fade = scipy.special.j0(np.sqrt(k[:, None] * k[None, :]) * np.sqrt(s * other) * apart)
        return np.einsum("s,sij->ij", weight / weight.sum(), np.exp(-variance / 2) * fade)

    def ripple_coherence(self, wavelengths_m: Sequence[float]) -> Float[np.ndarray, "colour colour"]:
        """The same for weakly aberrated images, whose ripples are those of the air."""
        colours = np.asarray(wavelengths_m)
        reach = colours * [self.distance_m(colour) for colour in wavelengths_m]
        cycles = np.geomspace(1, FINEST_RIPPLE_CPA, RIPPLES)
        signal = np.sin(np.pi * reach * (cycles[:, None] / self.diameter_m) ** 2) / colours
        weight = cycles ** (-5 / 3)  # Kolmogorov's -11/3, and f^2 for the area of a step in log f
        return np.einsum("f,fi,fj->ij", weight, signal, signal)


def sampling_error(image: ColouredImage, band: LightBand, spectrum: Spectrum) -> float:
    """Error of an image that is summed over few wavelengths, over the fluctuations of the image; rms.

    The larger of that behind the whole wavefront and that behind a weak one.

    Args:
        image: What the wavelength changes.
        band: The light.
        spectrum: The few wavelengths that stand for it.

    Examples:
        >>> still = ColouredImage(8.0, lambda wavelength_m: 0.0, lambda apart_m: 0 * apart_m)
        >>> band = LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=0.17e-6)
        >>> sampling_error(still, band, band.spectrum(1)) < 1e-7  # squares are right to rounding
        True
    """
    dense = band.spectrum(min(max(DENSER * len(spectrum.shares), 8), band.most))
    colours = (*spectrum.wavelengths_m, *dense.wavelengths_m)
    true = np.concatenate([np.zeros(len(spectrum.shares)), dense.shares])
    wrong = true - np.concatenate([spectrum.shares, np.zeros(len(dense.shares))])
    worst = 0.0
    for coherence in (image.speckle_coherence(colours), image.ripple_coherence(colours)):
        whole = float(true @ coherence @ true)
        if whole > 0:
            worst = max(worst, float(wrong @ coherence @ wrong) / whole)
    return float(np.sqrt(worst))


def wavelengths_needed(images: Sequence[ColouredImage], band: LightBand, *, error: float = ERROR_ALLOWED) -> int:
    """The fewest of Gauss's nodes with which every image is right.

    Args:
        images: One for each plane.
        band: The light.
        error: Largest error, see `sampling_error`.

    Returns:
        How many, at most 64 even if they do not suffice, as `sampling_error` then says.

    Examples:
        >>> image = ColouredImage(8.0, lambda wavelength_m: 2.5e6, lambda apart_m: 1e-14 * np.abs(apart_m) ** (5 / 3))
        >>> narrow, wide = (LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=width_m) for width_m in (0.01e-6, 0.17e-6))
        >>> wavelengths_needed([image], narrow) < wavelengths_needed([image], wide)
        True
    """
    most, count = max(1, min(MOST_BY_DEFAULT, band.most // DENSER)), 1
    for image in images:
        while count < most and sampling_error(image, band, band.spectrum(count)) > error:
            count = min(most, math.ceil(1.1 * count))  # one more at a time, then steps of a tenth
    return count
