"""Commands on their way to the mirror, and which of them the mirror holds during an exposure."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class DelayLine(eqx.Module):
    """The last commands, for a mirror that gets each of them some exposures late.

    A line describes one exposure; `push` leads to the next. A command that is pushed for an exposure is on the mirror
    from `latency_frames` after the start of that exposure on. A latency with a part of an exposure means that the
    mirror changes within exposures: `before_m` is on it first, for `share_before` of the time, then `after_m`.

    Attributes:
        commands_m: What was commanded, the newest first.
        latency_frames: Exposures, in addition to the one that a measurement takes.

    Examples:
        >>> line = DelayLine.build(1, latency_frames=0.4).push(jnp.array([5.0])).push(jnp.array([7.0]))
        >>> line.before_m.tolist(), line.after_m.tolist(), line.share_before, round(float(line.mean_m[0]), 5)
        ([5.0], [7.0], 0.4, 6.2)
    """

    commands_m: Float[Array, "held mode"]
    latency_frames: float = eqx.field(static=True)

    @classmethod
    def build(cls, modes: int, *, latency_frames: float = 0.0, dtype: str = "float32") -> "DelayLine":
        """The first exposure of a mirror that has always been flat."""
        return cls(jnp.zeros((int(latency_frames) + 2, modes), dtype), float(latency_frames))

    def push(self, command_m: Float[Array, " mode"]) -> "DelayLine":
        """The next exposure, with the command that was computed before it."""
        commands_m = jnp.concatenate([command_m[None].astype(self.commands_m.dtype), self.commands_m[:-1]])
        return DelayLine(commands_m, self.latency_frames)

    @property
    def newest_m(self) -> Float[Array, " mode"]:
        """The last command, whether or not it has reached the mirror."""
        return self.commands_m[0]

    @property
    def before_m(self) -> Float[Array, " mode"]:
        """On the mirror for the first `share_before` of the exposure."""
        return self.commands_m[-1]

    @property
    def after_m(self) -> Float[Array, " mode"]:
        """On the mirror for the rest of the exposure, and all of it when the latency is whole."""
        return self.commands_m[-2]

    @property
    def share_before(self) -> float:
        """Share of the exposure until the mirror changes."""
        return self.latency_frames % 1

    @property
    def mean_m(self) -> Float[Array, " mode"]:
        """Mean shape of the mirror over the exposure."""
        return self.share_before * self.before_m + (1 - self.share_before) * self.after_m
