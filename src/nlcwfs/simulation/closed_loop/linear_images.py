"""Matrices for the images of a loop, open and closed: what its air, its photons and its reference make of them."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.image_matrix import MARGIN, Residuals, image_matrix
from nlcwfs.estimation.image_signals import NormalisedCounts, NormalisedDifferences
from nlcwfs.estimation.interaction_matrix import linearised
from nlcwfs.estimation.loop_reconstructor import LoopModes
from nlcwfs.estimation.turbulence_filter import half_plane_frequencies
from nlcwfs.estimation.wave_sensitivity import SPECKLED_LOSS
from nlcwfs.simulation.closed_loop.handover import HandedOver, MatrixLook, OpenMatrix
from nlcwfs.simulation.closed_loop.image_light import ImageLight
from nlcwfs.simulation.closed_loop.light import LoopLight, with_planes_of_sensor
from nlcwfs.simulation.closed_loop.loop_waves import LoopWaves, loop_waves
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature
from nlcwfs.simulation.exposure import distances_m, wavelength_m

LAGGING = 2.0
"""Variance that a loop leaves of a mode, over what the air moves in one exposure; noise is added to it."""

FINER_DRAW = 59
"""Seed of the air that is finer than all waves that are told apart."""


class LinearImages(eqx.Module):
    """Makes matrices for one loop; the waves and the sharp light are shared.

    Attributes:
        config: The settings.
        light: Mirror and optics.
        waves: Modes of the mirror and beyond, without their shapes ...
        sharp: The model of the sensor.
        shapes: ... which are here, in the precision of the light.
    """

    config: Config = eqx.field(static=True)
    light: LoopLight
    waves: LoopWaves
    sharp: ImageLight
    shapes: Float[Array, "mode lit"]

    @classmethod
    def build(cls, config: Config, light: LoopLight) -> "LinearImages":
        """The waves of a loop, and the model of its sensor.

        Raises:
            SettingsError: If settings contradict each other.
        """
        waves = loop_waves(config, light)
        return cls(
            config=config,
            light=light,
            waves=waves._replace(shapes=np.zeros((0, 0))),
            sharp=ImageLight.build(config, light),
            shapes=jnp.asarray(waves.shapes, light.weights.dtype),
        )

    @property
    def electrons(self) -> float:
        """Of an exposure."""
        return self.light.still.photons * self.config.detector.quantum_efficiency

    @property
    def open_m2(self) -> Float[np.ndarray, " driven"]:
        """Variance of the driven modes in the air."""
        return self.waves.open_m2[: self.waves.driven]

    @property
    def closed_m2(self) -> Float[np.ndarray, " driven"]:
        """About what a loop leaves of them."""
        radian_m = wavelength_m(self.config) / (2 * math.pi)
        noise_m2 = SPECKLED_LOSS / (4 * self.electrons) * radian_m**2
        return np.minimum(self.open_m2, LAGGING * self.waves.moved_m2 + noise_m2)

    def left_by(self, before: MatrixLook) -> Float[np.ndarray, " driven"]:
        """What an exposure finds after the command of a matrix."""
        return np.minimum(self.open_m2, np.asarray(before.matrix.error_m2) + self.waves.moved_m2)

    @eqx.filter_jit
    def _exposed(self, start_m: Array, modes_m: Array, finer_m: Array) -> Float[Array, "plane v u"]:
        return self.electrons * self.sharp(start_m + modes_m @ self.shapes + finer_m)

    def finer_m(self, seed: int) -> Float[np.ndarray, " lit"]:
        """Air that is finer than all waves, on the lit cells."""
        grid, still = self.light.part, self.light.still
        frequency = half_plane_frequencies(grid)
        finest = float(np.max(self.waves.cycles)) / still.shape.diameter_m
        power = np.where(frequency > finest, still.air.opd_spectrum(np.maximum(frequency, finest)), 0)
        white = np.random.default_rng((FINER_DRAW, seed)).standard_normal(grid.shape)
        drawn = np.fft.irfft2(np.fft.rfft2(white) * np.sqrt(power) / grid.pixel_m, s=grid.shape)
        return drawn[np.asarray(self.light.weights) > 0]

    def matrix(
        self, reference_m: Float[np.ndarray, " lit"], driven_m2: Float[np.ndarray, " driven"], *, closed: bool
    ) -> MatrixLook:
        """The matrix around a reference wavefront.

        Args:
            reference_m: On the lit cells.
            driven_m2: Variance of the driven modes of the residuals for which it is made.
            closed: Whether their prior is what the loop settles to, or this.
        """
        light, waves = self.light, self.waves
        blurred = self.sharp.amid(self.config, light, waves, driven_m2)
        start = jnp.asarray(reference_m, self.shapes.dtype)
        read_variance = light.still.detector.variance_without_light
        mean = self.electrons * blurred(start)
        if self.config.loop.sensor == "linear-curvature":
            signal = NormalisedDifferences.of_light(mean, distances_m(self.config), read_variance=read_variance)
        else:
            signal = NormalisedCounts.of_light(mean)
        usable = jnp.ones(mean.shape, bool)
        linear = linearised(lambda m: signal.of(self.electrons * blurred(m), usable), start, np.asarray(self.shapes))

        def images(modes_m: np.ndarray, seed: int) -> np.ndarray:
            finer_m = jnp.asarray(self.finer_m(seed), start.dtype)
            return np.asarray(self._exposed(start, jnp.asarray(modes_m, start.dtype), finer_m), float)

        left = Residuals(images, read_variance, str(start.dtype))
        prior_m2 = waves.open_m2 if closed else np.concatenate([driven_m2, waves.open_m2[waves.driven :]])
        known = LoopModes(linear.interaction, prior_m2, waves.moved_m2)
        made = image_matrix(signal, linear, known, left, closed=closed)
        to_command = waves.drive.commands(np.eye(waves.driven))
        lit = np.asarray(light.weights) > 0
        whole_m = np.zeros(lit.shape)
        whole_m[lit] = reference_m
        return MatrixLook(made, jnp.asarray(to_command, self.shapes.dtype), light.mirror.fitted(whole_m))


def handed_over(config: Config, light: LoopLight) -> HandedOver:
    """A loop in the linear regime, with what captures it.

    Raises:
        SettingsError: If settings contradict each other.
    """
    config = with_planes_of_sensor(config)
    loop, told_m = config.loop, np.asarray(light.reference_m, float)[np.asarray(light.weights) > 0]
    if loop.sensor == "linear-curvature":
        images = LinearImages.build(config, light)
        closed = within_range(images, told_m)
        first = images.matrix(told_m, images.open_m2, closed=False)
        second = images.matrix(told_m, images.left_by(first), closed=False)
        return HandedOver(OpenMatrix((first, second)), closed)
    if loop.sensor != "curvature" or config.estimation.method != "map" or not loop.follow:
        rule = "needs loop.sensor = curvature with estimation.method = map and loop.follow"
        raise SettingsError("loop.handover", rule, "true")
    if config.feedback.controller == "kalman":
        raise SettingsError("loop.handover", "must be false with feedback.controller = kalman", "true")
    if config.curvature_sensor.membrane == "sine":  # the matrix is that of planes at rest
        raise SettingsError("loop.handover", 'must be false with curvature_sensor.membrane = "sine"', "true")
    return HandedOver(FollowedCurvature.build(config, light), within_range(LinearImages.build(config, light), told_m))


def within_range(images: LinearImages, reference_m: Float[np.ndarray, " lit"]) -> MatrixLook:
    """The matrix of a closed loop around a reference that bears it.

    Raises:
        SettingsError: If around the reference the linear range is smaller than what the loop leaves.
    """
    made = images.matrix(reference_m, images.closed_m2, closed=True)
    reach = made.matrix.range
    if np.any(reference_m) and not reach.serves:
        left_nm, limit_nm = 1e9 * MARGIN * reach.rms_m[0], 1e9 * reach.limit_m
        rule = f"must have a linear range of {left_nm:.0f} nm ({MARGIN:g} times what is left); it has {limit_nm:.0f} nm"
        weights = np.asarray(images.light.weights, float)[np.asarray(images.light.weights) > 0]
        rms_nm = 1e9 * math.sqrt(np.sum(weights * reference_m**2))
        raise SettingsError("loop.reference_nm", rule, f"{rms_nm:.0f} nm rms")
    return made
