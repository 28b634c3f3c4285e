"""What a matrix sees of the images: light in coarse bins that follow the tilt, and the moments of every plane."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.image_moments import image_moments
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.sensor_geometry import SensorGeometry

MOMENTS = 5
"""Of every plane: centroid y, x and second central moments yy, yx, xx."""

LEAST_COVERED = 0.5
"""A bin of which less was measured is not known; of more, the rest is taken as bright as what was measured."""

BINS_ACROSS = 16
"""As in the closed loop of Johnson et al.; 11, 15 and 22 bins are as good at D / r0 = 8.2 and 2e4 photons."""


class Features(NamedTuple):
    """What one exposure shows.

    Attributes:
        values: Share of its plane's light in each bin, plane by plane; then the moments, plane by plane.
        known: False for a bin that lies for the most part on pixels that were not measured.
    """

    values: Float[Array, " feature"]
    known: Bool[Array, " feature"]


class BinnedFeatures(eqx.Module):
    """Bins and moments of one sensor's frames.

    Attributes:
        frame: Pixels of one plane's frame.
        distances_m: Signed distance of each plane.
        bin_pixels: Pixels along a side of a bin.

    Examples:
        >>> sensor = BinnedFeatures(Grid((6, 6), 0.5), (-1e6, 1e6), bin_pixels=2)
        >>> counts, usable = jnp.ones((2, 6, 6)), jnp.ones((2, 6, 6), bool)
        >>> seen = sensor.of(counts, usable, slope=jnp.zeros(2))
        >>> seen.values.size == sensor.count, round(float(seen.values[0]), 4)
        (True, 0.1111)
    """

    frame: Grid = eqx.field(static=True)
    distances_m: tuple[float, ...] = eqx.field(static=True)
    bin_pixels: int = eqx.field(static=True)

    @property
    def bins(self) -> tuple[int, int]:
        """Bins along y and x; together they cover the frame."""
        return math.ceil(self.frame.shape[0] / self.bin_pixels), math.ceil(self.frame.shape[1] / self.bin_pixels)

    @property
    def count(self) -> int:
        """Number of features."""
        return len(self.distances_m) * (self.bins[0] * self.bins[1] + MOMENTS)

    def of(
        self, counts: Float[Array, "plane y x"], usable: Bool[Array, "plane y x"], *, slope: Float[Array, "2"]
    ) -> Features:
        """The features of an exposure whose wavefront has about this slope (y, x).

        A tilted wave shifts the image at distance z by slope * z and changes nothing else (the paraxial wave
        equation is Galilean invariant), so bins and centroids count from there, and the features belong to the
        wavefront without that tilt. Light on the edge of a bin is shared as if uniform within its pixel.

        Args:
            counts: Photo-electrons, background subtracted.
            usable: False for pixels to ignore.
            slope: What the bins follow, metres per metre.
        """
        measured = Measurement(counts, usable, jnp.zeros((), counts.dtype))
        light = measured.binned(1).counts
        total = jnp.sum(light, axis=(1, 2), keepdims=True)
        share = jnp.where(total > 0, light / jnp.where(total > 0, total, 1), 0)
        shift_m = jnp.asarray(self.distances_m, counts.dtype)[:, None] * slope[None]
        binned = jax.vmap(self._binned)
        covered = binned(usable.astype(counts.dtype), shift_m) / self.bin_pixels**2
        known = covered >= LEAST_COVERED
        values = binned(share, shift_m) / jnp.where(known, covered, 1)
        centroid_m, second_m2 = image_moments(counts, usable, self.frame)
        moments = jnp.concatenate([centroid_m - shift_m, second_m2], axis=1)
        return Features(
            jnp.concatenate([values.reshape(-1), moments.reshape(-1)]),
            jnp.concatenate([known.reshape(-1), jnp.ones(moments.size, bool)]),
        )

    def noise(
        self, images: Float[np.ndarray, "plane y x"], flux_fractions: Float[np.ndarray, " plane"]
    ) -> Float[np.ndarray, "feature feature"]:
        """Covariance of the features by photon noise for one photon; that of n photons is an n-th of it.

        To first order every feature is a mean over the photons of its plane, each of which falls on a pixel by the
        mean image, independently: the covariance is that of one photon's contribution, over the plane's share.

        Args:
            images: Mean light on the pixels.
            flux_fractions: Share of the light of each plane.
        """
        bins = self.bins[0] * self.bins[1]
        at_rest = [np.asarray(self._overlap(axis, jnp.zeros(())), float) for axis in (0, 1)]
        in_bins = np.kron(*at_rest)
        covered = in_bins.sum(axis=1, keepdims=True) / self.bin_pixels**2
        in_bins = in_bins / np.where(covered >= LEAST_COVERED, covered, 1)
        y_m, x_m = (axis.ravel() for axis in np.broadcast_arrays(self.frame.y_m, self.frame.x_m))
        noise = np.zeros((self.count, self.count))
        for plane, (image, fraction) in enumerate(zip(images, flux_fractions, strict=True)):
            light = np.asarray(image, float).ravel() / np.sum(image, dtype=float)
            y, x = y_m - light @ y_m, x_m - light @ x_m
            photon = np.concatenate([in_bins, np.stack([y, x, y**2, y * x, x**2])])
            mean = photon @ light
            first = len(images) * bins + plane * MOMENTS
            here = np.r_[plane * bins : (plane + 1) * bins, first : first + MOMENTS]
            noise[np.ix_(here, here)] = ((photon * light) @ photon.T - np.outer(mean, mean)) / fraction
        return noise

    def _binned(self, image: Float[Array, "y x"], shift_m: Float[Array, "2"]) -> Float[Array, "by bx"]:
        return self._overlap(0, shift_m[0]) @ image @ self._overlap(1, shift_m[1]).T

    def _overlap(self, axis: int, shift_m: Float[Array, ""]) -> Float[Array, "bin pixel"]:
        """Part of every pixel that lies in every bin, along an axis."""
        pixels, bins = self.frame.shape[axis], self.bins[axis]
        shift = shift_m / self.frame.pixel_m
        pixel = jnp.asarray(np.arange(pixels) - (pixels - 1) / 2, shift.dtype)
        middle = jnp.asarray((np.arange(bins) - (bins - 1) / 2) * self.bin_pixels, shift.dtype) + shift
        apart = jnp.abs(middle[:, None] - pixel[None, :])
        return jnp.clip((self.bin_pixels + 1) / 2 - apart, 0, 1)


def bin_size(geometry: SensorGeometry) -> int:
    """Pixels along a side of a bin, so that about 16 bins cross the telescope.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> bin_size(SensorGeometry(PupilShape(8.0), Grid((64, 64), 8.0 / 45), 0.65e-6, (1e6,)))
        3
    """
    return max(1, round(geometry.pupil.diameter_m / geometry.frame.pixel_m / BINS_ACROSS))
