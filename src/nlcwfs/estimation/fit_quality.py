"""Does the wavefront explain the images? The test that tells a wrong solution."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.resolution_level import Measurement

BLOCK = 4
"""Residuals are summed over 4 x 4 pixels: enough counts to judge, small enough for a speckle."""

MODEL_ERROR = 0.15
"""Relative error that the model itself may make on such a block (coarse pixels, light beyond the window)."""

BELIEVED = 2.0
"""Misfit above which a wavefront is not believed (study 01 states the rates of false alarms and misses)."""


def fit_quality(measurement: Measurement, model: Float[Array, "plane y x"]) -> Float[Array, ""]:
    """Mean squared residual over its expected variance, on blocks of pixels.

    Args:
        measurement: Counts.
        model: What the wavefront predicts, photo-electrons on the same pixels.

    Returns:
        About 1 when noise alone separates model and counts; about half the counts per block for a wrong phase.
    """
    known = measurement.usable
    counts = _blocks(jnp.where(known, measurement.counts, 0))
    expected = _blocks(jnp.where(known, model, 0))
    number = _blocks(known.astype(counts.dtype))
    variance = expected + number * measurement.read_variance + (MODEL_ERROR * expected) ** 2
    floor = jnp.maximum(0.05 * jnp.mean(counts), jnp.finfo(counts.dtype).tiny)
    seen = number > 0
    return jnp.sum(jnp.where(seen, (counts - expected) ** 2 / (variance + floor), 0)) / jnp.maximum(
        jnp.sum(seen.astype(counts.dtype)), 1
    )


def verdict(
    *,
    misfit: Float[Array, ""],
    plane_counts: Float[Array, " plane"],
    rests: Array,
    finite: Array,
) -> Int[Array, ""]:
    """The outcome of a reconstruction, as a number of `Outcome`."""
    code = jnp.where(rests, Outcome.CONVERGED, Outcome.BUDGET_SPENT)
    code = jnp.where(misfit > BELIEVED, Outcome.NOT_EXPLAINED, code)
    code = jnp.where(jnp.any(plane_counts <= 0), Outcome.NO_LIGHT, code)
    return jnp.where(finite, code, Outcome.NOT_FINITE).astype(jnp.int32)


def _blocks(array: Float[Array, "plane y x"]) -> Float[Array, "plane v u"]:
    planes, rows, columns = array.shape
    array = jnp.pad(array, ((0, 0), (0, -rows % BLOCK), (0, -columns % BLOCK)))
    return array.reshape(planes, -(-rows // BLOCK), BLOCK, -(-columns // BLOCK), BLOCK).sum(axis=(2, 4))
