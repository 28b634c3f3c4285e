"""What light a window misses, and how wrong a coarse or narrow grid makes an image."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import j1

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.constants import KOLMOGOROV_STRUCTURE, SEEING_TO_FRIED
from nlcwfs.errors import SamplingError


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


def light_outside(light: SensedLight, *, distance_m: float, window_m: float) -> float:
    """Fraction of the light of a round pupil that misses a square window, on average over wavefronts.

    Exact for Gaussian phase, tilt included: the mean image is that of a flat wavefront with its spectrum
    times exp(-D(lambda z f) / 2), D the structure function (Roddier 1981, sec. 4.2).

    Examples:
        >>> turbulence = SensedLight(diameter_m=8.0, wavelength_m=0.65e-6, fried_m=0.5)
        >>> [round(light_outside(turbulence, distance_m=3.5e6, window_m=w), 2) for w in (11.4, 22.8)]
        [0.15, 0.02]
    """
    return window_costs(light, distance_m=distance_m, window_m=window_m)[0]


def wrapping_error(light: SensedLight, *, distance_m: float, window_m: float) -> float:
    """Relative rms error of the intensity when light that leaves a periodic grid re-enters on the other side.

    Returned light of mean intensity w interferes with what is there, i, as one speckle field with another:
    the squared error is 2 i w + 2 w^2, set against the squared intensity, i^2 and as much again for its
    speckles.
    """
    return window_costs(light, distance_m=distance_m, window_m=window_m)[1]


def window_costs(light: SensedLight, *, distance_m: float, window_m: float) -> tuple[float, float]:
    """`light_outside` and `wrapping_error` from one image."""
    image = _mean_image(light, distance_m, window_m)
    middle = image.shape[0] // 2
    here = image[middle, :, middle, :]
    outside = float(1 - here.sum() / image.sum())
    returned = image.sum(axis=(0, 2)) - here
    squared_error = np.sum(2 * here * returned + 2 * returned**2)
    wrong = np.sqrt(squared_error / ((1 + _contrast2(light)) * np.sum(here**2)))
    return outside, float(wrong)


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


def _mean_image(light: SensedLight, distance_m: float, window_m: float) -> np.ndarray:
    """Mean image, cut into copies of the window: `[tile_y, y, tile_x, x]`, the middle tile is the window."""
    reach_m = light.diameter_m + 6 * abs(distance_m) * light.half_angle_rad
    tiles = 2 * max(1, math.ceil((reach_m / window_m - 1) / 2)) + 1
    pixels = 12 * math.ceil(75 / tiles)  # about 900 in all, a good length for an FFT
    grid = Grid((tiles * pixels, tiles * pixels), window_m / pixels)
    pupil = circular_pupil(grid, diameter_m=light.diameter_m)
    frequency2_per_m2 = grid.fy_per_m**2 + grid.fx_per_m**2
    travel = np.exp(-1j * np.pi * light.wavelength_m * distance_m * frequency2_per_m2)
    image = np.abs(np.fft.ifft2(np.fft.fft2(pupil) * travel)) ** 2
    separation_m = light.wavelength_m * abs(distance_m) * np.sqrt(frequency2_per_m2)
    blur = np.exp(-light.structure_rad2(separation_m) / 2)
    image = np.maximum(np.fft.ifft2(np.fft.fft2(image) * blur).real, 0)
    return image.reshape(tiles, pixels, tiles, pixels)


def _contrast2(light: SensedLight) -> float:
    """Squared contrast of the speckles: 1 when developed, 0 for a flat wavefront."""
    return 1.0 if light.fried_m is not None else -math.expm1(-(light.rms_rad**2))
