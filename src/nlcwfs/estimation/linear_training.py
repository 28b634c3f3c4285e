"""Wavefronts of turbulence and the images that they would give: what a linear reconstructor learns from."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Float, Key, PRNGKeyArray

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis
from nlcwfs.beam.pupil import light_weights
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.binned_features import BinnedFeatures
from nlcwfs.estimation.centroid_tilt import centroid_tilt
from nlcwfs.estimation.sensor_geometry import SensorGeometry

LIGHT_WINDOW = 1.5
"""The window of the training light over the frames': what turbulence throws wide does not come back on the frames."""

PIVOT_SPREAD = 0.2
"""Standard deviation, in bins at the farthest plane, by which bins miss the tilt in training.

Photon noise makes them miss it in use; the matrix learns to see by how much.
"""


class Exposure(NamedTuple):
    """One noiseless exposure to learn from.

    Attributes:
        images: Light on the frames' pixels, over that of the whole sensor.
        opd_m: The wavefront's mean over the light of every pixel; zero where there is none.
        variance_ratio: Variance of its turbulence over that of the strongest.
    """

    images: Float[Array, "plane y x"]
    opd_m: Float[Array, "y x"]
    variance_ratio: Float[Array, ""]


class TrainingLight(eqx.Module):
    """Wavefronts of turbulence, and the images that a sensor makes of them.

    The light runs on a grid of its own, finer than the detector's pixels and wider than its window, with turbulence
    down to its cells: a matrix learns what waves beyond its modes and light beyond the window do (no inverse crime).

    Single precision is enough to learn from.

    Attributes:
        optics: The sensor on the grid of the light.
        screens: Draws wavefronts on the part of the grid that holds the pupil.
        weights: Share of the light in every cell.
        weakest: Rms of the weakest turbulence over that of the strongest; in between the logarithm is uniform.
        oversampling: Cells per detector pixel along an axis.
        window: Detector pixels along y and x.
        corner: First lit row and column.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((16, 20), 0.7), 0.65e-6, (-3e6, 3e6))
        >>> light = TrainingLight.build(geometry, Turbulence(1.0), weakest=0.5, oversampling=2)
        >>> exposure = light.expose(jax.random.key(0))
        >>> exposure.images.shape, bool(0.9 < exposure.images.sum() <= 1)
        ((2, 16, 20), True)
    """

    optics: CurvatureSensor
    screens: PhaseScreens
    weights: Float[Array, "Y X"]
    weakest: float = eqx.field(static=True)
    oversampling: int = eqx.field(static=True)
    window: tuple[int, int] = eqx.field(static=True)
    corner: tuple[int, int] = eqx.field(static=True)

    @classmethod
    def build(
        cls, geometry: SensorGeometry, strongest: Turbulence, *, weakest: float, oversampling: int
    ) -> "TrainingLight":
        """Prepare the grid, the optics and the turbulence."""
        grid = _light_grid(geometry.frame, oversampling)
        optics = geometry.model(grid, dtype="float32")
        weights = light_weights(np.asarray(optics.pupil))
        (top, bottom), (left, right) = (np.flatnonzero(weights.any(axis=axis))[[0, -1]] for axis in (1, 0))
        shape = (int(bottom - top) + 1, int(right - left) + 1)
        return cls(
            optics=optics,
            screens=PhaseScreens.build(strongest, shape=shape, pixel_m=grid.pixel_m),
            weights=jnp.asarray(weights, jnp.float32),
            weakest=weakest,
            oversampling=oversampling,
            window=geometry.frame.shape,
            corner=(int(top), int(left)),
        )

    def expose(self, key: PRNGKeyArray) -> Exposure:
        """One wavefront and its images."""
        key_strength, key_screen = jax.random.split(key)
        ratio = self.weakest ** jax.random.uniform(key_strength, (), jnp.float32)
        drawn = ratio * self.screens.draw(key_screen)
        opd_m = jax.lax.dynamic_update_slice(jnp.zeros_like(self.weights), drawn, self.corner)
        opd_m = opd_m - jnp.sum(self.weights * opd_m)
        images = self.on_pixels(self.optics.images(opd_m, 1.0).photons)
        light, weighted_m = self.on_pixels(jnp.stack([self.weights, self.weights * opd_m]))
        mean_m = jnp.where(light > 0, weighted_m / jnp.where(light > 0, light, 1), 0)
        return Exposure(images, mean_m, ratio**2)

    def on_pixels(self, light: Float[Array, "plane Y X"]) -> Float[Array, "plane y x"]:
        """Sums over the pixels of the frames."""
        return integrate_on_pixels(light, factor=self.oversampling, window=self.window)


class TrainingSet(NamedTuple):
    """What a matrix learns from.

    Attributes:
        values: Features; a bin that is not known has the mean of those where it is.
        coefficients_m: Modes of the wavefront less the tilt that the bins followed.
        variance_ratio: See `Exposure`.
        images: Mean light on the pixels, sum 1.
    """

    values: Float[np.ndarray, "screen feature"]
    coefficients_m: Float[np.ndarray, "screen mode"]
    variance_ratio: Float[np.ndarray, " screen"]
    images: Float[np.ndarray, "plane y x"]


def draw_training_set(
    light: TrainingLight,
    features: BinnedFeatures,
    basis: ModalBasis,
    *,
    follow_tilt: bool,
    keys: Key[Array, " screen"],
) -> TrainingSet:
    """Draw wavefronts and look at their images as the reconstructor will.

    Args:
        light: The wavefronts.
        features: What is seen of the images.
        basis: Modes on the frames' pixels.
        follow_tilt: Whether bins follow the centroids.
        keys: A random key for each wavefront.

    Examples:
        >>> from nlcwfs.beam.modes import modal_basis
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> frame = Grid((16, 16), 0.7)
        >>> geometry = SensorGeometry(PupilShape(8.0), frame, 0.65e-6, (-3e6, 3e6))
        >>> light = TrainingLight.build(geometry, Turbulence(1.0), weakest=0.5, oversampling=2)
        >>> basis = modal_basis(geometry.pupil.on(frame), frame, diameter_m=8.0, count=5)
        >>> features = BinnedFeatures(frame, geometry.distances_m, bin_pixels=2)
        >>> keys = jax.random.split(jax.random.key(0), 4)
        >>> training = draw_training_set(light, features, basis, follow_tilt=True, keys=keys)
        >>> training.values.shape, training.coefficients_m.shape
        ((4, 138), (4, 5))
    """
    frame, planes = features.frame, len(features.distances_m)
    usable = jnp.ones((planes, *frame.shape), bool)
    tilts_m = jnp.asarray(tilt_coefficients(basis, frame), jnp.float32)
    farthest_m = max(abs(distance_m) for distance_m in features.distances_m)
    miss = float(PIVOT_SPREAD * features.bin_pixels * frame.pixel_m / farthest_m)

    def look(images: Float[Array, "plane y x"], key: PRNGKeyArray):
        key_light, key_miss = jax.random.split(key)
        exposure = light.expose(key_light)
        slope = jnp.zeros(2, jnp.float32)
        if follow_tilt:
            slope = pivot_slope(exposure.images, features) + miss * jax.random.normal(key_miss, (2,), jnp.float32)
        seen = features.of(exposure.images, usable, slope=slope)
        coefficients_m = basis.project(exposure.opd_m) - slope @ tilts_m
        values = jnp.where(seen.known, seen.values, jnp.nan)
        return images + exposure.images, (values, coefficients_m, exposure.variance_ratio)

    program = jax.jit(lambda keys: jax.lax.scan(look, jnp.zeros(usable.shape, jnp.float32), keys))
    images, (values, coefficients_m, ratio) = program(keys)
    values, images = np.array(values, float), np.asarray(images, float)
    seen = np.maximum(np.sum(np.isfinite(values), axis=0), 1)
    values = np.where(np.isfinite(values), values, np.nansum(values, axis=0) / seen)
    return TrainingSet(values, np.asarray(coefficients_m, float), np.asarray(ratio, float), images / images.sum())


def pivot_slope(counts: Float[Array, "plane y x"], features: BinnedFeatures) -> Float[Array, "2"]:
    """The slope that the bins follow: that of the centroids."""
    everywhere, distances_m = jnp.ones_like(counts), np.array(features.distances_m)
    return centroid_tilt(counts, everywhere, distances_m, pixel_m=features.frame.pixel_m)


def tilt_coefficients(basis: ModalBasis, frame: Grid) -> Float[np.ndarray, "2 mode"]:
    """Coefficients of the modes in planes of unit slope along y and x, metres."""
    planes_m = np.stack([np.broadcast_to(axis, frame.shape) for axis in (frame.y_m, frame.x_m)])
    return np.einsum("ayx,myx->am", planes_m * np.asarray(basis.weights), np.asarray(basis.modes))


def _light_grid(frame: Grid, oversampling: int) -> Grid:
    """Finer than the frame and wider, with its centre, of a size that suits the FFT."""
    shape = []
    for pixels in frame.shape:
        inner = pixels * oversampling
        size = int(np.ceil(LIGHT_WINDOW * inner))
        while (size - inner) % 2 or size != scipy.fft.next_fast_len(size):
            size += 1
        shape.append(size)
    return Grid((shape[0], shape[1]), frame.pixel_m / oversampling)
