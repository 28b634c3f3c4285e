"""What the images look like on average over the turbulence that is not modelled yet."""

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.turbulence_filter import half_plane_frequencies

SPEED = 1.3
"""Measured: speckles of a partly known wavefront fade 1.3 times faster than the mean coherence alone says."""


def unmodelled_structure(
    separation_m: Float[np.ndarray, "*shape"],
    turbulence: Turbulence,
    *,
    wavelength_m: float,
    cutoff_per_m: float,
) -> Float[np.ndarray, "*shape"]:
    r"""Structure function of the turbulent phase beyond a spatial frequency, rad^2.

    :math:`D(r) = 4 \pi \int_{f_c}^\infty W(f) (1 - J_0(2 \pi f r))\, f \, df`.

    Examples:
        >>> import numpy as np
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> air = Turbulence(fried_m=1.0, wavelength_m=0.65e-6)
        >>> far = unmodelled_structure(np.array([0.0, 50.0]), air, wavelength_m=0.65e-6, cutoff_per_m=1.0)
        >>> variance = 0.0229 * 2 * np.pi * 3 / 5  # twice this far away: the waves are then unrelated
        >>> bool(far[0] == 0), bool(abs(far[1] / (2 * variance) - 1) < 0.02)
        (True, True)
    """
    frequency = np.geomspace(cutoff_per_m, 2000 * cutoff_per_m, 2000)
    power = turbulence.opd_spectrum(frequency) * (2 * np.pi / wavelength_m) ** 2
    table_m = np.linspace(0, max(float(np.max(separation_m)), 1e-6), 400)
    waves = 1 - scipy.special.j0(2 * np.pi * frequency[None, :] * table_m[:, None])
    table = np.trapezoid(4 * np.pi * power * waves * frequency, frequency, axis=1)
    return np.interp(separation_m, table_m, table)


def unmodelled_variance(turbulence: Turbulence, *, wavelength_m: float, cutoff_per_m: float) -> float:
    """Variance of the turbulent phase beyond a spatial frequency, rad^2 (Kolmogorov's spectrum)."""
    power = float(turbulence.opd_spectrum(np.array([cutoff_per_m]))[0]) * (2 * np.pi / wavelength_m) ** 2
    return 2 * np.pi * power * cutoff_per_m**2 * 3 / 5


def image_structures(
    grid: Grid,
    turbulence: Turbulence,
    *,
    distances_m: tuple[float, ...],
    wavelength_m: float,
    cutoff_per_m: float,
) -> Float[np.ndarray, "plane y fx"]:
    """For each wave of an image, the structure function of the two pupil points that make it interfere.

    A wave of frequency f in the image at distance z comes from points `wavelength * z * f` apart.
    """
    frequency_per_m = half_plane_frequencies(grid)
    separation_m = wavelength_m * np.abs(np.array(distances_m))[:, None, None] * frequency_per_m
    return unmodelled_structure(separation_m, turbulence, wavelength_m=wavelength_m, cutoff_per_m=cutoff_per_m)


def smoothing_factor(grid: Grid, *, radius_m: float) -> Float[np.ndarray, "y fx"]:
    """Fourier factor of a Gaussian of this standard deviation."""
    return np.exp(-2 * (np.pi * radius_m * half_plane_frequencies(grid)) ** 2)


def blurred(images: Float[Array, "plane y x"], factor: Float[Array, "plane y fx"]) -> Float[Array, "plane y x"]:
    """Images with each wave multiplied by a factor."""
    spectrum = jnp.fft.rfft2(images)
    return jnp.fft.irfft2(spectrum * factor.astype(spectrum.dtype), s=images.shape[1:]).astype(images.dtype)
