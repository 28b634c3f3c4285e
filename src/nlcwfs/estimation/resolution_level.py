"""One resolution of the coarse-to-fine ladder: the sensor on a grid, and the counts on it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.estimation.speckle_blur import blurred

LIT = 0.3
"""Cells with at least this share of the light of a full one have a phase of their own."""


class Measurement(eqx.Module):
    """The counts of one exposure, and which of them to use.

    Attributes:
        counts: Photo-electrons, background subtracted.
        usable: False where masked, saturated, or beyond the detector's window.
        read_variance: Variance of a pixel without light, electrons squared.
        expected: The counts smoothed, for the variance of the noise: a pixel's own count is a poor guess of its mean,
            and one that errs with the count biases the step. None where the counts are smooth already.
    """

    counts: Float[Array, "plane y x"]
    usable: Bool[Array, "plane y x"]
    read_variance: Float[Array, ""]
    expected: Float[Array, "plane y x"] | None = None

    def padded(self, shape: tuple[int, int]) -> "Measurement":
        """The same counts in a wider window, whose rim was not measured."""
        margins = [(0, 0)] + [
            ((outer - inner) // 2, (outer - inner) // 2)
            for outer, inner in zip(shape, self.counts.shape[1:], strict=True)
        ]
        return Measurement(jnp.pad(self.counts, margins), jnp.pad(self.usable, margins), self.read_variance)

    def binned(self, factor: int) -> "Measurement":
        """Counts summed over squares of pixels; a masked pixel counts as the mean of its usable neighbours."""
        known = self.usable.astype(self.counts.dtype)
        around = _sum_of_neighbours(self.counts * known)
        number = _sum_of_neighbours(known)
        filled = jnp.where(self.usable, self.counts, around / jnp.maximum(number, 1))
        return Measurement(
            sum_blocks(filled, factor),
            sum_blocks(known, factor) > factor**2 / 2,
            self.read_variance * factor**2,
        )

    def smoothed(self, factor: Float[Array, "y fx"], *, keep_counts: bool) -> "Measurement":
        """Counts with each wave multiplied by a factor, as the data or, beside them, for their noise alone."""
        smooth = blurred(self.counts, jnp.broadcast_to(factor, (self.counts.shape[0], *factor.shape)))
        if keep_counts:
            return Measurement(self.counts, self.usable, self.read_variance, jnp.maximum(smooth, 0))
        return Measurement(smooth, self.usable, self.read_variance)


class Level(eqx.Module):
    """The sensor at one resolution, with what its iterations need.

    Attributes:
        optics: The sensor on the grid of the model.
        modulus: Of light of unit power at the pupil.
        light: Light of each pixel over that of a fully lit one.
        weight: Share of the light in each pixel, sum 1.
        power: Expected power of the phase, one filter for each cutoff.
        structures: For each cutoff, plane and wave of the images, the structure function of the phase beyond the
            cutoff (rad^2, see `speckle_blur`); None where everything is modelled.
        beyond: For each cutoff, variance of the phase beyond it, rad^2.
        smoothing: Fourier factor that smooths images.
        doubt: Relative variance of the model's intensity, see `modulus_factor`.
        grid: Cells of the model.
        binning: Detector pixels per measured pixel of this level, along an axis.
        oversampling: Cells of the model per measured pixel of this level, along an axis.
        iterations: Most iterations for each cutoff.
        gain: Length of a step.
        fast_forward: Share of the last step that is added ahead of the next one.
        tolerance_rad: An iteration that moves less ends the level.
        colours: The sensor in all colours of a model of many, each once for every moment of a membrane that it follows;
            None where `optics`, of one colour at rest, is the model.
        moving: The same of one colour; None where the planes rest.
    """

    optics: CurvatureSensor
    modulus: Float[Array, "y x"]
    light: Float[Array, "y x"]
    weight: Float[Array, "y x"]
    power: Float[Array, "cutoff y fx"]
    structures: Float[Array, "cutoff plane v fu"] | None
    beyond: Float[Array, " cutoff"]
    smoothing: Float[Array, "v fu"]
    grid: Grid = eqx.field(static=True)
    binning: int = eqx.field(static=True)
    oversampling: int = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    gain: float = eqx.field(static=True)
    fast_forward: float = eqx.field(static=True)
    doubt: float = eqx.field(static=True)
    tolerance_rad: float = eqx.field(static=True)
    colours: CurvatureSensor | None = None
    moving: CurvatureSensor | None = None

    @property
    def measured_shape(self) -> tuple[int, int]:
        """Measured pixels along y and x, the unmeasured rim included."""
        return self.grid.shape[0] // self.oversampling, self.grid.shape[1] // self.oversampling

    @property
    def colour_count(self) -> int:
        """Wavelengths of the model, each once for every moment of a membrane."""
        return 1 if self.colours is None else len(self.colours.spectrum.wavelengths_m)

    @property
    def moment_count(self) -> int:
        """Moments by which the model follows a membrane."""
        return 1 if self.moving is None else len(self.moving.spectrum.shares)

    @property
    def has_band(self) -> bool:
        """Whether the model's light has several wavelengths."""
        return self.colours is not None and len(set(self.colours.spectrum.wavelengths_m)) > 1

    def twinkling(self, log_amplitude: Float[Array, "y x"]) -> "Level":
        """The sensor with an amplitude at the pupil that varies; the light has unit power as before."""
        factor, colours = jnp.exp(log_amplitude), self.colours
        modulus = self.modulus * factor
        if colours is not None:  # one amplitude for all: to first order it does not depend on the wavelength
            colours = dataclasses.replace(colours, pupil=colours.pupil * factor)
        return dataclasses.replace(self, modulus=modulus / jnp.sqrt(jnp.sum(modulus**2)), colours=colours)

    def on_pixels(self, photons: Float[Array, "plane y x"]) -> Float[Array, "plane v u"]:
        """What the measured pixels see of light on the model's grid."""
        return sum_blocks(photons, self.oversampling)

    def on_cells(self, factor: Float[Array, "plane v u"]) -> Float[Array, "plane y x"]:
        """A factor per measured pixel, on the model's grid."""
        for axis in (1, 2) if self.oversampling > 1 else ():
            factor = jnp.repeat(factor, self.oversampling, axis=axis)
        return factor


def sum_blocks(array: Float[Array, "plane y x"], factor: int) -> Float[Array, "plane v u"]:
    """Sum over squares of `factor` x `factor` pixels."""
    if factor == 1:
        return array
    # Ten times faster than a sum over axes of `factor` pixels, which JAX walks through one by one.
    rows = jnp.asarray(sum(array[:, first::factor] for first in range(factor)))
    return jnp.asarray(sum(rows[:, :, first::factor] for first in range(factor)))


def pixel_means(array: Float[Array, "y x"], factor: int, shape: tuple[int, int]) -> Float[Array, "v u"]:
    """Mean over squares of `factor` x `factor` cells, of the middle of an array."""
    return cropped(sum_blocks(array[None], factor)[0] / factor**2, shape)


def continued(level: Level, phase_rad: Float[Array, "y x"], near: Measurement) -> Float[Array, "v u"]:
    """A phase on the window of the frames, on the grid of a level: beyond the frames it goes on as it ends."""
    if phase_rad.shape == level.grid.shape:
        return phase_rad
    fine = [size * level.oversampling for size in near.counts.shape[1:]]
    phase_rad = jax.image.resize(phase_rad, fine, method="cubic").astype(phase_rad.dtype)
    margins = [((a - b) // 2, (a - b) // 2) for a, b in zip(level.grid.shape, fine, strict=True)]
    return jnp.pad(phase_rad, margins, mode="edge")


def cropped(array: Float[Array, "y x"], shape: tuple[int, int]) -> Float[Array, "v u"]:
    """The middle of an array."""
    rows, columns = ((outer - inner) // 2 for outer, inner in zip(array.shape, shape, strict=True))
    return array[rows : rows + shape[0], columns : columns + shape[1]]


def resample_phase(phase_rad: Float[Array, "y x"], shape: tuple[int, int], *, wrapped: bool) -> Float[Array, "v u"]:
    """The same phase over the same window, on another number of pixels.

    Args:
        phase_rad: The phase.
        shape: Pixels wanted.
        wrapped: Whether the phase may jump by whole turns; then its unit phasor is resampled.
    """
    if phase_rad.shape == shape:
        return phase_rad
    if not wrapped:
        return jax.image.resize(phase_rad, shape, method="cubic").astype(phase_rad.dtype)
    cosine = jax.image.resize(jnp.cos(phase_rad), shape, method="linear")
    sine = jax.image.resize(jnp.sin(phase_rad), shape, method="linear")
    return jnp.arctan2(sine, cosine).astype(phase_rad.dtype)


def _sum_of_neighbours(array: Float[Array, "plane y x"]) -> Float[Array, "plane y x"]:
    rows = sum(jnp.roll(array, shift, axis=1) for shift in (-1, 0, 1))
    return sum((jnp.roll(rows, shift, axis=2) for shift in (-1, 0, 1)), jnp.zeros_like(array))
