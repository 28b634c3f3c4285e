"""What was measured rules the modulus of the light on a defocused plane."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

LARGEST_FACTOR = 3.0
"""A pixel on which the model has no light cannot ask for more than this in one step."""

DARK_SHARE = 0.2
"""Share of the mean count that counts as model light where the model is dark."""

FLOOR = 0.3
"""Share of the mean count added to the variance, so that dark pixels do not rule the step."""


def modulus_factor(
    counts: Float[Array, "plane y x"],
    model: Float[Array, "plane y x"],
    usable: Bool[Array, "plane y x"],
    *,
    method: Literal["poisson", "replace"],
    read_variance: float | Float[Array, ""] = 0.0,
    doubt: float = 0.0,
    mean: Float[Array, "plane 1 1"] | None = None,
    expected: Float[Array, "plane y x"] | None = None,
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
        doubt: Relative variance of the model itself, while its phase is still coarse: bright speckles then
            weigh no more than faint ones. The step keeps its mean length, see `doubt_factor`.
        mean: `mean_count`, when it is known already.
        expected: Counts smoothed over a speckle; they stand for n in V. At a photon a pixel, V from the count itself
            errs with the count and biases the step: 44 nm instead of 53 at 2e3 photons (study 01).

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
        return jnp.where(usable & (model > tiny), factor, 1)
    mean = mean_count(counts, usable) if mean is None else mean
    expected = jnp.maximum(counts, 0) if expected is None else expected
    variance = (expected + model) / 2 + FLOOR * mean + read_variance
    variance = variance + doubt * (model + DARK_SHARE * mean) ** 2
    # A dark plane has no variance at all, and nothing to say.
    variance = jnp.maximum(variance, jnp.finfo(counts.dtype).tiny)
    step = doubt_factor(mean, doubt) * (counts - model) / (2 * variance)
    return jnp.where(usable, jnp.clip(1 + step, 0, LARGEST_FACTOR), 1)


def mean_count(counts: Float[Array, "plane y x"], usable: Bool[Array, "plane y x"]) -> Float[Array, "plane 1 1"]:
    """Mean of the usable pixels of each plane; tiny instead of nothing, because it divides."""
    total = jnp.sum(jnp.where(usable, counts, 0), axis=(1, 2), keepdims=True)
    number = jnp.sum(usable.astype(counts.dtype), axis=(1, 2), keepdims=True)
    return jnp.maximum(total / jnp.maximum(number, 1), jnp.finfo(counts.dtype).tiny)


def doubt_factor(mean: Float[Array, "plane 1 1"], doubt: float) -> Float[Array, "plane 1 1"]:
    """By how much doubt lengthens the variance of a pixel of mean light, hence the step and the phase noise."""
    return 1 + doubt * (1 + DARK_SHARE) ** 2 * mean
