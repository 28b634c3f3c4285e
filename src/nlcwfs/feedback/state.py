"""What a controller carries from exposure to exposure, the same for every controller."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nlcwfs.feedback.delay_line import DelayLine


class FeedbackState(eqx.Module):
    """The mirror, and what is remembered of the air.

    Attributes:
        line: The mirror during the exposure whose measurement comes next.
        seen_m: Air as measured in the last exposures, the newest first; an integrator remembers none.
        frames: How many of these exposures there have been.
    """

    line: DelayLine
    seen_m: Float[Array, "tap mode"]
    frames: Int[Array, ""]

    @classmethod
    def flat(
        cls, modes: int, *, latency_frames: float = 0.0, remembered: int = 0, dtype: str = "float32"
    ) -> "FeedbackState":
        """A flat mirror, and nothing seen."""
        line = DelayLine.build(modes, latency_frames=latency_frames, dtype=dtype)
        return cls(line, jnp.zeros((remembered, modes), dtype), jnp.zeros((), jnp.int32))

    def push(self, command_m: Float[Array, " mode"]) -> "FeedbackState":
        """The next exposure, with nothing else remembered."""
        return FeedbackState(self.line.push(command_m), self.seen_m, self.frames)

    def see(self, open_loop_m: Float[Array, " mode"]) -> "FeedbackState":
        """The air of this exposure is remembered."""
        seen_m = jnp.concatenate([open_loop_m[None], self.seen_m[:-1]])
        return FeedbackState(self.line, seen_m, jnp.minimum(self.frames + 1, len(self.seen_m)))
