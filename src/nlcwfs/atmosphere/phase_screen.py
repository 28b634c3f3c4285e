"""Frozen turbulence: optical path differences with Kolmogorov's or von Karman's spectrum."""

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.special
from jaxtyping import Array, Complex, Float, PRNGKeyArray, Shaped

from nlcwfs.constants import ARCSEC_RAD, KOLMOGOROV_STRUCTURE, SEEING_TO_FRIED, SEEING_WAVELENGTH_M
from nlcwfs.errors import SettingsError

SUBHARMONIC_LEVELS = 14
"""Each level reaches three times lower frequencies; fourteen hold 99 % of the variance of Kolmogorov's tilt."""

TILT_VARIANCE = 0.449
"""Variance of Kolmogorov's tilt along one axis over (D / r0)^(5/3), rad^2 (Noll 1976, table 4)."""

CELLS_PER_SIDE = 6
"""Every level cuts the unresolved square around frequency zero into 6 x 6 cells and leaves the inner 2 x 2."""


@dataclass(frozen=True)
class Turbulence:
    """Strength and outer scale of the air above the telescope.

    Attributes:
        fried_m: Fried's parameter r0 at `wavelength_m`.
        wavelength_m: Wavelength at which `fried_m` holds.
        outer_scale_m: Von Karman's L0; infinite for Kolmogorov.

    Raises:
        SettingsError: If a length is not positive.

    Examples:
        >>> air = Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> f"{air.fried_m:.3f} m at 0.5 um, {air.fried_at(0.85e-6):.3f} m at 0.85 um"
        '0.168 m at 0.5 um, 0.317 m at 0.85 um'
    """

    fried_m: float
    wavelength_m: float = SEEING_WAVELENGTH_M
    outer_scale_m: float = math.inf

    def __post_init__(self) -> None:
        for name in ("fried_m", "wavelength_m", "outer_scale_m"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"atmosphere.{name}", "must be a positive length", getattr(self, name))

    @classmethod
    def from_seeing(cls, *, seeing_arcsec: float, outer_scale_m: float = math.inf) -> "Turbulence":
        """The air that blurs a long exposure at 0.5 um to this full width at half maximum."""
        if not seeing_arcsec > 0:
            raise SettingsError("atmosphere.seeing_arcsec", "must be a positive angle", seeing_arcsec)
        fried_m = SEEING_TO_FRIED * SEEING_WAVELENGTH_M / (seeing_arcsec * ARCSEC_RAD)
        return cls(fried_m, SEEING_WAVELENGTH_M, outer_scale_m)

    @classmethod
    def from_rms(cls, *, opd_rms_m: float, diameter_m: float) -> "Turbulence":
        """The Kolmogorov air whose mean rms over a disc, tilt included, is given (Noll 1976: 1.0299 (D/r0)^(5/3))."""
        if not opd_rms_m > 0:
            raise SettingsError("atmosphere.opd_rms_nm", "must be a positive length", opd_rms_m * 1e9)
        if not diameter_m > 0:
            raise SettingsError("diameter_m", "must be a positive length", diameter_m)
        phase_variance = (2 * math.pi * opd_rms_m / SEEING_WAVELENGTH_M) ** 2
        return cls(diameter_m * (1.0299 / phase_variance) ** 0.6)

    def fried_at(self, wavelength_m: float) -> float:
        """Fried's parameter at another wavelength, which grows as its power 6/5."""
        return self.fried_m * (wavelength_m / self.wavelength_m) ** 1.2

    def tilt_rms_rad(self, wavelength_m: float, *, diameter_m: float) -> float:
        """Rms of Kolmogorov's tilt along one axis over a disc; an outer scale does not count."""
        return math.sqrt(TILT_VARIANCE * (diameter_m / self.fried_at(wavelength_m)) ** (5 / 3))

    def opd_spectrum(self, frequency_per_m: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Power spectrum of the OPD in m^2 per (cycle/m)^2 (Noll 1976, eq. 21, in OPD)."""
        squared = np.asarray(frequency_per_m) ** 2 + self.outer_scale_m**-2
        return 0.0229 * self.fried_m ** (-5 / 3) * squared ** (-11 / 6) * (self.wavelength_m / (2 * np.pi)) ** 2

    def structure_m2(self, separation_m: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        r"""Structure function of the OPD in m^2: mean square of its difference between two points so far apart.

        :math:`6.88 (r / r_0)^{5/3}` rad^2 for Kolmogorov (Fried 1965); for von Karman as in Conan 2000 (thesis, Nice),
        :math:`2 \sigma^2 (1 - 2^{1/6} / \Gamma(5/6) \, x^{5/6} K_{5/6}(x))` with :math:`x = 2 \pi r / L_0`.
        """
        ratio = (self.wavelength_m / (2 * np.pi)) ** 2 * self.fried_m ** (-5 / 3)
        if math.isinf(self.outer_scale_m):
            return ratio * KOLMOGOROV_STRUCTURE * np.abs(separation_m) ** (5 / 3)
        x = np.maximum(2 * np.pi * np.abs(separation_m) / self.outer_scale_m, 1e-9)
        shape = 1 - 2 ** (1 / 6) / math.gamma(5 / 6) * x ** (5 / 6) * scipy.special.kv(5 / 6, x)
        # Both ends meet: near zero the bracket is Gamma(1/6) / Gamma(11/6) (x / 2)^(5/3), in which it has lost digits.
        slope = math.gamma(1 / 6) / math.gamma(11 / 6) * (x / 2) ** (5 / 3)
        far = KOLMOGOROV_STRUCTURE * (self.outer_scale_m / np.pi) ** (5 / 3) * math.gamma(11 / 6) / math.gamma(1 / 6)
        return ratio * far * np.where(x < 1e-3, slope, shape)


def mean_rms_m(air: Turbulence, diameter_m: float) -> float:
    r"""Mean rms of turbulence over a disc, tilt included, piston not.

    :math:`\sigma^2 = \int W(f)\,(1 - (2 J_1(\pi D f) / (\pi D f))^2)\, 2 \pi f\, df` (Noll 1976, sec. 3).

    Examples:
        >>> air = Turbulence.from_rms(opd_rms_m=609e-9, diameter_m=8.0)
        >>> bool(abs(mean_rms_m(air, 8.0) / 609e-9 - 1) < 0.005)  # Noll's constants have three digits
        True
    """
    frequency = np.geomspace(1e-15, 1e4, 20000) / diameter_m  # a tilt is carried by very long waves
    angle = np.pi * diameter_m * frequency
    piston = (2 * scipy.special.j1(angle) / angle) ** 2
    # 1 - piston is (angle / 2)^2 for long waves, where the difference has lost its digits.
    kept = np.where(angle < 1e-3, (angle / 2) ** 2, 1 - piston)
    density = air.opd_spectrum(frequency) * kept * 2 * np.pi * frequency
    return math.sqrt(float(scipy.integrate.trapezoid(density * frequency, np.log(frequency))))


class PhaseScreens(eqx.Module):
    """Draws independent screens of turbulence on a grid.

    A Fourier series on a square of twice the grid's width gives the fine structure; frequencies below its first
    one are added as plane waves on ever finer cells (the subharmonics of Lane, Glindemann & Dainty 1992,
    Waves in Random Media 2, 209), without which screens lack tilt.

    Examples:
        >>> import jax
        >>> from nlcwfs.beam.grid import Grid
        >>> air = Turbulence.from_rms(opd_rms_m=609e-9, diameter_m=8.0)
        >>> screens = PhaseScreens.build(air, shape=(32, 32), pixel_m=0.25)
        >>> screens.draw(jax.random.key(1)).shape
        (32, 32)
    """

    amplitude_m: Float[Array, "Y X"]
    low_amplitude_m: Float[Array, " wave"]
    low_waves_y: Complex[Array, "wave y"]
    low_waves_x: Complex[Array, "wave x"]
    low_frequency_per_m: tuple[tuple[float, float], ...] = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        turbulence: Turbulence,
        *,
        shape: tuple[int, int],
        pixel_m: float,
        period: int | None = None,
        dtype: str = "float32",
    ) -> "PhaseScreens":
        """Precompute the amplitudes of the Fourier series and of the subharmonics.

        Args:
            turbulence: Strength and outer scale.
            shape: Pixels along y and x.
            pixel_m: Width of a pixel.
            period: Pixels after which the fine structure repeats; twice the larger side of the shape when left out.
            dtype: Precision of the screens.

        Raises:
            SettingsError: If the fine structure repeats within the shape.
        """
        period = 2 * max(shape) if period is None else period
        if period < max(shape):
            raise SettingsError("period", f"must be at least the {max(shape)} pixels of the shape", period)
        step_per_m = 1 / (period * pixel_m)
        frequency = np.fft.fftfreq(period, pixel_m)
        radius = np.hypot(frequency[:, None], frequency[None, :])
        central = (np.abs(frequency[:, None]) < 1.5 * step_per_m) & (np.abs(frequency[None, :]) < 1.5 * step_per_m)
        radius = np.maximum(radius, step_per_m)
        # The mean of f^2 f^(-11/3) over a cell, to second order: as below, each wave has its cell's mean slope.
        power = turbulence.opd_spectrum(radius) * (1 + (5 / 3) ** 2 / 24 * (step_per_m / radius) ** 2)
        amplitude = np.where(central, 0, np.sqrt(power) * step_per_m)
        low_y, low_x, low_step = _low_frequencies(1.5 * step_per_m)
        low = np.sqrt(_slope_power(turbulence, low_y, low_x, low_step)) * low_step
        y_m = (np.arange(shape[0]) - (shape[0] - 1) / 2) * pixel_m
        x_m = (np.arange(shape[1]) - (shape[1] - 1) / 2) * pixel_m
        complex_dtype = np.result_type(dtype, np.complex64)
        return cls(
            amplitude_m=jnp.asarray(amplitude, dtype),
            low_amplitude_m=jnp.asarray(low, dtype),
            low_waves_y=jnp.asarray(np.exp(2j * np.pi * low_y[:, None] * y_m), complex_dtype),
            low_waves_x=jnp.asarray(np.exp(2j * np.pi * low_x[:, None] * x_m), complex_dtype),
            low_frequency_per_m=tuple(zip(low_y.tolist(), low_x.tolist(), strict=True)),
            pixel_m=pixel_m,
        )

    def draw(self, key: PRNGKeyArray) -> Float[Array, "y x"]:
        """One screen, its mean over the grid removed.

        Args:
            key: Random key; the same key gives the same screen.

        Returns:
            Optical path difference in metres.
        """
        key_high, key_low = jax.random.split(key)
        opd_m = self.cut(self.draw_fine(key_high)) + self.draw_long(key_low)
        return opd_m - opd_m.mean()

    def cut(self, fine_m: Shaped[Array, "Y X"]) -> Shaped[Array, "y x"]:
        """The part of a periodic map that the grid shows."""
        return fine_m[: self.low_waves_y.shape[1], : self.low_waves_x.shape[1]]

    def draw_long(self, key: PRNGKeyArray) -> Float[Array, "y x"]:
        """The longer waves alone, on the grid."""
        return jnp.einsum("w,wy,wx->yx", self.draw_low(key), self.low_waves_y, self.low_waves_x).real

    def draw_fine(self, key: PRNGKeyArray) -> Float[Array, "Y X"]:
        """The fine structure alone, over its whole period, beyond which it repeats."""
        noise = jax.random.normal(key, (2, *self.amplitude_m.shape), self.amplitude_m.dtype) * self.amplitude_m[None]
        return jnp.fft.fft2(jax.lax.complex(noise[0], noise[1])).real

    def draw_low(self, key: PRNGKeyArray) -> Complex[Array, " wave"]:
        """Coefficients in metres of the plane waves that are longer; the OPD is the real part of their sum."""
        dtype = self.amplitude_m.dtype
        noise = jax.random.normal(key, (2, self.low_amplitude_m.size), dtype) * self.low_amplitude_m[None]
        return jax.lax.complex(noise[0], noise[1])


def _slope_power(
    turbulence: Turbulence,
    y: Float[np.ndarray, " wave"],
    x: Float[np.ndarray, " wave"],
    step: Float[np.ndarray, " wave"],
) -> Float[np.ndarray, " wave"]:
    """Spectrum at the centres of cells, such that each carries the mean square slope of its whole cell.

    The spectrum is so steep that its value at a cell's centre falls 10 to 25 % short of the cell's mean; waves much
    longer than the telescope act through their slope alone.
    """
    nodes, weights = np.polynomial.legendre.leggauss(4)
    total = np.zeros_like(y)
    for node_y, weight_y in zip(nodes / 2, weights / 2, strict=True):
        for node_x, weight_x in zip(nodes / 2, weights / 2, strict=True):
            radius = np.hypot(y + node_y * step, x + node_x * step)
            total += weight_y * weight_x * turbulence.opd_spectrum(radius) * radius**2
    return total / (y**2 + x**2)


def _low_frequencies(
    half_width: float,
) -> tuple[Float[np.ndarray, " wave"], Float[np.ndarray, " wave"], Float[np.ndarray, " wave"]]:
    """Centres and widths of the cells that fill a square around frequency zero, ever finer towards it."""
    ys, xs, steps = [], [], []
    for _ in range(SUBHARMONIC_LEVELS):
        step = 2 * half_width / CELLS_PER_SIDE
        centres = (np.arange(CELLS_PER_SIDE) - (CELLS_PER_SIDE - 1) / 2) * step
        y, x = np.meshgrid(centres, centres, indexing="ij")
        outer = np.maximum(abs(y), abs(x)) > step
        ys.append(y[outer])
        xs.append(x[outer])
        steps.append(np.full(int(outer.sum()), step))
        half_width = step
    return np.concatenate(ys), np.concatenate(xs), np.concatenate(steps)
