"""The image of a star behind a pupil with an aberrated wavefront."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fraunhofer import propagate_fraunhofer
from nlcwfs.beam.grid import Grid


def point_spread_function(
    pupil: Float[np.ndarray, "y x"] | Float[Array, "y x"],
    opd_m: Float[Array, "y x"],
    *,
    wavelength_m: float,
    pixel_m: float,
    angles: Grid,
) -> Float[Array, "v u"]:
    """Image of a star, in units of the peak without aberration.

    Args:
        pupil: Amplitude from 0 to 1.
        opd_m: Residual wavefront, positive for a longer path.
        wavelength_m: Wavelength of the image.
        pixel_m: Width of a pixel at the pupil.
        angles: Directions on the sky; its `pixel_m` is read as radians per pixel.

    Returns:
        Intensity; 1 at the peak of a perfect telescope, so its maximum is the Strehl ratio.

    Examples:
        >>> import jax.numpy as jnp
        >>> from nlcwfs.beam.grid import Grid
        >>> psf = point_spread_function(
        ...     jnp.ones((8, 8)), jnp.zeros((8, 8)), wavelength_m=1e-6, pixel_m=1.0, angles=Grid((3, 3), 1e-8)
        ... )
        >>> round(float(psf.max()), 6)
        1.0
    """
    field = pupil_field(pupil, opd_m, wavelength_m=wavelength_m)
    image = propagate_fraunhofer(field, wavelength_m=wavelength_m, pixel_m=pixel_m, angles=angles)
    flat = jnp.sum(jnp.abs(field)) * (pixel_m * angles.pixel_m / wavelength_m)
    return (image.real**2 + image.imag**2) / flat**2


def strehl_ratio(
    pupil: Float[np.ndarray, "y x"] | Float[Array, "y x"], opd_m: Float[Array, "y x"], *, wavelength_m: float
) -> Float[Array, ""]:
    """Intensity on the axis over that of a perfect telescope.

    Examples:
        >>> import jax.numpy as jnp
        >>> round(float(strehl_ratio(jnp.ones((4, 4)), jnp.full((4, 4), 1e-7), wavelength_m=1e-6)), 6)
        1.0
    """
    field = pupil_field(pupil, opd_m, wavelength_m=wavelength_m)
    return (jnp.abs(jnp.sum(field)) / jnp.sum(jnp.abs(field))) ** 2
