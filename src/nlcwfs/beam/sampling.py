"""How many pixels, and how wide a window, defocused pupil images need; and what too few of them cost."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Float
from scipy.special import j1

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import KOLMOGOROV_STRUCTURE
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.constants import SEEING_TO_FRIED
from nlcwfs.errors import SamplingError

FEWEST_PIXELS_ACROSS = 4
"""With fewer pixels across the pupil not even defocus and astigmatism are told apart."""

COARSEST_PIXEL_IN_SPECKLES = 2.0
"""A pixel of two speckles averages four of them: what is left is the light of the pupil, not its phase."""

LOSS_WORTH_A_WORD = 0.01
ERROR_WORTH_A_WORD = 0.03
"""Photon noise in a bright frame (1e3 photons a pixel) is 3 %; smaller errors of the model drown in it."""


@dataclass(frozen=True)
class SensedLight:
    """The light to be sampled: how wide the pupil is and how rough the wavefront.

    Attributes:
        diameter_m: Diameter of the telescope.
        wavelength_m: Wavelength at which the sensor works.
        cycles_per_aperture: Highest spatial frequency that is to be sensed (the control radius).
        fried_m: Fried parameter of uncorrected turbulence at this wavelength; None in closed loop.
        rms_rad: Rms of a phase that is white below `cycles_per_aperture`, on top of the turbulence.

    Raises:
        SamplingError: If a length or the frequency is not positive.
    """

    diameter_m: float
    wavelength_m: float
    cycles_per_aperture: float = 16.0
    fried_m: float | None = None
    rms_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("diameter_m", "wavelength_m", "cycles_per_aperture", "fried_m"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and np.isfinite(value)):
                raise SamplingError(f"light.{name}", "must be positive and finite", value)
        if not (self.rms_rad >= 0 and np.isfinite(self.rms_rad)):
            raise SamplingError("light.rms_rad", "must be at least 0 and finite", self.rms_rad)

    @property
    def half_angle_rad(self) -> float:
        """Alpha of the paper, sec. 2.5: the control radius, or half the width of the PSF if that is wider."""
        cycle_rad = self.wavelength_m / self.diameter_m
        control_rad = self.cycles_per_aperture * cycle_rad
        # White below f: mean squared slope along one axis is (2 pi f rms)^2 / 4; half width of a Gaussian.
        rough_rad = math.sqrt(2 * math.log(2)) * self.rms_rad * control_rad / 2
        seeing_rad = 0.0 if self.fried_m is None else SEEING_TO_FRIED * self.wavelength_m / self.fried_m
        return max(control_rad, math.hypot(rough_rad, seeing_rad / 2))

    def structure_rad2(self, separation_m: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Mean squared difference of the phase at two points."""
        # White below f: covariance rms^2 * 2 J1(u) / u with u = 2 pi f r.
        angle = 2 * np.pi * self.cycles_per_aperture / self.diameter_m * np.maximum(separation_m, 1e-12)
        structure = 2 * self.rms_rad**2 * (1 - 2 * j1(angle) / angle)
        if self.fried_m is not None:
            structure = structure + KOLMOGOROV_STRUCTURE * (separation_m / self.fried_m) ** (5 / 3)
        return structure


@dataclass(frozen=True)
class PlaneNeed:
    """What one plane asks for.

    Attributes:
        distance_m: Where the plane is.
        speckle_m: Size of the finest detail of the light.
        pixel_m: Widest pixel that gives two pixels to that detail.
        window_m: Window that holds the light.
    """

    distance_m: float
    speckle_m: float
    pixel_m: float
    window_m: float

    @property
    def window_pixels(self) -> int:
        """Pixels along the window: N of the paper's sec. 2.5."""
        return math.ceil(round(self.window_m / self.pixel_m, 6))


@dataclass(frozen=True)
class SamplingNeed:
    """What a sensor with several planes on equal pixels asks for; one record a plane in `planes`."""

    diameter_m: float
    planes: tuple[PlaneNeed, ...]

    @property
    def pixel_m(self) -> float:
        """Widest pixel that serves every plane."""
        return min(plane.pixel_m for plane in self.planes)

    @property
    def window_m(self) -> float:
        """Window that holds the light of every plane."""
        return max(plane.window_m for plane in self.planes)

    @property
    def pixels_across_pupil(self) -> int:
        """Pixels across the pupil that serve every plane."""
        return math.ceil(round(self.diameter_m / self.pixel_m, 6))

    @property
    def window_pixels(self) -> int:
        """Pixels along the window that serve every plane."""
        return math.ceil(round(self.window_m / self.pixel_m, 6))


@dataclass(frozen=True)
class SamplingWarning:
    """A plain sentence, and the error it speaks of as a fraction of the light."""

    sentence: str
    distance_m: float
    error: float

    def __str__(self) -> str:
        return self.sentence


def sampling_needed(light: SensedLight, distances_m: Sequence[float]) -> SamplingNeed:
    """Pixels and window after Guyon 2010, sec. 2.5, with its factor of two mended.

    The window is D + 2 |z| alpha. Speckles are lambda |z| / D wide and need two pixels, so the window holds
    N = 2 D (D + 2 z alpha) / (lambda z) pixels; at z0 = D / (2 alpha) that is 8 D alpha / lambda, twice what
    the paper prints. Nearer than z0 the law would ask for ever finer pixels, but light that stays within
    alpha interferes in fringes no finer than lambda / (2 alpha): there the speckle stays at its size at z0.

    Raises:
        SamplingError: If there is no plane, or a distance is not finite.

    Examples:
        >>> light = SensedLight(diameter_m=8.0, wavelength_m=0.8e-6, cycles_per_aperture=10.0)
        >>> need = sampling_needed(light, [4e6])
        >>> need.pixels_across_pupil, round(need.window_m, 6), need.window_pixels
        (40, 16.0, 80)
    """
    _check_planes(distances_m)
    finest_m = light.wavelength_m / (2 * light.half_angle_rad)
    planes = []
    for distance_m in distances_m:
        speckle_m = max(light.wavelength_m * abs(distance_m) / light.diameter_m, finest_m)
        window_m = light.diameter_m + 2 * abs(distance_m) * light.half_angle_rad
        planes.append(PlaneNeed(float(distance_m), speckle_m, speckle_m / 2, window_m))
    return SamplingNeed(light.diameter_m, tuple(planes))


def light_outside(light: SensedLight, *, distance_m: float, window_m: float) -> float:
    """Fraction of the light of a round pupil that misses a square window, on average over wavefronts.

    Exact for Gaussian phase, tilt included: the mean image is that of a flat wavefront with its spectrum
    times exp(-D(lambda z f) / 2), D the structure function (Roddier 1981, sec. 4.2).

    Examples:
        >>> turbulence = SensedLight(diameter_m=8.0, wavelength_m=0.65e-6, fried_m=0.5)
        >>> [round(light_outside(turbulence, distance_m=3.5e6, window_m=w), 2) for w in (11.4, 22.8)]
        [0.15, 0.02]
    """
    return _outside(_mean_image(light, distance_m, window_m))


def wrapping_error(light: SensedLight, *, distance_m: float, window_m: float) -> float:
    """Relative rms error of the intensity when light that leaves a periodic grid re-enters on the other side.

    Returned light of mean intensity w interferes with what is there, i, as one speckle field with another:
    the squared error is 2 i w + 2 w^2, set against the squared intensity, i^2 and as much again for its
    speckles.
    """
    return _folding_error(light, _mean_image(light, distance_m, window_m))


def pixel_error(light: SensedLight, *, distance_m: float, pixel_m: float) -> float:
    """Relative rms error of the intensity when a pixel shows the light at its centre, not its mean.

    Fully developed speckles have the power spectrum of the pupil's own transfer function (Goodman 2007,
    sec. 4.4.1), up to D / (lambda z) or what light within twice alpha can make; a pixel multiplies it with
    its sinc. The rings of a flat wavefront, 1 to 3 % with 45 pixels across, are not in this estimate.
    """
    finest_m = light.wavelength_m / (4 * light.half_angle_rad)
    detail_m = max(light.wavelength_m * abs(distance_m) / light.diameter_m, finest_m)
    along = (np.arange(200) + 0.5) / 200
    frequency = np.hypot(along[:, None], along)
    inside = np.minimum(frequency, 1)
    power = np.arccos(inside) - inside * np.sqrt(1 - inside**2)
    kept = np.sinc(along[:, None] * pixel_m / detail_m) * np.sinc(along * pixel_m / detail_m)
    contrast2 = _contrast2(light)
    lost = contrast2 * np.sum(power * (1 - kept) ** 2) / np.sum(power)
    return float(np.sqrt(lost / (1 + contrast2)))


def check_sampling(
    light: SensedLight,
    distances_m: Sequence[float],
    *,
    pixel_m: float,
    window_m: float,
    periodic: bool = False,
) -> list[SamplingWarning]:
    """Say in plain sentences what a choice of pixels and window costs; refuse what cannot work.

    Args:
        pixel_m: Width of a pixel of the detector or of the model's grid.
        window_m: Width of the detector's window or of the model's grid.
        periodic: True for the grid of a model, where light that leaves re-enters (an FFT), and a pixel holds
            the light at its centre.

    Raises:
        SamplingError: If fewer than 4 pixels lie across the pupil, the window is smaller than the pupil, or
            a pixel is wider than two speckles.

    Examples:
        >>> light = SensedLight(diameter_m=8.0, wavelength_m=0.85e-6)
        >>> for warning in check_sampling(light, [3.5e6], pixel_m=0.3, window_m=24.0):
        ...     print(warning)
        At 3500 km pixels of 0.300 m leave 23 % of the contrast of the finest speckles; 0.186 m leave 64 %.
    """
    need = sampling_needed(light, distances_m)
    _refuse_impossible(light, need, pixel_m, window_m)
    warnings = []
    for plane in need.planes:
        at = f"At {plane.distance_m / 1e3:.4g} km"
        if pixel_m > plane.pixel_m * (1 + 1e-6):
            kept, wanted = float(np.sinc(pixel_m / plane.speckle_m)), float(np.sinc(0.5))
            sentence = (
                f"{at} pixels of {pixel_m:.3f} m leave {max(kept, 0):.0%} of the contrast of the finest"
                f" speckles; {plane.pixel_m:.3f} m leave {wanted:.0%}."
            )
            warnings.append(SamplingWarning(_spaced(sentence), plane.distance_m, 1 - max(kept, 0)))
        image = _mean_image(light, plane.distance_m, window_m)
        lost = _outside(image)
        if lost > LOSS_WORTH_A_WORD:
            sentence = (
                f"{at} a window of {window_m:.4g} m misses {lost:.1%} of the light;"
                f" D + 2 z alpha is {plane.window_m:.4g} m."
            )
            warnings.append(SamplingWarning(_spaced(sentence), plane.distance_m, lost))
        if periodic:
            wrapped = _folding_error(light, image)
            coarse = pixel_error(light, distance_m=plane.distance_m, pixel_m=pixel_m)
            error = math.hypot(wrapped, coarse)
            if error > ERROR_WORTH_A_WORD:
                sentence = (
                    f"{at} the model's intensity is wrong by about {error:.0%} rms: {wrapped:.0%} because"
                    f" light re-enters its window, {coarse:.0%} because of its pixels."
                )
                warnings.append(SamplingWarning(_spaced(sentence), plane.distance_m, error))
    return warnings


def _refuse_impossible(light: SensedLight, need: SamplingNeed, pixel_m: float, window_m: float) -> None:
    if not (pixel_m > 0 and light.diameter_m / pixel_m >= FEWEST_PIXELS_ACROSS):
        rule = (
            f"must be positive and put at least {FEWEST_PIXELS_ACROSS} pixels across {light.diameter_m:g} m"
        )
        raise SamplingError("sampling.pixel_m", rule, pixel_m)
    if not (light.diameter_m * (1 - 1e-9) <= window_m < np.inf):
        rule = f"must hold at least the pupil of {light.diameter_m:g} m"
        raise SamplingError("sampling.window_m", rule, window_m)
    widest_m = COARSEST_PIXEL_IN_SPECKLES * min(plane.speckle_m for plane in need.planes)
    if pixel_m > widest_m:
        raise SamplingError("sampling.pixel_m", f"must be at most two speckles, {widest_m:.3g} m", pixel_m)


def _check_planes(distances_m: Sequence[float]) -> None:
    if len(distances_m) == 0 or not np.all(np.isfinite(distances_m)):
        raise SamplingError("sampling.distances_m", "must be at least one finite distance", distances_m)


def _mean_image(light: SensedLight, distance_m: float, window_m: float) -> np.ndarray:
    """Mean image, cut into copies of the window: `[tile_y, y, tile_x, x]`, the middle tile is the window."""
    reach_m = light.diameter_m + 6 * abs(distance_m) * light.half_angle_rad
    tiles = 2 * max(1, math.ceil((reach_m / window_m - 1) / 2)) + 1
    pixels = scipy.fft.next_fast_len(math.ceil(900 / tiles))
    grid = Grid((tiles * pixels, tiles * pixels), window_m / pixels)
    pupil = circular_pupil(grid, diameter_m=light.diameter_m)
    frequency2_per_m2 = grid.fy_per_m**2 + grid.fx_per_m**2
    travel = np.exp(-1j * np.pi * light.wavelength_m * distance_m * frequency2_per_m2)
    image = np.abs(scipy.fft.ifft2(scipy.fft.fft2(pupil) * travel)) ** 2
    separation_m = light.wavelength_m * abs(distance_m) * np.sqrt(frequency2_per_m2)
    blur = np.exp(-light.structure_rad2(separation_m) / 2)
    image = np.maximum(scipy.fft.ifft2(scipy.fft.fft2(image) * blur).real, 0)
    return image.reshape(tiles, pixels, tiles, pixels)


def _outside(image: np.ndarray) -> float:
    middle = image.shape[0] // 2
    return float(1 - image[middle, :, middle, :].sum() / image.sum())


def _folding_error(light: SensedLight, image: np.ndarray) -> float:
    middle = image.shape[0] // 2
    here = image[middle, :, middle, :]
    returned = image.sum(axis=(0, 2)) - here
    squared_error = np.sum(2 * here * returned + 2 * returned**2)
    return float(np.sqrt(squared_error / ((1 + _contrast2(light)) * np.sum(here**2))))


def _contrast2(light: SensedLight) -> float:
    """Squared contrast of the speckles: 1 when developed, 0 for a flat wavefront."""
    return 1.0 if light.fried_m is not None else -math.expm1(-(light.rms_rad**2))


def _spaced(sentence: str) -> str:
    """A blank between number and percent sign."""
    return sentence.replace("%", " %")
