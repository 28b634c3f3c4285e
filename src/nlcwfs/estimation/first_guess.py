"""What a first guess tells of the turbulence, and how the guess on a pupil made of segments is unwrapped.

On segments the field is what flows together across gaps, where a smooth phase cannot; its phase is wrapped.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nlcwfs.estimation.bayesian_unwrapping import unwrapped, unwrapping_ffts
from nlcwfs.estimation.gerchberg_saxton import phase_noise
from nlcwfs.estimation.reconstructor import SENSOR_LOSS, Climb, GerchbergSaxton
from nlcwfs.estimation.resolution_level import LIT, Level, Measurement
from nlcwfs.estimation.turbulence_strength import slope_weights, updated_strength
from nlcwfs.estimation.whitened_phase import WhitenedPhase

SHOWN = 0.87
"""Share of the strength that the slopes of a first guess show: 0.78 to 0.91 for D / r0 of 8 to 25 and 2e3 to 2e6
photons, with a scatter of 0.12 to 0.18."""

LOOKS = 8
"""Updates of the strength; each may change it by half."""


def with_strength(capture: GerchbergSaxton, near: Measurement, climb: Climb) -> Climb:
    """With the strength that the first guess shows: the coarse levels on the way could not see its fine waves.

    Args:
        capture: What found the first guess.
        near: The counts.
        climb: The first guess.
    """
    level, strength = capture.levels[-1], climb.strength
    if not capture.measures_strength:
        return climb
    weights = jnp.asarray(slope_weights(level.grid), strength.dtype)
    noise = SENSOR_LOSS * phase_noise(level, near)
    for _ in range(2):
        strength = updated_strength(strength, climb.phase_rad, level.light, level.power[0], weights, noise)
    return eqx.tree_at(lambda c: c.strength, climb, strength / SHOWN)


def segmented_start(
    level: Level,
    prior: WhitenedPhase,
    climb: Climb,
    wrapped_rad: Float[Array, "y x"],
    noise_rad2: Float[Array, ""],
    *,
    learns: bool,
) -> Climb:
    """The first guess with the phase of its field unwrapped, and with the strength of the turbulence that it shows.

    Each segment is unwrapped for itself, because no light joins their rims. Slopes tell the strength of the
    turbulence, with the pistons of the segments taken out.

    Args:
        level: The sensor on the grid of the model.
        prior: What is expected, with the steps of the segments.
        climb: What led to the field.
        wrapped_rad: Phase of the field on the model's grid, the starting tilt taken out.
        noise_rad2: Variance of its noise in each cell.
        learns: Whether the strength is measured.

    Raises:
        ValueError: If the prior knows no segments.
    """
    if prior.steps is None:
        raise ValueError("prior.steps: must be there, got None")
    whole_rad = unwrapped(wrapped_rad, level.light > LIT, prior)
    smooth_rad = whole_rad - prior.steps.means(whole_rad)
    weights = jnp.asarray(slope_weights(level.grid), whole_rad.dtype)
    stronger = jnp.ones_like(noise_rad2)
    for _ in range(LOOKS if learns else 0):
        stronger = updated_strength(stronger, smooth_rad, level.light, prior.amplitude**2, weights, noise_rad2)
    ffts = climb.ffts + unwrapping_ffts()
    return Climb(whole_rad, climb.strength * stronger, climb.iterations, ffts, climb.change_rad)
