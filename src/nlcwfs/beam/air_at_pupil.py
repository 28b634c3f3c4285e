r"""Turbulence at altitude, as it is at the pupil: a wavefront, and an amplitude that varies (scintillation).

In the weak regime (Rytov) the logarithm of the field travels as a field does: a layer at height h leaves
:math:`\chi + i \varphi = F^{-1}[e^{-i \pi \lambda h f^2} F[i \varphi_0]]` at the pupil, that is
:math:`\chi = F^{-1}[\sin(\pi \lambda h f^2) F \varphi_0]` and the same with a cosine for the phase (Roddier 1981).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Complex, Float, PRNGKeyArray, Shaped

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.atmosphere.scintillation import scintillation_index
from nlcwfs.beam.fresnel import fresnel_transfer
from nlcwfs.errors import SettingsError

STRONGEST_INDEX = 0.3
"""Scintillation index of a point beyond which Rytov's approximation fails (see docs/scintillation.md)."""

WIDEST_PERIOD = 4096
"""Cells after which the air of a layer may repeat: 0.13 GB for each colour and layer."""


class AirAtPupil(NamedTuple):
    """What the air does to the light at the pupil.

    Attributes:
        opd_m: The wavefront at the reference wavelength, its mean over the grid removed.
        factor: What else multiplies the field: an amplitude, or for many colours a complex number that also turns
            the phase of each to what it is; the mean of its squared modulus over many exposures is 1.
    """

    opd_m: Float[Array, "y x"]
    factor: Shaped[Array, "seen y x"]


class HighAir(eqx.Module):
    """Draws the air of layers at their heights, as it is at the pupil.

    The air of each layer is periodic, so that travel wraps around within its own pattern. Waves longer than the period
    carry no amplitude. A single layer at a height of 0 draws the wavefronts of `PhaseScreens.draw`.

    Attributes:
        screens: Statistics of the whole air, and the grid.
        transfer: Fresnel factor of each colour and layer times the root of its share; the first is the reference.
        log_variance: Variance of the logarithm of the amplitude in each colour.
        wavelengths_m: The reference, then the colours where there are several.

    Examples:
        >>> import jax
        >>> air = Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> layers = {"heights_m": (0.0, 10e3), "fractions": (0.5, 0.5)}
        >>> high = HighAir.build(air, **layers, wavelengths_m=(0.85e-6,), grid=((32, 24), 0.1))
        >>> opd_m, factor = high.draw(jax.random.key(1))
        >>> opd_m.shape, factor.shape
        ((32, 24), (1, 32, 24))
    """

    screens: PhaseScreens
    transfer: Complex[Array, "colour layer Y X"]
    log_variance: Float[Array, " colour"]
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        air: Turbulence,
        *,
        heights_m: Sequence[float],
        fractions: Sequence[float],
        wavelengths_m: Sequence[float],
        grid: tuple[tuple[int, int], float],
        dtype: str = "float32",
    ) -> "HighAir":
        """Precompute the travel from every layer.

        Args:
            air: The whole turbulence.
            heights_m: Height of each layer.
            fractions: Share of each layer in the turbulence, sum 1.
            wavelengths_m: The reference; then, for light of many colours, each of them.
            grid: Pixels along y and x, and their width in metres.
            dtype: Precision.

        Raises:
            SettingsError: If heights do not fit the layers or are negative, if the scintillation is not weak, or if a
                layer is so high that its light comes from beyond the widest screen.
        """
        shape, pixel_m = grid
        check_layers(air, heights_m, fractions, min(wavelengths_m))
        period = _period(max(heights_m), max(wavelengths_m), max(shape), pixel_m)
        screens = PhaseScreens.build(air, shape=shape, pixel_m=pixel_m, period=period, dtype=dtype)
        kind, power = np.result_type(dtype, np.complex64), np.asarray(screens.amplitude_m, float) ** 2
        transfer = np.empty((len(wavelengths_m), len(heights_m), period, period), kind)
        variance = np.zeros(len(wavelengths_m))
        for colour, layer in np.ndindex(transfer.shape[:2]):
            travel = {"distance_m": float(heights_m[layer]), "wavelength_m": float(wavelengths_m[colour])}
            factor = math.sqrt(fractions[layer]) * fresnel_transfer((period, period), **travel, pixel_m=pixel_m)
            transfer[colour, layer] = factor
            variance[colour] += np.sum(power * factor.imag**2) * (2 * np.pi / wavelengths_m[colour]) ** 2
        return cls(screens, jnp.asarray(transfer), jnp.asarray(variance, dtype), tuple(wavelengths_m))

    def draw(self, key: PRNGKeyArray) -> AirAtPupil:
        """The air of one exposure.

        Args:
            key: Random key; the same key gives the same air.
        """
        key_fine, key_low = jax.random.split(key)
        layers = self.transfer.shape[1]
        keys = [key_fine, *(jax.random.fold_in(key_fine, layer) for layer in range(1, layers))]
        fine_m = jnp.stack([self.screens.draw_fine(one) for one in keys])
        return self.at_pupil(fine_m, self.screens.draw_long(key_low))

    def at_pupil(self, fine_m: Float[Array, "layer Y X"], long_m: Float[Array, "y x"]) -> AirAtPupil:
        """What given layers leave at the pupil.

        Args:
            fine_m: Wavefront that each layer would add if all the turbulence were in it, over its whole period.
            long_m: Wavefront of the longer waves of all layers.
        """
        waves = jnp.sum(self.transfer * jnp.fft.fft2(fine_m.astype(self.transfer.dtype))[None], axis=1)
        # i k times this is log-amplitude + i phase: its real part is the OPD, its imaginary part -log-amplitude / k.
        complex_m = jax.vmap(self.screens.cut)(jnp.fft.ifft2(waves))
        per_m = jnp.asarray(2 * np.pi / np.array(self.wavelengths_m), self.log_variance.dtype)[:, None, None]
        amplitude = jnp.exp(-per_m * complex_m.imag - self.log_variance[:, None, None])
        opd_m = complex_m[0].real + long_m
        opd_m = opd_m - opd_m.mean()
        if len(self.wavelengths_m) == 1:
            return AirAtPupil(opd_m, amplitude)
        turned = per_m[1:] * (complex_m[1:].real - complex_m[:1].real)
        return AirAtPupil(opd_m, jax.lax.complex(amplitude[1:] * jnp.cos(turned), amplitude[1:] * jnp.sin(turned)))


def check_layers(air: Turbulence, heights_m: Sequence[float], fractions: Sequence[float], shortest_m: float) -> None:
    """Refuse layers that are not there, and air that is too strong.

    Args:
        air: The whole turbulence.
        heights_m: Height of each layer.
        fractions: Share of each layer in the turbulence.
        shortest_m: The shortest wavelength.

    Raises:
        SettingsError: If heights do not fit the layers or are negative, or if the scintillation is not weak.

    Examples:
        >>> check_layers(Turbulence.from_seeing(seeing_arcsec=0.6), (0.0, 10e3), (0.5, 0.5), 0.85e-6)
    """
    shown = [height_m / 1e3 for height_m in heights_m]
    if len(shown) != len(fractions):
        raise SettingsError("atmosphere.layer_heights_km", f"must be one per layer, {len(fractions)}", shown)
    if not all(0 <= height_km < math.inf for height_km in shown):
        raise SettingsError("atmosphere.layer_heights_km", "must be from 0 upward, finite", shown)
    index = scintillation_index(air, heights_m, fractions, wavelength_m=shortest_m)
    if not index <= STRONGEST_INDEX:
        rule = (
            f"must leave the scintillation weak, an index of at most {STRONGEST_INDEX:g} at {shortest_m * 1e6:.3g} um"
        )
        raise SettingsError("atmosphere.layer_heights_km", rule, f"{shown}, {index:.2g}")


def _period(height_m: float, wavelength_m: float, side: int, pixel_m: float) -> int:
    """Cells after which the air may repeat, so that no light of a layer reaches both edges of the grid.

    The finest wave of the grid sends light `wavelength height / (2 pixel)` aside.
    """
    reach_m = wavelength_m * height_m / (2 * pixel_m)
    period = max(2 * side, side + 2 * math.ceil(reach_m / pixel_m))
    while period > 2 * side and period != scipy.fft.next_fast_len(period):
        period += 1
    if period > max(WIDEST_PERIOD, 2 * side):
        most_km = (WIDEST_PERIOD - side) * pixel_m**2 / wavelength_m / 1e3
        rule = f"must be at most {most_km:.3g} on cells of {pixel_m:.3g} m: light that the finest wave sends aside by "
        rule += f"{reach_m:.3g} m needs a screen of {period} cells, {WIDEST_PERIOD} are served"
        raise SettingsError("atmosphere.layer_heights_km", rule, height_m / 1e3)
    return period
