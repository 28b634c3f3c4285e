"""How strong is the turbulence? Measured from the slopes of the phase found so far."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.turbulence_filter import times_counted

LARGEST_STEP = 1.5
"""One update changes the strength by no more than this factor: the first guesses of a phase are poor."""


def slope_weights(grid: Grid) -> Float[np.ndarray, "y fx"]:
    """What each wave of unit power adds to the mean square difference of neighbouring pixels (both axes).

    `(2 sin(pi f dx))^2` summed over the axes, twice for waves whose conjugate is not stored, over the pixels.
    """
    rows, columns = grid.shape
    step_y = 2 * np.sin(np.pi * grid.fy_per_m * grid.pixel_m)
    step_x = 2 * np.sin(np.pi * np.fft.rfftfreq(columns, grid.pixel_m)[None, :] * grid.pixel_m)
    return (step_y**2 + step_x**2) * times_counted(columns) / (rows * columns)


def updated_strength(
    strength: Float[Array, ""],
    phase_rad: Float[Array, "y x"],
    light: Float[Array, "y x"],
    power: Float[Array, "y fx"],
    weights: Float[Array, "y fx"],
    noise_variance: Float[Array, ""],
) -> Float[Array, ""]:
    """The strength for which the filter would let through slopes as large as those found.

    Args:
        strength: Present variance over that behind `power`.
        phase_rad: The phase found with it, tilt included.
        light: Light of each pixel over that of a fully lit one.
        power: Expected power for strength 1, with the cutoff of the filter.
        weights: See `slope_weights`.
        noise_variance: Variance of the noise per pixel, rad^2.
    """
    both_y, both_x = jnp.minimum(light[1:], light[:-1]), jnp.minimum(light[:, 1:], light[:, :-1])
    found = jnp.sum(both_y * (phase_rad[1:] - phase_rad[:-1]) ** 2) / jnp.sum(both_y)
    found = found + jnp.sum(both_x * (phase_rad[:, 1:] - phase_rad[:, :-1]) ** 2) / jnp.sum(both_x)
    stronger = power * strength
    expected = jnp.sum(weights * stronger**2 / (stronger + noise_variance))
    return strength * jnp.clip(found / expected, 1 / LARGEST_STEP, LARGEST_STEP)
