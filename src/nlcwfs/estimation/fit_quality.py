"""Does the wavefront explain the images? The test that tells a wrong solution."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.speckle_blur import blurred, smoothing_factor

FINEST = 0.022
"""Speckles are judged from this width on, over the telescope's diameter: finer ones drown in photon noise."""

WIDEST = 3 * FINEST
"""... up to this width: wider light is the pupil's own shape, which any wavefront explains."""

BELIEVED = {"turbulence": 0.03, "low-pass": 0.09, "none": 0.09}
"""Unexplained share above which a wavefront is not believed, for each filter inside the loop.

Without the filter the iteration stops farther from the best fit, and right answers leave up to 0.08. Study 01 states
how often the verdict errs."""

VISIBLE = 5.0
"""Speckles must exceed photon noise by so many of its standard deviations; else there is nothing to believe."""


def speckle_band(grid: Grid, *, diameter_m: float) -> Float[np.ndarray, "v fu"]:
    """Fourier factor that keeps speckles: a narrow Gaussian less a wide one."""
    narrow = smoothing_factor(grid, radius_m=FINEST * diameter_m)
    return narrow - smoothing_factor(grid, radius_m=WIDEST * diameter_m)


def unexplained_share(
    measurement: Measurement, model: Float[Array, "plane y x"], band: Float[Array, "y fu"]
) -> Float[Array, ""]:
    """Share of the variance of the speckles that neither the model nor photon noise explains.

    Args:
        measurement: Counts.
        model: What the wavefront predicts, photo-electrons on the same pixels.
        band: See `speckle_band`.

    Returns:
        0 or a little below when the model fits, down to its share of noise when it fits noise too; towards 1 and more
        for a wrong wavefront; 1 when the frames hold no speckles.
    """
    usable = measurement.usable
    factor = jnp.broadcast_to(band, (model.shape[0], *band.shape))
    counts = jnp.where(usable, measurement.counts, 0)
    seen = blurred(counts, factor)
    missed = blurred(counts - jnp.where(usable, model, 0), factor)
    # A pixel of variance 1 leaves the mean of the filter's squared modulus (Parseval).
    passed = jnp.mean(_whole_plane(band, model.shape[2]) ** 2)
    single = jnp.where(usable, counts + measurement.read_variance, 0)
    # Negative pixels count as they are: without them read noise would pass for light, and its noise for known.
    noise = passed * jnp.maximum(jnp.mean(single, axis=(1, 2)), 0)
    speckles = jnp.mean(seen**2, axis=(1, 2)) - noise
    # The variance of noise is known from about as many independent samples as the filter passes.
    doubt = VISIBLE * noise * jnp.sqrt(2 / (passed * seen[0].size))
    share = (jnp.mean(missed**2, axis=(1, 2)) - noise) / jnp.maximum(speckles, doubt)
    return jnp.where(jnp.any(speckles > doubt), jnp.mean(jnp.where(speckles > doubt, share, 1)), 1)


def verdict(
    *,
    unexplained: Float[Array, ""],
    believed: float,
    plane_counts: Float[Array, " plane"],
    rests: Array,
    finite: Array,
) -> Int[Array, ""]:
    """The outcome of a reconstruction, as a number of `Outcome`."""
    code = jnp.where(rests, Outcome.CONVERGED, Outcome.BUDGET_SPENT)
    code = jnp.where(unexplained > believed, Outcome.NOT_EXPLAINED, code)
    code = jnp.where(jnp.any(plane_counts <= 0), Outcome.NO_LIGHT, code)
    return jnp.where(finite, code, Outcome.NOT_FINITE).astype(jnp.int32)


def _whole_plane(half: Float[Array, "y fu"], columns: int) -> Float[Array, "y u"]:
    """A real Fourier factor with its conjugate half (the same at -f: only its columns are mirrored)."""
    mirrored = half[:, 1 : (columns + 1) // 2][:, ::-1]
    return jnp.concatenate([half, jnp.roll(mirrored[::-1], 1, axis=0)], axis=1)
