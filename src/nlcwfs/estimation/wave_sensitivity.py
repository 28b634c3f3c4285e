r"""How well defocused images show each wave of the phase, beside fully speckled light.

A weak wave of frequency f on a flat wavefront becomes contrast :math:`2 \sin(\pi \lambda z f^2)` at the distance z
(Guyon 2010, eq. 2): long waves hardly any. Roughness of the wavefront scrambles that, on average to
:math:`\exp(-D(\lambda z f) / 2)`, D its structure function; that share of the light is counted as clear here, the rest
as speckled, which shows all waves alike. A closed loop is between the two. Clear shares of exp(-D) and exp(-2 D) were
tried: a loop of 97 FFTs a frame then ends at 82 and 92 nm instead of 80 (`bench/closed_loop.py`, four seeds).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.estimation.resolution_level import Level

LAGS = (1, 2, 4, 8, 16, 32)
"""Distances, in cells of the model, at which the structure function is looked up; beyond, it is the last."""

SPECKLED_LOSS = 2.1
"""Photons that speckled light needs over the quantum limit, whatever the wave: 2.0 to 2.3 from 1 to 16 cycles."""


def roughness(phase_rad: Float[Array, "y x"], level: Level) -> Float[Array, " lag"]:
    """Structure function of a phase over the pupil at `LAGS`, mean of both axes, rad^2.

    Args:
        phase_rad: On the model's grid.
        level: The pupil's light.
    """
    light = level.light

    def difference(lag: int, axis: int) -> Float[Array, ""]:
        pair = light * jnp.roll(light, lag, axis)
        missed = phase_rad - jnp.roll(phase_rad, lag, axis)
        return jnp.sum(pair * missed**2) / jnp.maximum(jnp.sum(pair), 1e-6)

    return jnp.stack([(difference(lag, 0) + difference(lag, 1)) / 2 for lag in LAGS])


def seen_share(
    frequency_per_m: Float[np.ndarray, "..."],
    rough_rad2: Float[Array, " lag"],
    *,
    pixel_m: float,
    distances_m: tuple[float, ...],
    fractions: Float[Array, " plane"],
    wavelength_m: float,
) -> Float[Array, "..."]:
    """Information of waves over what speckled light has of them.

    Args:
        frequency_per_m: Of the waves.
        rough_rad2: See `roughness`.
        pixel_m: Of the model's cells.
        distances_m: Of the planes.
        fractions: Of the light, for each plane.
        wavelength_m: Of the light.

    Examples:
        Flat light hides a wave of one cycle, and shows one of three better than speckles do.

        >>> planes = {"distances_m": (-3.5e6, 2.5e6), "fractions": jnp.full(2, 0.5), "wavelength_m": 0.85e-6}
        >>> one_and_three = np.array([1.0, 3.0]) / 8
        >>> seen_share(one_and_three, jnp.zeros(6), pixel_m=0.1, **planes).round(2).tolist()
        [0.03, 1.67]
        >>> seen_share(one_and_three, jnp.full(6, 40.0), pixel_m=0.1, **planes).round(2).tolist()
        [1.0, 1.0]
    """
    lags_m = jnp.asarray(np.array(LAGS) * pixel_m, rough_rad2.dtype)
    share = jnp.zeros(frequency_per_m.shape, rough_rad2.dtype)
    for distance_m, fraction in zip(distances_m, fractions, strict=True):
        apart_m = jnp.asarray(wavelength_m * abs(distance_m) * frequency_per_m, rough_rad2.dtype)
        clear = jnp.exp(-jnp.interp(apart_m, lags_m, rough_rad2) / 2)
        contrast = jnp.asarray(np.sin(np.pi * wavelength_m * distance_m * frequency_per_m**2) ** 2, rough_rad2.dtype)
        share = share + fraction.astype(share.dtype) * (clear * contrast * SPECKLED_LOSS + (1 - clear))
    return share
