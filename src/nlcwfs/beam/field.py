"""The complex light at the pupil of the telescope."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float


def pupil_field(
    pupil: Float[Array, "y x"] | Float[np.ndarray, "y x"],
    opd_m: Float[Array, "y x"],
    *,
    wavelength_m: float | Float[Array, ""],
    photons: float | Float[Array, ""] = 1.0,
) -> Complex[Array, "y x"]:
    """The light that a star sends through a pupil, with an aberrated wavefront.

    `sqrt(photons) * A / |A| * exp(+2 pi i opd / wavelength)`: a longer path is a later, hence larger, phase.

    Args:
        pupil: Amplitude from 0 to 1.
        opd_m: Optical path difference, positive for a longer path; its dtype rules the result's.
        wavelength_m: Wavelength of the light.
        photons: Number of photons in the whole pupil.

    Returns:
        Complex amplitude; its squared modulus is photons per pixel and sums to `photons`.

    Examples:
        >>> import jax.numpy as jnp
        >>> field = pupil_field(jnp.ones((4, 4)), jnp.zeros((4, 4)), wavelength_m=0.65e-6, photons=100.0)
        >>> round(float(jnp.sum(jnp.abs(field) ** 2)))
        100
    """
    amplitude = jnp.asarray(pupil, opd_m.dtype)
    scale = jnp.sqrt(jnp.asarray(photons, opd_m.dtype) / jnp.sum(amplitude**2))
    phase_rad = opd_m * (2 * np.pi / wavelength_m)
    modulus = amplitude * scale
    return jax.lax.complex(modulus * jnp.cos(phase_rad), modulus * jnp.sin(phase_rad))
