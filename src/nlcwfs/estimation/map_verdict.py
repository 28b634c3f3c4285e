"""Is a maximum a posteriori wavefront believed?"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nlcwfs.estimation.map_solution import Search
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.resolution_level import Measurement

UNEXPLAINED = 0.25
"""Share of the speckles' variance that may stay unexplained even where two solutions agree."""


def map_verdict(
    found: Search, *, unexplained: Float[Array, ""], measured: Measurement, finite: Array
) -> Int[Array, ""]:
    """The outcome, as a number of `Outcome`: believed when two ways lead to it and it explains the speckles.

    Args:
        found: The solutions.
        unexplained: See `unexplained_share`.
        measured: The counts.
        finite: Whether the wavefront is.
    """
    counts = jnp.sum(jnp.where(measured.usable, measured.counts, 0), axis=(1, 2))
    code = jnp.where(found.best.rests, Outcome.CONVERGED, Outcome.BUDGET_SPENT)
    lost = (unexplained > UNEXPLAINED) | (~found.agreed & (found.healings > 0))
    code = jnp.where(lost, Outcome.NOT_EXPLAINED, code)
    code = jnp.where(jnp.any(counts <= 0), Outcome.NO_LIGHT, code)
    return jnp.where(finite, code, Outcome.NOT_FINITE).astype(jnp.int32)
