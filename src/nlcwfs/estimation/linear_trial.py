"""How much of a linear estimate's error its Gerchberg-Saxton updates leave: tried on simulated exposures."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from nlcwfs.estimation.linear_training import TrainingLight
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate

DECADES = np.geomspace(1e2, 1e7, 6)
"""Photons of the exposures that are tried."""

CLASSES = 8
"""Exposures are sorted by the linear estimate's expected error into so many classes."""


class Trial(eqx.Module):
    """What updates made of linear estimates.

    Attributes:
        linear_m2: Expected square of the linear estimate's error, mean of each class.
        left: Share of it that is left after the updates.
    """

    linear_m2: Float[Array, "photons class"]
    left: Float[Array, "photons class"]

    def after(self, linear_m2: Float[Array, ""], photons: Float[Array, ""]) -> Float[Array, ""]:
        """Expected square of the error after the updates.

        Args:
            linear_m2: That before.
            photons: Photons of the exposure.
        """
        left = jax.vmap(lambda before, after: jnp.interp(linear_m2, before, after))(self.linear_m2, self.left)
        decades = jnp.asarray(np.log(DECADES), left.dtype)
        return linear_m2 * jnp.interp(jnp.log(jnp.maximum(photons, 1)), decades, left)


def try_updates(
    estimate: Callable[..., WavefrontEstimate],
    light: TrainingLight,
    keys: Key[Array, " exposure"],
    *,
    beyond_m2: float,
) -> Trial:
    """Reconstruct wavefronts that are known, from photons drawn by chance.

    Args:
        estimate: Counts and usable pixels to an estimate with updates, whose `predicted_error_m` is that before them.
        light: The wavefronts.
        keys: A random key for each exposure; each serves all numbers of photons.
        beyond_m2: Variance of the strongest wavefronts between the pixels.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.estimation.sensor_geometry import SensorGeometry
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((16, 16), 0.7), 0.65e-6, (-3e6, 3e6))
        >>> light = TrainingLight.build(geometry, Turbulence(5.0), weakest=1.0, oversampling=2)
        >>> one, flat = jnp.asarray(1), jnp.zeros((16, 16))
        >>> def blind(counts, usable):  # sees nothing, and expects an error of 100 nm
        ...     return WavefrontEstimate(flat, jnp.asarray(1e-7), flat[0, 0], counts, one, one, one, flat[0, 0])
        >>> trial = try_updates(blind, light, jax.random.split(jax.random.key(0), 4), beyond_m2=0.0)
        >>> trial.left.shape
        (6, 4)
    """
    usable = jnp.ones((light.optics.transfer.shape[1], *light.window), bool)
    share = light.on_pixels(light.weights[None])[0]

    def attempt(photons: Float[Array, ""], key: Key[Array, ""]) -> tuple[Array, Array]:
        key_light, key_photons = jax.random.split(key)
        exposure = light.expose(key_light)
        counts = jax.random.poisson(key_photons, exposure.images * photons).astype(jnp.float32)
        found = estimate(counts, usable)
        missed_m = found.opd_m.astype(jnp.float32) - exposure.opd_m
        missed_m = missed_m - jnp.sum(share * missed_m)
        return found.predicted_error_m**2, jnp.sum(share * missed_m**2) + beyond_m2 * exposure.variance_ratio

    @jax.jit
    def all_with(photons: Float[Array, ""]) -> tuple[Array, Array]:
        return jax.lax.map(lambda key: attempt(photons, key), keys)

    linear_m2, left = [], []
    for photons in DECADES:
        before_m2, after_m2 = (np.asarray(one, float) for one in all_with(jnp.asarray(photons, jnp.float32)))
        classes = np.array_split(np.argsort(before_m2), min(CLASSES, before_m2.size))
        linear_m2.append([before_m2[members].mean() for members in classes])
        left.append([after_m2[members].mean() / before_m2[members].mean() for members in classes])
    return Trial(jnp.asarray(linear_m2, jnp.float32), jnp.asarray(left, jnp.float32))
