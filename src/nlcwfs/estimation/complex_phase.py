r"""Phase and log-amplitude of the light at the pupil, as independent unknowns of unit variance.

Air at altitude changes both (`beam.air_at_pupil`): a layer at height h, to first order, leaves
:math:`\chi + i \varphi`, the spectrum of :math:`\chi` being :math:`\sin^2(\pi \lambda h f^2)` times that of the layer
(Roddier 1981, Progress in Optics 19, 281). The two are taken as independent (docs/scintillation.md).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.turbulence_filter import expected_power, half_plane_frequencies
from nlcwfs.estimation.whitened_phase import FILL, Unknown, WhitenedPhase, scaled


class ComplexPhase(eqx.Module):
    r"""The map from unknowns to phase and log-amplitude, one upon the other, and its transpose.

    It is a `gauss_newton.Prior`; `Unknown.waves` has those of both.

    Attributes:
        phase: What is expected of the phase.
        log_amplitude: Root of the expected power of each wave of the log-amplitude.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> phase = WhitenedPhase.build(Grid((8, 8), 1.0), jnp.ones((8, 5)), tilt_rms_rad=1.0, diameter_m=8.0)
        >>> both = ComplexPhase(phase, 0.1 * jnp.ones((8, 5)))
        >>> unknown = both.start(phase.start(jnp.eye(8), noise_variance=0.0))
        >>> both.phase_rad(unknown).shape, bool(jnp.all(both.phase_rad(unknown)[1] == 0))
        ((2, 8, 8), True)
    """

    phase: WhitenedPhase
    log_amplitude: Float[Array, "y fx"]

    def phase_rad(self, unknown: Unknown) -> Float[Array, "2 y x"]:
        """The complex phase of these unknowns: phase in radians, and log-amplitude in nepers."""
        phase_rad = self.phase.phase_rad(of_phase(unknown))
        waves = scaled(unknown.waves[1], self.log_amplitude)
        log_amplitude = jnp.fft.irfft2(waves, s=phase_rad.shape, norm="ortho")
        return jnp.stack([phase_rad, log_amplitude.astype(phase_rad.dtype)])

    def transposed(self, gradient: Float[Array, "2 y x"]) -> Unknown:
        """The transpose of `phase_rad` in the inner product `dot`."""
        phase = self.phase.transposed(gradient[0])
        waves = scaled(jnp.fft.rfft2(gradient[1], norm="ortho"), self.log_amplitude)
        return Unknown(jnp.stack([phase.waves, waves]), phase.slope)

    def dot(self, a: Unknown, b: Unknown) -> Float[Array, ""]:
        """Inner product; of an unknown with itself twice its negative logarithm of the prior."""
        product = (a.waves[1] * jnp.conj(b.waves[1])).real
        return self.phase.dot(of_phase(a), of_phase(b)) + jnp.sum(self.phase.twice * product)

    def start(self, phase: Unknown) -> Unknown:
        """A phase in even light."""
        return Unknown(jnp.stack([phase.waves, jnp.zeros_like(phase.waves)]), phase.slope)

    def preconditioner(self, information: Float[Array, ""], shown: Unknown) -> Unknown:
        """Inverse of the diagonal of the curvature of a fit; light shows both alike where it is speckled."""
        phase = self.phase.preconditioner(information, shown)
        waves = 1 / (1 + FILL * information * self.log_amplitude**2)
        return Unknown(jnp.stack([phase.waves, waves]), phase.slope)


def of_phase(unknown: Unknown) -> Unknown:
    """The part of the phase.

    Examples:
        >>> of_phase(Unknown(jnp.ones((2, 3, 2), complex), jnp.ones(2))).waves.shape
        (3, 2)
    """
    return Unknown(unknown.waves[0], unknown.slope)


def log_amplitude_power(
    grid: Grid,
    air: Turbulence,
    *,
    heights_m: tuple[float, ...],
    fractions: tuple[float, ...],
    wavelength_m: float,
) -> Float[np.ndarray, "y fx"]:
    r"""Variance of each Fourier coefficient of the log-amplitude, where white noise of unit variance has 1.

    :math:`\sum_l c_l \sin^2(\pi \lambda h_l f^2)` times the power of the phase.

    Args:
        grid: Cells of the model.
        air: The whole turbulence.
        heights_m: Of each layer, along the line of sight.
        fractions: Share of each layer in the turbulence.
        wavelength_m: Wavelength of sensing.

    Examples:
        >>> layers = {"heights_m": (0.0, 10e3), "fractions": (0.5, 0.5), "wavelength_m": 0.85e-6}
        >>> air, grid = Turbulence.from_seeing(seeing_arcsec=0.6), Grid((64, 64), 0.05)
        >>> power = log_amplitude_power(grid, air, **layers)
        >>> bool(power[0, 0] == 0), bool(power[0, 16] > power[0, 1])
        (True, True)
    """
    frequency_per_m = half_plane_frequencies(grid)
    share = sum(
        fraction * np.sin(np.pi * wavelength_m * height_m * frequency_per_m**2) ** 2
        for height_m, fraction in zip(heights_m, fractions, strict=True)
    )
    return share * expected_power(grid, air, wavelength_m=wavelength_m, cutoff_per_m=None)
