"""Photon noise of very many pixels that share few photons, as behind thousands of lenslets."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from nlcwfs.detector.photon_noise import sample_poisson
from nlcwfs.errors import SettingsError

MARGIN_SIGMA = 8.0
"""Room for a total this far above its mean: it is exceeded once in 1e15 frames."""

FEW = 40
"""And this much more, for the skewness of a small mean."""


def room_for_photons(mean_total: float) -> int:
    """How many photons `sample_sparse_photons` must make room for, so that no frame ever has more.

    Raises:
        SettingsError: If the mean is not a positive number.

    Examples:
        >>> room_for_photons(2e4)
        21172
    """
    if not 0 < mean_total < math.inf:
        raise SettingsError("mean_total", "must be a positive number of photons", mean_total)
    return math.ceil(mean_total + MARGIN_SIGMA * math.sqrt(mean_total)) + FEW


def sample_sparse_photons(
    key: PRNGKeyArray, mean: Float[Array, "plane y x"], *, room: int
) -> Float[Array, "plane y x"]:
    """Count photons on every pixel: independent Poisson numbers of the given means, exactly.

    The total is a Poisson number; each photon then falls on a plane, a row of it and a pixel of the row with the
    probabilities of the means. What has to be drawn is the photons and not the pixels: 2e4 photons on 11.5 million
    pixels take 0.06 s instead of 1.0 s for `sample_poisson` (two cores). Read noise touches every pixel: there use
    `Detector.read`.

    Args:
        key: Random key, used once.
        mean: Expected photo-electrons on every pixel, not negative.
        room: Most photons of a frame, see `room_for_photons`; what exceeds it is lost.

    Returns:
        Whole numbers, as floats of the input's dtype.

    Examples:
        >>> mean = jnp.full((3, 4, 4), 2.0)
        >>> counts = sample_sparse_photons(jax.random.key(0), mean, room=room_for_photons(96.0))
        >>> counts.shape, bool(50 < counts.sum() < 150)
        ((3, 4, 4), True)
    """
    key_total, key_place = jax.random.split(key)
    in_row = jnp.sum(mean, axis=2)
    in_plane = jnp.sum(in_row, axis=1)
    total = sample_poisson(key_total, jnp.sum(in_plane))
    deviate = jax.random.uniform(key_place, (3, room), mean.dtype)
    edges = jnp.cumsum(in_plane)
    plane = jnp.searchsorted(edges, deviate[0] * edges[-1], side="right")
    plane = jnp.minimum(plane, mean.shape[0] - 1)
    row = _drawn(in_row[plane], deviate[1])
    column = _drawn(mean[plane, row], deviate[2])
    arrived = (jnp.arange(room) < total.astype(int)).astype(mean.dtype)
    return jnp.zeros_like(mean).at[plane, row, column].add(arrived)


def _drawn(weights: Float[Array, "photon place"], deviate: Float[Array, " photon"]) -> Int[Array, " photon"]:
    """A place for each photon, with the probabilities of its weights; a place without weight is never drawn."""
    edges = jnp.cumsum(weights, axis=1)
    place = jnp.sum(edges <= (deviate * edges[:, -1])[:, None], axis=1)
    return jnp.minimum(place, weights.shape[1] - 1)
