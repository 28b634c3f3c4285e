"""A phase as independent unknowns of unit variance: what the prior expects of it is divided out."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.segment_steps import SegmentSteps
from nlcwfs.estimation.turbulence_filter import times_counted

FILL = 0.15
"""Share of the window that the pupil fills, for the preconditioner: 0.17 in a window of two telescopes. Too much
costs a stream of 97 FFTs a frame a tenth of its rms."""


class Unknown(NamedTuple):
    """A phase in units of what the prior expects; each real number in it has unit variance.

    Attributes:
        waves: Half-plane of Fourier coefficients (`rfft2`, orthonormal), of a `ComplexPhase` two, of phase and
            log-amplitude; or, of a `ModalPrior`, real unknowns.
        slope: Tilt along y and x: a window that repeats itself cannot hold one. Then the steps of a segmented pupil.
    """

    waves: Complex[Array, "*both y fx"] | Float[Array, " unknown"]
    slope: Float[Array, " ramp"]


class WhitenedPhase(eqx.Module):
    r"""The map from unknowns to a phase, :math:`\phi = F^{-1} \sqrt{P}\, x + t \cdot s`, and its transpose.

    Attributes:
        amplitude: Root of the expected power P of each wave (see `turbulence_filter.expected_power`).
        tilt: Phase of a tilt of the expected rms along y and along x.
        twice: How often a stored wave counts: its conjugate is not stored.
        steps: Piston, tip and tilt of each segment of the pupil; None for a pupil of one piece.

    Examples:
        >>> import jax.numpy as jnp
        >>> from nlcwfs.beam.grid import Grid
        >>> whitened = WhitenedPhase.build(Grid((8, 8), 1.0), jnp.ones((8, 5)), tilt_rms_rad=1.0, diameter_m=8.0)
        >>> phase = jnp.zeros((8, 8)).at[2, 3].set(1.0)
        >>> found = whitened.start(phase, noise_variance=0.0)  # white noise of unit variance is its own unknown
        >>> bool(jnp.allclose(whitened.phase_rad(found), phase, atol=1e-6)), round(float(whitened.dot(found, found)), 5)
        (True, 1.0)
    """

    amplitude: Float[Array, "y fx"]
    tilt: Float[Array, "2 y x"]
    twice: Float[Array, "1 fx"]
    steps: SegmentSteps | None = None

    @classmethod
    def build(
        cls,
        grid: Grid,
        power: Float[Array, "y fx"],
        *,
        tilt_rms_rad: float | Float[Array, ""],
        diameter_m: float,
        steps: SegmentSteps | None = None,
    ) -> "WhitenedPhase":
        """Unknowns of a phase with this power.

        Args:
            grid: Pixels of the phase.
            power: Variance of each wave where white noise of unit variance has 1.
            tilt_rms_rad: Rms over a disc of the tilt expected along one axis, beside the waves.
            diameter_m: Diameter of the disc.
            steps: Of a segmented pupil, beside all that.
        """
        # Noll's tilt of unit rms is 2 r / R.
        y, x = np.broadcast_to(grid.y_m, grid.shape), np.broadcast_to(grid.x_m, grid.shape)
        unit = np.stack([y, x]) * (4 / diameter_m)
        return cls(
            amplitude=jnp.sqrt(power),
            tilt=jnp.asarray(unit, power.dtype) * jnp.asarray(tilt_rms_rad, power.dtype),
            twice=jnp.asarray(times_counted(grid.shape[1]), power.dtype),
            steps=steps,
        )

    def phase_rad(self, unknown: Unknown) -> Float[Array, "y x"]:
        """The phase of these unknowns."""
        waves = jnp.fft.irfft2(scaled(unknown.waves, self.amplitude), s=self.tilt.shape[1:], norm="ortho")
        smooth = waves.astype(self.amplitude.dtype) + jnp.tensordot(unknown.slope[:2], self.tilt, axes=1)
        return smooth if self.steps is None else smooth + self.steps.phase_rad(unknown.slope[2:])

    def transposed(self, gradient: Float[Array, "y x"]) -> Unknown:
        """The transpose of `phase_rad` in the inner product `dot`."""
        waves = scaled(jnp.fft.rfft2(gradient, norm="ortho"), self.amplitude)
        slope = jnp.tensordot(self.tilt, gradient, axes=2)
        if self.steps is not None:
            slope = jnp.concatenate([slope, self.steps.transposed(gradient)])
        return Unknown(waves, slope)

    def dot(self, a: Unknown, b: Unknown) -> Float[Array, ""]:
        """Inner product; of an unknown with itself twice its negative logarithm of the prior."""
        product = a.waves.real * b.waves.real + a.waves.imag * b.waves.imag
        return jnp.sum(self.twice * product) + jnp.dot(a.slope, b.slope)

    def nothing(self) -> Unknown:
        """The unknowns of the flat phase."""
        dtype = self.amplitude.dtype
        kind = jnp.complex128 if dtype == jnp.float64 else jnp.complex64
        count = 0 if self.steps is None else 3 * self.steps.count
        return Unknown(jnp.zeros_like(self.amplitude, kind), jnp.zeros(2 + count, dtype))

    def start(self, phase_rad: Float[Array, "y x"], *, noise_variance: float | Float[Array, ""]) -> Unknown:
        """The unknowns of a phase that is known up to white noise (rad^2 per pixel); it holds no tilt of its own.

        What is straight on a segment counts as its step; beyond the light the rest goes on as it ends.
        """
        slope = jnp.zeros(2, self.amplitude.dtype)
        if self.steps is not None:
            found = self.steps.fitted(phase_rad)
            phase_rad = self.steps.spread(phase_rad - self.steps.phase_rad(found))
            slope = jnp.concatenate([slope, found])
        spectrum = jnp.fft.rfft2(phase_rad, norm="ortho")
        tiny = jnp.finfo(self.amplitude.dtype).tiny
        waves = scaled(spectrum, self.amplitude / (self.amplitude**2 + noise_variance + tiny))
        return Unknown(waves, slope)

    def preconditioner(self, information: Float[Array, ""], shown: Unknown) -> Unknown:
        """Inverse of the diagonal of the curvature of a fit, `1 / (1 + fill * information * P)` for each wave.

        Args:
            information: Of the phase of one cell, 1/rad^2.
            shown: What each unknown has of that.
        """
        waves = 1 / (1 + FILL * information * shown.waves * self.amplitude**2)
        lit = jnp.sum(self.tilt**2, axis=(1, 2))
        # A tilt reaches beyond the pupil: a disc in a window holds at least an eighth of its squares.
        slope = 1 / (1 + information * shown.slope * lit / 8)
        if self.steps is not None:
            slope = jnp.concatenate([slope, 1 / (1 + information * self.steps.squares())])
        return Unknown(waves, slope)


def scaled(
    waves: Complex[Array, "..."] | Float[Array, "..."], factor: Float[Array, "..."] | float
) -> Complex[Array, "..."] | Float[Array, "..."]:
    """Waves, or whatever the unknowns are, times real numbers.

    Examples:
        >>> complex(scaled(jnp.asarray(1 + 2j), jnp.asarray(2.0)))
        (2+4j)
    """
    return waves * jnp.asarray(factor).astype(waves.dtype)
