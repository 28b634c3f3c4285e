"""What an estimator says about a wavefront."""

import equinox as eqx
from jaxtyping import Array, Float, Int

from nlcwfs.estimation.error_bars import ErrorBars
from nlcwfs.estimation.outcome import Outcome


class WavefrontEstimate(eqx.Module):
    """A wavefront with the account of how it was found; batches carry a leading frame axis.

    Attributes:
        opd_m: Unwrapped optical path difference on the frames' pixels, zero mean over the pupil. It goes on
            smoothly beyond the pupil, where it means nothing.
        predicted_error_m: Expected rms error over the pupil, from photon noise and turbulence; one sigma.
        unexplained: Share of the speckles that neither model nor noise explains, see `fit_quality`.
        residual: Counts minus model, photo-electrons.
        iterations: Iterations, over all resolutions.
        ffts: Two-dimensional FFTs of one plane, over all resolutions.
        outcome_code: `Outcome` as a number.
        strength: Variance of the turbulence over that of 0.6" seeing, as given or as measured.
        error_bars: Error of every mode; None where the method tells none.
        wrong_turn: Probability that a segment of the pupil is whole wavelengths off; None where nothing tells.
        log_amplitude: Logarithm of the light's amplitude at the pupil over that of the telescope, on the frames'
            pixels, zero mean over the light; None where the amplitude is taken as known.
    """

    opd_m: Float[Array, "*frame y x"]
    predicted_error_m: Float[Array, "*frame"]
    unexplained: Float[Array, "*frame"]
    residual: Float[Array, "*frame plane y x"]
    iterations: Int[Array, "*frame"]
    ffts: Int[Array, "*frame"]
    outcome_code: Int[Array, "*frame"]
    strength: Float[Array, "*frame"]
    error_bars: ErrorBars | None = None
    wrong_turn: Float[Array, "*frame"] | None = None
    log_amplitude: Float[Array, "*frame y x"] | None = None

    @property
    def outcome(self) -> Outcome:
        """How the estimate of one frame ended."""
        return Outcome(int(self.outcome_code))
