"""The curvature sensor's wavefronts filtered by Kalman: the wind carries what is known, and its way ahead is known.

Until the wind has been found a loop follows its frames as if no direction were likelier (`FollowedCurvature`). Then
the state is the air in the modes of the pupil (`FlowFilter`), and the mirror gets the air that its next command meets:
linear-quadratic-Gaussian control for a mirror without dynamics (Kulcsar et al. 2006, Opt. Express 14, 7464).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation.flow_filter import FlowFilter
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.tilt import mean_slope, tilt_phase
from nlcwfs.estimation.wind import Wind
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.simulation.exposure import Exposure
from nlcwfs.simulation.loop_measurement import DOUBTS, SURE, FollowedCurvature, FollowedState
from nlcwfs.simulation.loop_sight import Sight

SURPRISING = 4.0
"""An exposure whose news are so many times what is expected is not believed."""


class CarriedState(NamedTuple):
    """Memory of a loop whose air is carried.

    Attributes:
        modes_rad: The air of the last exposure.
        last: What was remembered when its wind was found; a second look needs it.
        doubts: Frames in a row that were not explained.
        since: Frames since the last second look.
    """

    modes_rad: Float[Array, " mode"]
    last: Memory
    doubts: int
    since: int


class CarriedCurvature(eqx.Module):
    """The curvature sensor with Kalman's filter.

    Attributes:
        followed: Captures the wavefront, and knows the mirror's shape on the cells of the model.
        flow: The filter.
        seen: Commands that make the mirror the air of an exposure.
        ahead: ... of the exposure in which the next command acts.
        mirror: Whose commands they are.
        wind: As it was found.
    """

    followed: FollowedCurvature
    flow: FlowFilter
    seen: Float[Array, "command mode"]
    ahead: Float[Array, "command mode"]
    mirror: Mirror
    wind: Wind = eqx.field(static=True)

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "plane y x"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: FollowedState | CarriedState | None,
    ) -> tuple[Sight, FollowedState | CarriedState]:
        """What an exposure shows; see `LoopSensor`."""
        if isinstance(memory, FollowedState) and memory.memory is not None and memory.sure >= SURE:
            memory = CarriedState(self._modes_of(memory.memory), memory.memory, 0, memory.since)
        if not isinstance(memory, CarriedState):
            return self.followed.measure(exposure, usable, mirror_m, memory)
        counts = exposure.frames.electrons
        found, code = self._carried(counts, usable, mirror_m, memory.modes_rad)
        outcome, ffts = Outcome(int(code)), self.flow.ffts
        doubts, since = 0 if outcome.succeeded else memory.doubts + 1, memory.since + 1
        if outcome in (Outcome.NO_LIGHT, Outcome.NOT_FINITE):
            found = self.flow.again @ memory.modes_rad
        elif outcome.succeeded and self.followed.look_again_every and since >= self.followed.look_again_every:
            found, more = self._looked_again(counts, usable, mirror_m, found, memory.last)
            ffts, since = ffts + more, 0
        sight = self._sight(found, mirror_m, outcome, ffts)
        if doubts >= DOUBTS:
            return sight, FollowedState(None, 0, 0, 0)
        return sight, CarriedState(found, memory.last, doubts, since)

    def skip(self, memory: Any) -> tuple[Float[Array, " command"] | None, Any]:
        """The wind goes on without an exposure; see `LoopSensor`."""
        if not isinstance(memory, CarriedState):
            return self.followed.skip(memory)
        modes_rad = self.flow.again @ memory.modes_rad
        return self.ahead @ modes_rad * self._radian_m, memory._replace(modes_rad=modes_rad)

    @property
    def _radian_m(self) -> float:
        return self.flow.solver.geometry.wavelength_m / (2 * np.pi)

    @eqx.filter_jit
    def _carried(
        self, counts: Array, usable: Array, mirror_m: Array, modes_rad: Array
    ) -> tuple[Float[Array, " mode"], Int[Array, ""]]:
        """The air of an exposure, and how it ended."""
        flow, noise = self.flow, self.followed.read_variance
        known_rad = self.followed.reconstructor.phase_of(-self.followed.on_model(mirror_m))
        found = flow.follow(counts, usable, modes_rad, read_variance=noise, known_rad=known_rad)
            jax.debug.print("surprise {}", found.surprise)
        code = jnp.where(found.surprise < SURPRISING, Outcome.BUDGET_SPENT, Outcome.NOT_EXPLAINED)
        dark = jnp.any(jnp.sum(jnp.where(usable, counts, 0), axis=(1, 2)) <= 0)
        code = jnp.where(dark, Outcome.NO_LIGHT, code)
        code = jnp.where(jnp.all(jnp.isfinite(found.modes_rad)), code, Outcome.NOT_FINITE)
        return found.modes_rad, code.astype(jnp.int32)

    def _looked_again(
        self, counts: Array, usable: Array, mirror_m: Array, modes_rad: Array, last: Memory
    ) -> tuple[Float[Array, " mode"], int]:
        """The modes without the islands that a second look brings back, and its FFTs."""
        followed = self.followed
        known_m, noise = -followed.on_model(mirror_m), followed.read_variance
        memory = self._memory_of(modes_rad, last)
        looked = followed.second.look(counts, usable, memory, read_variance=noise, known_m=known_m)
        if looked.turned:
            modes_rad = modes_rad + self.flow.modes_of(looked.change_rad)
        return modes_rad, looked.ffts

    @eqx.filter_jit
    def _memory_of(self, modes_rad: Array, last: Memory) -> Memory:
        """The modes as waves and a tilt."""
        solver, phase_rad = self.flow.solver, self.flow.phase_rad(modes_rad)
        slope = mean_slope(phase_rad, solver.level.light, solver.level.grid) * self._radian_m
        rest_rad = phase_rad - tilt_phase(slope, solver.level.grid, solver.geometry.wavelength_m)
        return eqx.tree_at(lambda one: (one.phase_rad, one.slope), last, (rest_rad, slope))

    def _modes_of(self, memory: Memory) -> Float[Array, " mode"]:
        """The modes of waves and a tilt."""
        solver = self.flow.solver
        tilt_rad = tilt_phase(memory.slope, solver.level.grid, solver.geometry.wavelength_m)
        return self.flow.modes_of(memory.phase_rad + tilt_rad)

    def _sight(
        self, modes_rad: Float[Array, " mode"], mirror_m: Float[Array, "lit_y lit_x"], outcome: Outcome, ffts: int
    ) -> Sight:
        residual_m = self.seen @ modes_rad * self._radian_m - self.mirror.fitted(mirror_m)
        command_m = self.ahead @ modes_rad * self._radian_m
        return Sight(residual_m, outcome, self.flow.left_rad * self._radian_m, ffts, True, command_m)
