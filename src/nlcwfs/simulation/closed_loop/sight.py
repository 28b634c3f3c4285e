"""What a frame shows of the mirror's modes, and how much of it the mirror should take out."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.config import Config
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.exposure import ExposureSimulator

WORTH_FITTING = 0.02
"""Combinations of modes that the pixels show less than this part of the clearest are left alone."""


class Sight(NamedTuple):
    """What was measured in one exposure.

    Attributes:
        residual_m: Of each mode of the mirror.
        outcome: How the reconstruction ended.
        predicted_m: Rms error that it expects of itself.
        ffts: Two-dimensional FFTs of one plane that it took.
        closed: Whether the frame was followed from the one before.
        command_m: The air of the exposure in which the next command acts, in commands; None from a sensor that does
            not look ahead.
        linear: Whether the matrix of the linear regime has made it.
    """

    residual_m: Float[Array, " mode"]
    outcome: Outcome
    predicted_m: float
    ffts: int
    closed: bool
    command_m: Float[Array, " mode"] | None = None
    linear: bool = False


class PixelModes(eqx.Module):
    """From a wavefront on the detector's pixels to commands of the mirror, by least squares over the light."""

    fit: Float[Array, "mode y x"]

    @classmethod
    def build(cls, light: LoopLight) -> "PixelModes":
        """Average the mirror's shapes over pixels, and invert."""
        still, mirror = light.still, light.mirror
        weights = np.nan_to_num(np.asarray(still.pixel_weights(), float))
        lit = weights > 0
        root = np.sqrt(weights[lit])
        shapes = np.asarray(_on_pixels(still, mirror), float)[:, lit]
        tall = (np.nan_to_num(shapes) * root).T
        left, size, right = np.linalg.svd(tall - root[:, None] * (root @ tall)[None], full_matrices=False)
        kept = size > WORTH_FITTING * size[0]
        fit = np.zeros((mirror.count, *weights.shape))
        fit[:, lit] = (right[kept].T / size[kept]) @ left[:, kept].T * root
        return cls(jnp.asarray(fit, str(still.weights.dtype)))

    def __call__(self, opd_m: Float[Array, "y x"]) -> Float[Array, " mode"]:
        """The command that comes closest to a wavefront."""
        return jnp.tensordot(self.fit, jnp.nan_to_num(opd_m).astype(self.fit.dtype), axes=2)


@eqx.filter_jit
def _on_pixels(still: ExposureSimulator, mirror: Mirror) -> Float[Array, "mode y x"]:
    """The mirror's shapes as the detector's pixels see them, a few at a time."""

    def seen(values: Float[Array, " lit"]) -> Float[Array, "y x"]:
        shape = jnp.zeros(mirror.shape, values.dtype).at[mirror.rows, mirror.columns].set(values)
        return still.on_pixels(still.on_light(shape))

    return jax.lax.map(seen, mirror.shapes, batch_size=8)


class Cautious(eqx.Module):
    """Less of a wavefront that is not believed: its fine waves may be islands that are a turn off.

    Attributes:
        kept: Share of each mode.
    """

    kept: Float[Array, " mode"]

    @classmethod
    def build(cls, config: Config, cycles_per_aperture: Float[np.ndarray, " mode"]) -> "Cautious":
        """Shares that fall from the capture gain to nothing beyond the capture cutoff."""
        kept = config.loop.capture_gain * np.exp(-((np.asarray(cycles_per_aperture) / config.loop.capture_cpa) ** 4))
        return cls(jnp.asarray(kept, jnp.float32))

    def part(self, residual_m: Float[Array, " mode"], outcome: Outcome) -> Float[Array, " mode"]:
        """What the mirror should take out."""
        if outcome in (Outcome.NO_LIGHT, Outcome.NOT_FINITE):
            return jnp.zeros_like(residual_m)
        return residual_m if outcome.succeeded else residual_m * self.kept.astype(residual_m.dtype)
