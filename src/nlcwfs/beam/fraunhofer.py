"""Travel to infinity: from the pupil to directions on the sky."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from nlcwfs.beam.grid import Grid


def propagate_fraunhofer(
    field: Complex[Array, "y x"], *, wavelength_m: float, pixel_m: float, angles: Grid
) -> Complex[Array, "v u"]:
    r"""Fourier transform a field to directions on the sky.

    :math:`E(\theta) = \frac{\Delta x\,\Delta\theta}{\lambda} \sum_x E(x) \exp(-2 \pi i\, x \theta / \lambda)`,
    computed as two matrix products, so that any angular pixel and any window are possible (Soummer et al. 2007,
    Opt. Express 15, 15935). A path that grows towards +x moves the light towards +x.

    Args:
        field: Complex amplitude at the pupil.
        wavelength_m: Wavelength of the light.
        pixel_m: Width of a pixel at the pupil.
        angles: The directions; its `pixel_m` is read as radians per pixel.

    Returns:
        Complex amplitude per direction; `sum(|E|^2)` tends to `sum(|field|^2)` when the directions cover the light.

    Examples:
        >>> import jax.numpy as jnp
        >>> from nlcwfs.beam.grid import Grid
        >>> pupil = jnp.ones((16, 16), complex)
        >>> angles = Grid((5, 5), pixel_m=0.85e-6 / 8)
        >>> image = propagate_fraunhofer(pupil, wavelength_m=0.85e-6, pixel_m=0.5, angles=angles)
        >>> bool(abs(image[2, 2]) > 100 * abs(image[2, 3]))  # the first zero lies at wavelength / width
        True
    """
    near = Grid((field.shape[0], field.shape[1]), pixel_m)
    scale = pixel_m * angles.pixel_m / wavelength_m
    to_v = np.exp(-2j * np.pi / wavelength_m * angles.y_m * near.y_m.T) * scale
    to_u = np.exp(-2j * np.pi / wavelength_m * near.x_m.T * angles.x_m)
    return jnp.asarray(to_v, field.dtype) @ field @ jnp.asarray(to_u, field.dtype)
