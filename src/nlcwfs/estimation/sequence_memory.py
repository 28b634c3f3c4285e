"""What a frame of a sequence tells of the next."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.sensor_model import PlaneScale


class Memory(eqx.Module):
    """What is known when a frame has been seen.

    Attributes:
        phase_rad: Phase on the model's grid without tilt and static aberration.
        slope: Tilt (y, x), metres per metre.
        left_open: Power of the error of the phase.
        tilt_left_rad: Rms error of the tilt along one axis.
        strength: Variance of the turbulence over that of the prior.
        scale: Counts of each plane over those measured, and background.
        surprise_rad2: Roughness of what the last frame showed beyond its prediction, see `wave_sensitivity`.
    """

    phase_rad: Float[Array, "y x"]
    slope: Float[Array, "2"]
    left_open: Float[Array, "y fx"]
    tilt_left_rad: Float[Array, ""]
    strength: Float[Array, ""]
    scale: PlaneScale
    surprise_rad2: Float[Array, " lag"]


def plane_counts(measured: Measurement) -> Float[Array, "plane 1 1"]:
    """Counts of the usable pixels of each plane, above zero."""
    counts = jnp.sum(jnp.where(measured.usable, measured.counts, 0), axis=(1, 2), keepdims=True)
    return jnp.maximum(counts, jnp.finfo(counts.dtype).tiny)
