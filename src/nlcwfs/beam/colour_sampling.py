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

Light of two segments with a step :math:`\Delta` between them makes fringes, whose coherence has the mean of
:math:`\cos[(k - k') \Delta]` over the steps as a factor. A step is told by them to a small part of a wavelength.
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

FRINGE_ERROR_ALLOWED = 3e-3
"""Of the fringes of steps, rms: they tell a step to lambda / (2 pi) of that or better, 0.3 nm at 0.65 um."""

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

Coherence = Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]]
"""From the difference of two wave numbers, 1/m, to the coherence of their light."""


@dataclass(frozen=True)
class ColouredImage:
    """What decides how an image changes with the wavelength.

    Attributes:
        diameter_m: Of the telescope.
        distance_m: Of the plane, as a function of the wavelength.
        structure_m2: Of the wavefront.
        direction_rad: Where a colour comes from, (y, x) as a function of the wavelength; all from one place if
            left out.
        fringes: Coherence of the fringes of steps between segments, as a function of the difference of two wave
            numbers, see `step_coherence`; None for a pupil of one piece.

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
    fringes: Coherence | None = None

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

    def fringe_coherence(self, wavelengths_m: Sequence[float]) -> Float[np.ndarray, "colour colour"]:
        """How alike the fringes of steps between segments are; nothing for a pupil of one piece."""
        colours = np.asarray(wavelengths_m)
        if self.fringes is None:
            return np.zeros((len(colours), len(colours)))
        reach = colours * [self.distance_m(colour) for colour in wavelengths_m]
        cycles = np.geomspace(1, FINEST_RIPPLE_CPA, RIPPLES)
        turn = np.pi * (reach[:, None] - reach[None, :]) * (cycles[:, None, None] / self.diameter_m) ** 2
        rims = np.einsum("f,fij->ij", cycles**-1 / np.sum(cycles**-1), np.cos(turn))  # power f^-2 of a straight rim
        k = 2 * np.pi / colours
        return self.speckle_coherence(wavelengths_m) * self.fringes(k[:, None] - k[None, :]) * rims

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
    return max(_error(coherence, band, spectrum) for coherence in (image.speckle_coherence, image.ripple_coherence))


def fringe_error(image: ColouredImage, band: LightBand, spectrum: Spectrum) -> float:
    """The same of the fringes of steps between segments; 0 for a pupil of one piece.

    Args:
        image: What the wavelength changes.
        band: The light.
        spectrum: The few wavelengths that stand for it.

    Examples:
        >>> steps = step_coherence(range_m=1e-6)
        >>> still = ColouredImage(8.0, lambda wavelength_m: 0.0, lambda apart_m: 0 * apart_m, fringes=steps)
        >>> band = LightBand.flat(wavelength_m=0.65e-6, bandwidth_m=0.325e-6)
        >>> fringe_error(still, band, band.spectrum(2)) > 0.1, fringe_error(still, band, band.spectrum(12)) < 1e-3
        (True, True)
    """
    return 0.0 if image.fringes is None else _error(image.fringe_coherence, band, spectrum)


def step_coherence(
    *, pistons_m: Sequence[float] = (0.0, 0.0), range_m: float = 0.0, tilt_rms_m: float = 0.0
) -> Coherence:
    r"""Coherence of the fringes between segments, mean over all pairs of them.

    Pistons that are drawn evenly leave :math:`(\sin q R / q R)^2` of wave numbers that are q apart; tilts are drawn
    from a normal distribution along two axes of two segments.

    Args:
        pistons_m: Given for each segment.
        range_m: Others beside, drawn evenly from minus to plus this.
        tilt_rms_m: Of a tilt along one axis, over a segment.

    Examples:
        >>> wave_numbers = np.array([0.0, np.pi / 1e-6])
        >>> step_coherence(pistons_m=(0.0, 1e-6))(wave_numbers).round(6).tolist()
        [1.0, -1.0]
        >>> step_coherence(range_m=1e-6)(wave_numbers).round(6).tolist()
        [1.0, 0.0]
    """
    first, second = np.triu_indices(len(pistons_m), 1)
    steps_m = np.asarray(pistons_m)[first] - np.asarray(pistons_m)[second]

    def coherence(q: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        given = np.mean(np.cos(np.asarray(q)[..., None] * steps_m), axis=-1)
        return given * np.sinc(q * range_m / np.pi) ** 2 * np.exp(-2 * (q * tilt_rms_m) ** 2)

    return coherence


def wavelengths_needed(images: Sequence[ColouredImage], band: LightBand, *, error: float = ERROR_ALLOWED) -> int:
    """The fewest of Gauss's nodes with which every image is right, and the fringes of steps to `FRINGE_ERROR_ALLOWED`.

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

    def suffices(image: ColouredImage, spectrum: Spectrum) -> bool:
        if sampling_error(image, band, spectrum) > error:
            return False
        return fringe_error(image, band, spectrum) <= FRINGE_ERROR_ALLOWED

    for image in images:
        while count < most and not suffices(image, band.spectrum(count)):
            count = min(most, math.ceil(1.1 * count))  # one more at a time, then steps of a tenth
    return count


def _error(
    coherence: Callable[[Sequence[float]], Float[np.ndarray, "colour colour"]], band: LightBand, spectrum: Spectrum
) -> float:
    """Error of a sum over few wavelengths whose terms have this coherence, over the whole; rms."""
    dense = band.spectrum(min(max(DENSER * len(spectrum.shares), 8), band.most))
    true = np.concatenate([np.zeros(len(spectrum.shares)), dense.shares])
    wrong = true - np.concatenate([spectrum.shares, np.zeros(len(dense.shares))])
    alike = coherence((*spectrum.wavelengths_m, *dense.wavelengths_m))
    whole = float(true @ alike @ true)
    return float(np.sqrt(max(float(wrong @ alike @ wrong), 0.0) / whole)) if whole > 0 else 0.0
