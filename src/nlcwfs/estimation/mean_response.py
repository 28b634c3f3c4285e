"""What a non-linear sensor shows in the mean amid random wavefronts, and how that changes with a mode."""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

Light = Callable[[Float[Array, "y x"], Int[Array, ""]], Float[Array, "image v u"]]
"""From a wavefront in metres to the light on the pixels; the number chooses among several ways, such as the points of
a modulation, whose mean is the sensor."""

AT_ONCE = 16
"""Modes that are pushed through the optics at a time."""


def mean_derivative(
    light: Light, maps: Float[Array, "mode y x"], wavefronts_m: Iterable[tuple[Float[Array, "y x"], int]]
) -> Float[np.ndarray, "pixel mode"]:
    """Exact derivative of the light with respect to every mode, mean over wavefronts.

    For Gaussian wavefronts it is the response that a linear estimator wants: the covariance of modes and light is that
    of the modes times this derivative (Stein 1981, Ann. Stat. 9, 1135), however bent the response is. What
    adaptive optics calls optical gain is in it.

    Args:
        light: The sensor.
        maps: Wavefront in metres for a metre of each mode.
        wavefronts_m: Wavefronts, each with the way of the light that is taken.

    Examples:
        A sensor that squares, amid wavefronts of 1 and 2 m: the derivative is twice their mean.

        >>> maps, number = jnp.ones((1, 1, 1)), 0
        >>> amid = [(jnp.full((1, 1), 1.0), number), (jnp.full((1, 1), 2.0), number)]
        >>> mean_derivative(lambda opd_m, _: opd_m[None] ** 2, maps, amid).tolist()
        [[3.0]]
    """
    total, count = np.zeros(0), 0
    for opd_m, number in wavefronts_m:
        seen = np.asarray(_pushed(light, opd_m, jnp.asarray(number), maps), float)
        total, count = (seen if count == 0 else total + seen), count + 1
    return total.reshape(len(total), -1).T / count


@eqx.filter_jit
def _pushed(light: Light, opd_m: Array, number: Array, maps: Array) -> Float[Array, "mode image v u"]:
    _, push = jax.linearize(lambda one_m: light(one_m, number), opd_m)
    return jax.lax.map(push, maps, batch_size=min(AT_ONCE, len(maps)))
