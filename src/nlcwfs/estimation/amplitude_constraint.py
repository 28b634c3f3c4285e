"""What was measured rules the modulus of the light on a defocused plane."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

LARGEST_FACTOR = 3.0
"""A pixel on which the model has no light cannot ask for more than this in one step."""

FLOOR = 0.1
"""Share of the mean count added to the variance, so that dark pixels do not rule the step."""


def modulus_factor(
    counts: Float[Array, "plane y x"],
    model: Float[Array, "plane y x"],
    usable: Bool[Array, "plane y x"],
    *,
    method: Literal["poisson", "replace"],
    read_variance: float | Float[Array, ""] = 0.0,
) -> Float[Array, "plane y x"]:
    r"""By how much to multiply the model's light on each pixel.

    `replace` gives the measured modulus, :math:`\sqrt{n / \mu}` (Gerchberg & Saxton 1972). At a few photons a pixel
    that is badly biased: no photon does not mean no light. `poisson` gives
    :math:`1 + (n - \mu) / 2 V` with :math:`V = (n + \mu) / 2 + \mathrm{floor} + \mathrm{read\ noise}`, the step of
    the Poisson likelihood; it agrees with the square root to first order where light is plenty, and leaves the
    model alone where noise rules.

    Args:
        counts: Photo-electrons, background subtracted.
        model: The same pixels as the model sees them, in photo-electrons.
        usable: False where a pixel is masked or was not on the detector: the model's light passes.
        method: See above.
        read_variance: Variance of a pixel without light, in electrons squared.

    Examples:
        >>> import jax.numpy as jnp
        >>> counts, model = jnp.full((1, 1, 2), 121.0), jnp.full((1, 1, 2), 100.0)
        >>> usable = jnp.array([[[True, False]]])
        >>> [round(float(f), 2) for f in modulus_factor(counts, model, usable, method="replace")[0, 0]]
        [1.1, 1.0]
    """
    if method == "replace":
        tiny = jnp.finfo(counts.dtype).tiny
        factor = jnp.sqrt(jnp.maximum(counts, 0) / jnp.maximum(model, tiny))
        # Dark speckles of the model would otherwise be multiplied by millions.
        return jnp.where(usable & (model > tiny), factor, 1)
    seen = jnp.where(usable, counts, 0)
    mean = jnp.sum(seen, axis=(1, 2), keepdims=True) / jnp.maximum(
        jnp.sum(usable.astype(counts.dtype), axis=(1, 2), keepdims=True), 1
    )
    variance = (jnp.maximum(counts, 0) + model) / 2 + FLOOR * jnp.maximum(mean, 0) + read_variance
    variance = jnp.maximum(variance, jnp.finfo(counts.dtype).tiny)
    factor = jnp.clip(1 + (counts - model) / (2 * variance), 0, LARGEST_FACTOR)
    return jnp.where(usable, factor, 1)
