"""An ideal coronagraph: it takes out the light that a perfect telescope would send, and leaves that of aberrations."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fraunhofer import propagate_fraunhofer
from nlcwfs.beam.grid import Grid


def coronagraphic_image(
    pupil: Float[np.ndarray, "y x"] | Float[Array, "y x"],
    opd_m: Float[Array, "y x"],
    *,
    wavelength_m: float,
    pixel_m: float,
    angles: Grid,
) -> Float[Array, "v u"]:
    r"""Image of a star behind an ideal coronagraph, in units of the peak without coronagraph and aberration.

    The pupil loses its coherent part, :math:`E - A \sum E / \sum A`, so that nothing is left on the axis, and nothing
    anywhere without aberration. It is the image of the best of coronagraphs; what a real one leaves comes on top.

    Args:
        pupil: Amplitude from 0 to 1.
        opd_m: Residual wavefront, positive for a longer path.
        wavelength_m: Wavelength of the image.
        pixel_m: Width of a pixel at the pupil.
        angles: Directions on the sky; its `pixel_m` is read as radians per pixel.

    Examples:
        >>> light = {"wavelength_m": 1e-6, "pixel_m": 1.0, "angles": Grid((3, 3), 1e-7)}
        >>> image = coronagraphic_image(jnp.ones((8, 8)), jnp.full((8, 8), 1e-7), **light)  # piston alone
        >>> bool(image.max() < 1e-12)
        True
    """
    field = pupil_field(pupil, opd_m, wavelength_m=wavelength_m)
    amplitude = jnp.abs(field)
    rest = field - amplitude.astype(field.dtype) * (jnp.sum(field) / jnp.sum(amplitude).astype(field.dtype))
    image = propagate_fraunhofer(rest, wavelength_m=wavelength_m, pixel_m=pixel_m, angles=angles)
    flat = jnp.sum(amplitude) * (pixel_m * angles.pixel_m / wavelength_m)
    return (image.real**2 + image.imag**2) / flat**2
