"""A tilted wavefront: its phase, and the tilt in any wavefront."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.grid import Grid


def tilt_phase(slope: Float[Array, "2"], grid: Grid, wavelength_m: float) -> Float[Array, "y x"]:
    """Phase of a plane wave with this slope (y, x)."""
    y_m, x_m = jnp.asarray(grid.y_m, slope.dtype), jnp.asarray(grid.x_m, slope.dtype)
    return (slope[0] * y_m + slope[1] * x_m) * (2 * np.pi / wavelength_m)


def mean_slope(opd_m: Float[Array, "y x"], light: Float[Array, "y x"], grid: Grid) -> Float[Array, "2"]:
    """Tilt (y, x) of a wavefront by least squares over the light of the pupil."""
    y_m = jnp.asarray(np.broadcast_to(grid.y_m, grid.shape), opd_m.dtype)
    x_m = jnp.asarray(np.broadcast_to(grid.x_m, grid.shape), opd_m.dtype)
    planes = jnp.stack([jnp.ones_like(y_m), y_m, x_m]).reshape(3, -1)
    weighted = planes * light.reshape(1, -1)
    return jnp.linalg.solve(weighted @ planes.T, weighted @ opd_m.reshape(-1))[1:]
