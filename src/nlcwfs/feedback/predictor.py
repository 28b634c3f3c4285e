r"""Predictive control: each mode is predicted from its own last measurements, to the exposure that is corrected.

The air of a mode is taken as an autoregressive process seen in noise. The taps that predict it best from noisy
measurements are Wiener's, and least squares on telemetry finds them without a model of either: the noise of what is
predicted is not in what predicts. The mirror's shape is added to what it left, so that the loop that is open or closed
teaches the same (pseudo-open-loop; Dessenne, Madec & Rousset 1998, Appl. Opt. 37, 4623).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.integrator import Integrator
from nlcwfs.feedback.state import FeedbackState

RIDGE = 1e-7
"""Variance of white noise that is added to what predicts, over the variance of the mode: keeps taps of smooth air
small. It is 0.03 % of a mode's rms."""

FRAMES_PER_TAP = 4
"""With fewer, the taps learn the noise: the residual grows by the inverse of it."""


def prediction_taps(
    open_loop_m: Float[np.ndarray, "frame mode"], *, order: int, latency_frames: float = 0.0, forgetting: float = 1.0
) -> Float[np.ndarray, "tap mode"]:
    r"""Weights of the last measurements, the newest first, that predict the exposure at which their command acts.

    Least squares of :math:`(1 - s)\,y_{n+1+d} + s\,y_{n+2+d} \approx \sum_k w_k y_{n-k}` for a latency of d + s frames.
    The mean is not taken out: what stands still is predicted too.

    Args:
        open_loop_m: Measured open loop of each mode.
        order: Number of taps.
        latency_frames: See `DelayLine`; the horizon is one exposure more.
        forgetting: Weight of a frame over that of the next.

    Raises:
        SettingsError: If there are too few frames.

    Examples:
        >>> import math
        >>> turn = np.exp(0.1j * np.arange(200)).real[:, None]  # a vibration
        >>> taps = prediction_taps(turn, order=2)
        >>> taps[:, 0].round(3).tolist(), round(2 * math.cos(0.1), 3)
        ([1.99, -1.0], 1.99)
    """
    series = np.asarray(open_loop_m, float)
    whole, part = divmod(latency_frames, 1)
    horizon = 1 + int(whole)
    count = len(series) - (order - 1) - horizon - (part > 0)
    if count < FRAMES_PER_TAP * order:
        least = FRAMES_PER_TAP * order + len(series) - count
        raise SettingsError("open_loop_m", f"must be at least {least} frames for {order} taps", len(series))
    start = order - 1 + horizon
    target = series[start : start + count]
    if part > 0:
        target = (1 - part) * target + part * series[start + 1 : start + 1 + count]
    past = [series[order - 1 - tap : order - 1 - tap + count] for tap in range(order)]
    weight = forgetting ** np.arange(count - 1.0, -1, -1)
    normal = np.empty((series.shape[1], order, order))
    wanted = np.empty((series.shape[1], order))
    for row in range(order):
        weighted = weight[:, None] * past[row]
        wanted[:, row] = np.einsum("fm,fm->m", weighted, target)
        for column in range(row, order):
            normal[:, row, column] = normal[:, column, row] = np.einsum("fm,fm->m", weighted, past[column])
    power = np.trace(normal, axis1=1, axis2=2) / order
    # A mode that never moved is predicted not to.
    normal += np.where(power > 0, RIDGE * power, 1.0)[:, None, None] * np.eye(order)
    return np.linalg.solve(normal, wanted[..., None])[..., 0].T


class Predictor(eqx.Module):
    """Commands the shape that the air is predicted to have; an integrator until it has taps and has seen enough.

    Attributes:
        fallback: The integrator.
        order: Number of taps.
        taps: Weights of the last measurements, the newest first; none before it has learnt.
    """

    fallback: Integrator
    order: int = eqx.field(static=True)
    taps: Float[Array, "tap mode"] | None = None

    def learn(self, open_loop_m: Float[np.ndarray, "frame mode"], *, forgetting: float = 1.0) -> "Predictor":
        """The same, with taps; its state goes on as it is.

        Raises:
            SettingsError: If there are too few frames.
        """
        latency_frames = self.fallback.loop.latency_frames
        taps = prediction_taps(open_loop_m, order=self.order, latency_frames=latency_frames, forgetting=forgetting)
        return Predictor(self.fallback, self.order, jnp.asarray(taps, self.fallback.gain.dtype))

    def init(self) -> FeedbackState:
        """A flat mirror, and nothing seen."""
        gain, latency_frames = self.fallback.gain, self.fallback.loop.latency_frames
        return FeedbackState.flat(
            gain.size, latency_frames=latency_frames, remembered=self.order, dtype=str(gain.dtype)
        )

    def step(
        self, state: FeedbackState, measured_m: Float[Array, " mode"]
    ) -> tuple[FeedbackState, Float[Array, " mode"]]:
        """From the measurement of an exposure to the next command, which is already on its way in the state."""
        measured_m = measured_m.astype(self.fallback.gain.dtype)
        state = state.see(measured_m + state.line.mean_m)
        command_m = self.fallback.command(state.line, measured_m)
        if self.taps is not None:
            predicted_m = jnp.sum(self.taps * state.seen_m, axis=0)
            command_m = jnp.where(state.frames >= self.order, predicted_m, command_m)
        return state.push(command_m), command_m

    def skip(self, state: FeedbackState) -> tuple[FeedbackState, Float[Array, " mode"]]:
        """An exposure that measured nothing: the air is taken to have been what the mirror expected."""
        return self.step(state, jnp.zeros_like(state.seen_m[0]))
