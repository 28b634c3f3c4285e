"""How many pixels, and how wide a window, defocused pupil images need; and what too few of them cost."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlcwfs.beam.sampling_cost import SensedLight, pixel_error, window_costs
from nlcwfs.errors import SamplingError

FEWEST_PIXELS_ACROSS = 4
"""With fewer pixels across the pupil not even defocus and astigmatism are told apart."""

COARSEST_PIXEL_IN_SPECKLES = 2.0
"""A pixel of two speckles averages four of them: what is left is the light of the pupil, not its phase."""

LOSS_WORTH_A_WORD = 0.01
ERROR_WORTH_A_WORD = 0.03
"""Photon noise in a bright frame (1e3 photons a pixel) is 3 %; smaller errors of the model drown in it."""


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

    The window is `D + 2 |z| alpha`. Speckles are `lambda |z| / D` wide and need two pixels, so the window holds
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
                f"{at} pixels of {pixel_m:.3f} m leave {max(kept, 0.0):.0%} of the contrast of the finest"
                f" speckles; {plane.pixel_m:.3f} m leave {wanted:.0%}."
            )
            warnings.append(SamplingWarning(_spaced(sentence), plane.distance_m, 1 - max(kept, 0.0)))
        lost, wrapped = window_costs(light, distance_m=plane.distance_m, window_m=window_m)
        if lost > LOSS_WORTH_A_WORD:
            sentence = (
                f"{at} a window of {window_m:.4g} m misses {lost:.1%} of the light;"
                f" D + 2 z alpha is {plane.window_m:.4g} m."
            )
            warnings.append(SamplingWarning(_spaced(sentence), plane.distance_m, lost))
        if periodic:
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
        rule = f"must be positive and put at least {FEWEST_PIXELS_ACROSS} pixels across {light.diameter_m:g} m"
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


def _spaced(sentence: str) -> str:
    """A blank between number and percent sign."""
    return sentence.replace("%", " %")
