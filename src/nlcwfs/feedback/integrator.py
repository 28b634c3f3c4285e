"""The integrator: each command is the last one, and a share of the error that was measured."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.delay_line import DelayLine
from nlcwfs.feedback.loop_transfer import IntegratorLoop
from nlcwfs.feedback.state import FeedbackState


def largest_stable_gain(latency_frames: float, *, leak: float = 1.0, pseudo_open_loop: bool = False) -> float:
    """The gain below which an integrator forgets a bump, see `IntegratorLoop`.

    Examples:
        >>> [round(largest_stable_gain(frames), 3) for frames in (0.0, 0.4, 1.0, 2.0)]
        [2.0, 2.5, 1.0, 0.618]
    """
    return IntegratorLoop(latency_frames, leak, pseudo_open_loop).largest_stable_gain()


class Integrator(eqx.Module):
    r"""Leaky integrator with a gain for each mode, :math:`u_{n+1} = l\,u_n + g\,e_n`.

    The error :math:`e_n` is what was measured, :math:`r_n`; or, with `pseudo_open_loop`, that plus the mirror's known
    mean shape less the last command, :math:`r_n + c_n - u_n`. Without latency these are the same. With latency the
    second is Smith's (1957) predictor: commands on their way are not ordered again, and a gain of 1 leads to the air in
    one step.

    Attributes:
        gain: Of each mode.
        loop: Delay, leak and the kind of error.

    Examples:
        >>> controller = Integrator.build(np.array([0.5]), loop=IntegratorLoop())
        >>> state, command_m = controller.step(controller.init(), jnp.array([8.0]))
        >>> state, command_m = controller.step(state, 8.0 - state.line.mean_m)  # the air stands still
        >>> command_m.tolist()
        [6.0]
    """

    gain: Float[Array, " mode"]
    loop: IntegratorLoop = eqx.field(static=True)

    @classmethod
    def build(cls, gain: Float[np.ndarray, " mode"], *, loop: IntegratorLoop, dtype: str = "float32") -> "Integrator":
        """Check that the loop is stable.

        Args:
            gain: Of each mode.
            loop: Delay, leak and the kind of error.
            dtype: Precision of the commands.

        Raises:
            SettingsError: If the largest gain is not below what the latency bears.
        """
        largest, most = loop.largest_stable_gain(), float(np.max(gain))
        if not most < largest:
            mend = "" if loop.pseudo_open_loop else " without feedback.pseudo_open_loop"
            rule = f"must be below {largest:.4g} for a latency of {loop.latency_frames:g} frames{mend}"
            raise SettingsError("feedback.gain", rule, f"{most:g}")
        return cls(jnp.asarray(gain, dtype), loop)

    def init(self) -> FeedbackState:
        """A flat mirror."""
        latency_frames, dtype = self.loop.latency_frames, str(self.gain.dtype)
        return FeedbackState.flat(self.gain.size, latency_frames=latency_frames, dtype=dtype)

    def command(self, line: DelayLine, measured_m: Float[Array, " mode"]) -> Float[Array, " mode"]:
        """The next command."""
        error_m = measured_m + line.mean_m - line.newest_m if self.loop.pseudo_open_loop else measured_m
        return self.loop.leak * line.newest_m + self.gain * error_m

    def step(
        self, state: FeedbackState, measured_m: Float[Array, " mode"]
    ) -> tuple[FeedbackState, Float[Array, " mode"]]:
        """From the measurement of an exposure to the next command, which is already on its way in the state."""
        command_m = self.command(state.line, measured_m.astype(self.gain.dtype))
        return state.push(command_m), command_m

    def skip(self, state: FeedbackState) -> tuple[FeedbackState, Float[Array, " mode"]]:
        """An exposure that measured nothing: the last command stays, less its leak."""
        command_m = self.loop.leak * state.line.newest_m
        return state.push(command_m), command_m
