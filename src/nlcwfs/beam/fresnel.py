"""Travel over a finite distance in the paraxial approximation."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from nlcwfs.beam.grid import Grid
from nlcwfs.errors import SamplingError


def fresnel_transfer(
    shape: tuple[int, int], *, distance_m: float, wavelength_m: float, pixel_m: float
) -> Complex[np.ndarray, "y x"]:
    r"""The factor by which travel multiplies each spatial frequency of a field.

    :math:`\exp(-i \pi \lambda z |f|^2)` (Goodman 2005, sec. 4.2), without the carrier
    :math:`\exp(i k z)`, in the order of `numpy.fft`. It is computed in double precision because its phase
    reaches thousands of radians; cast the result, not the arguments.

    Args:
        shape: Pixels along y and x.
        distance_m: How far to travel; positive is downstream, negative travels back.
        wavelength_m: Wavelength of the light.
        pixel_m: Width of a pixel.

    Raises:
        SamplingError: If a length is not positive or the distance is not finite.

    Examples:
        >>> transfer = fresnel_transfer((4, 4), distance_m=1e6, wavelength_m=0.85e-6, pixel_m=0.5)
        >>> complex(transfer[0, 0])
        (1+0j)
    """
    if not 0 < wavelength_m < np.inf:
        raise SamplingError("wavelength_m", "must be a positive length", wavelength_m)
    if not np.isfinite(distance_m):
        raise SamplingError("distance_m", "must be a finite length", distance_m)
    grid = Grid(shape, pixel_m)
    phase_rad = -np.pi * wavelength_m * distance_m * (grid.fx_per_m**2 + grid.fy_per_m**2)
    return np.exp(1j * phase_rad)


def propagate_fresnel(
    field: Complex[Array, "y x"], *, distance_m: float, wavelength_m: float, pixel_m: float
) -> Complex[Array, "y x"]:
    r"""Carry a field over a distance in the paraxial approximation.

    Multiplies the spectrum by `fresnel_transfer`. Light that leaves the grid re-enters on the other side:
    pad first, see `beam.sampling`.

    Args:
        field: Complex amplitude at the near plane.
        distance_m: How far to travel; negative travels back and is the exact inverse.
        wavelength_m: Wavelength of the light.
        pixel_m: Width of a pixel.

    Returns:
        The field at the far plane, on the same grid, with the same total power.

    Raises:
        SamplingError: If a length is not positive or the distance is not finite.

    Examples:
        A plane wave stays what it is; a point of light spreads.

        >>> import jax.numpy as jnp
        >>> plane_wave = jnp.ones((8, 8), complex)
        >>> far = propagate_fresnel(plane_wave, distance_m=1e6, wavelength_m=0.85e-6, pixel_m=0.1)
        >>> bool(jnp.allclose(far, plane_wave, atol=1e-5))
        True
    """
    transfer = fresnel_transfer(
        (field.shape[0], field.shape[1]), distance_m=distance_m, wavelength_m=wavelength_m, pixel_m=pixel_m
    )
    return jnp.fft.ifft2(jnp.fft.fft2(field) * jnp.asarray(transfer, field.dtype))
