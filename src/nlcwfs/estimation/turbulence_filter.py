"""Smoothing a phase as turbulence is smooth: the filter inside the loop."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid


def half_plane_frequencies(grid: Grid) -> Float[np.ndarray, "y fx"]:
    """Moduli of the spatial frequencies of a real Fourier transform (`rfft2`), cycles per metre."""
    return np.hypot(grid.fy_per_m, np.fft.rfftfreq(grid.shape[1], grid.pixel_m)[None, :])


def times_counted(columns: int) -> Float[np.ndarray, "1 fx"]:
    """How often each wave of a real Fourier transform (`rfft2`) counts: twice where its conjugate is not stored.

    Examples:
        >>> times_counted(4).tolist(), times_counted(5).tolist()
        ([[1.0, 2.0, 1.0]], [[1.0, 2.0, 2.0]])
    """
    counted = np.full((1, columns // 2 + 1), 2.0)
    counted[:, 0] = 1.0
    if columns % 2 == 0:
        counted[:, -1] = 1.0
    return counted


def expected_power(
    grid: Grid, turbulence: Turbulence, *, wavelength_m: float, cutoff_per_m: float | None
) -> Float[np.ndarray, "y fx"]:
    """Variance of each Fourier coefficient of turbulent phase, where white noise of unit variance has 1.

    Args:
        grid: Pixels of the phase.
        turbulence: Strength of the air.
        wavelength_m: Wavelength at which the phase counts.
        cutoff_per_m: Finest wave wanted; what is beyond falls with the 8th power. None keeps all.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.grid import Grid
        >>> air = Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> power = expected_power(Grid((8, 8), 0.5), air, wavelength_m=0.85e-6, cutoff_per_m=None)
        >>> power.shape, bool(power[0, 1] > power[0, 2])
        ((8, 5), True)
    """
    frequency_per_m = half_plane_frequencies(grid)
    # Kolmogorov's spectrum has no end towards zero; half the first frequency stands for what is below it.
    lowest_per_m = 0.5 / max(grid.width_m)
    opd_spectrum = turbulence.opd_spectrum(np.maximum(frequency_per_m, lowest_per_m))
    power = opd_spectrum * (2 * np.pi / wavelength_m) ** 2 / grid.pixel_m**2
    if cutoff_per_m is not None:
        power = power / (1 + (frequency_per_m / cutoff_per_m) ** 8)
    return power


def wiener_filter(power: Float[Array, "y fx"], noise_variance: float | Float[Array, ""]) -> Float[Array, "y fx"]:
    """Share of each wave to keep: `power / (power + noise_variance)`.

    Args:
        power: See `expected_power`.
        noise_variance: Variance of white noise per pixel, rad^2.
    """
    return power / (power + noise_variance)


def smoothed_phase(phase_rad: Float[Array, "y x"], kept: Float[Array, "y fx"]) -> Float[Array, "y x"]:
    """A phase that is not wrapped, on a periodic grid, with each wave multiplied by the share to keep."""
    spectrum = jnp.fft.rfft2(phase_rad)
    return jnp.fft.irfft2(spectrum * kept.astype(spectrum.dtype), s=phase_rad.shape).astype(phase_rad.dtype)


def expected_error(power: Float[Array, "y fx"], noise_variance: Float[Array, ""], grid: Grid) -> Float[Array, ""]:
    """Rms phase error that is left by noise and smoothing: each wave keeps `power * noise / (power + noise)`.

    Piston and, because a pupil shows them as little else, waves longer than two windows are not counted.

    Args:
        power: See `expected_power`.
        noise_variance: Variance of white phase noise per pixel, rad^2.
        grid: Pixels of the phase.
    """
    return rms_of_power(power * noise_variance / (power + noise_variance), grid)


def rms_of_power(power: Float[Array, "y fx"], grid: Grid) -> Float[Array, ""]:
    """Rms of a phase with this power, piston excluded.

    Examples:
        >>> round(float(rms_of_power(jnp.ones((8, 5)), Grid((8, 8), 1.0))) ** 2, 6)  # white noise less its mean
        0.984375
    """
    rows, columns = grid.shape
    counted = power * jnp.asarray(times_counted(columns), power.dtype)
    return jnp.sqrt((jnp.sum(counted) - counted[0, 0]) / (rows * columns))
