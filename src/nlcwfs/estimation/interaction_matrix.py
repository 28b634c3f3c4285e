"""What a signal answers to small wavefronts around a reference: exact derivatives, whatever the optics."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

AT_A_TIME = 4
"""Modes that are pushed through the optics together: more need memory and are not faster on a processor."""


class Linearised(NamedTuple):
    """A signal near a reference wavefront.

    Attributes:
        signal: What the reference shows.
        interaction: What a metre of each mode adds to it.
    """

    signal: Float[np.ndarray, " signal"]
    interaction: Float[np.ndarray, "signal mode"]


def linearised(
    signal: Callable[[Float[Array, "*wavefront"]], Float[Array, " signal"]],
    reference_m: Float[Array, "*wavefront"],
    shapes: Float[np.ndarray, "mode *wavefront"],
) -> Linearised:
    """A signal and its exact derivative along each mode (forward differentiation, no poke).

    Args:
        signal: From a wavefront to what is measured of it on average, made of JAX operations. A mean over random
            wavefronts in it, see `image_structures`, makes the derivative the mean one.
        reference_m: Where; need not be flat.
        shapes: Wavefront of a metre of each mode.

    Examples:
        >>> import jax.numpy as jnp
        >>> wave = jnp.array([0.0, 0.5])
        >>> found = linearised(jnp.sin, wave, np.eye(2, dtype=wave.dtype))
        >>> np.allclose(found.signal, np.sin(wave)), np.allclose(found.interaction, np.diag(np.cos(wave)))
        (True, True)
    """
    found, push = jax.linearize(signal, reference_m)
    answers = jax.jit(lambda waves: jax.lax.map(push, waves, batch_size=AT_A_TIME))
    columns = [np.asarray(answers(part)) for part in np.array_split(shapes, max(1, len(shapes) // 128))]
    return Linearised(np.asarray(found, float), np.concatenate(columns).T)
