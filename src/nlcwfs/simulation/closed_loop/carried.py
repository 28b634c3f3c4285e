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

from nlcwfs.estimation.flow_filter import Flow, FlowFilter
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.tilt import mean_slope, tilt_phase
from nlcwfs.estimation.wave_sensitivity import LAGS
from nlcwfs.estimation.wind import Wind
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.simulation.closed_loop.measurement import DOUBTS, SURE, FollowedCurvature, FollowedState
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure

SURPRISING = 2.0
"""An exposure is not believed whose news are so many times the usual: a bump of 300 nm brings three times as much, a
calm loop varies by a tenth."""

CALM_FRAMES = 20
"""Exposures over which the usual is averaged."""

REST_FRAMES = 50
"""Exposures that are followed without wind after the filter was lost, each time twice as many."""


class CarriedState(NamedTuple):
    """Memory of a loop whose air is carried.

    Attributes:
        followed: What a loop without wind remembers.
        flow: The air of the last exposure; None while it is not carried.
        calm: Usual surprise.
        doubts: Exposures in a row that were not believed.
        since: Exposures since the last second look.
        rest: Exposures until the air is carried again ...
        pause: ... and how many it will be the next time.
    """

    followed: FollowedState | None
    flow: Flow | None = None
    calm: float = 1.0
    doubts: int = 0
    since: int = 0
    rest: int = 0
    pause: int = REST_FRAMES


class CarriedCurvature(eqx.Module):
    """The curvature sensor with Kalman's filter.

    Attributes:
        followed: Captures the wavefront, and knows the mirror's shape on the cells of the model.
        filter: The filter.
        seen: Commands that make the mirror the air of an exposure.
        ahead: ... of the exposure in which the next command acts.
        mirror: Whose commands they are.
        wind: As it was found.
        strength: Variance of the turbulence over that which its prior has.
        starts_closed: Whether the mirror has the shape of the air before the first exposure.
    """

    followed: FollowedCurvature
    filter: FlowFilter
    seen: Float[Array, "command mode"]
    ahead: Float[Array, "command mode"]
    mirror: Mirror
    wind: Wind = eqx.field(static=True)
    strength: float = eqx.field(static=True)
    starts_closed: bool = eqx.field(static=True)

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "plane y x"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: FollowedState | CarriedState | None,
    ) -> tuple[Sight, CarriedState]:
        """What an exposure shows; see `LoopSensor`."""
        state = memory if isinstance(memory, CarriedState) else self._begun(CarriedState(memory))
        if memory is None and self.starts_closed:
            state = state._replace(flow=self._flow_of_mirror(mirror_m))
        if state.flow is not None:
            return self._carried(exposure.frames.electrons, usable, mirror_m, state, state.flow)
        sight, followed = self.followed.measure(exposure, usable, mirror_m, state.followed)
        return sight, self._begun(state._replace(followed=followed, rest=max(0, state.rest - 1)))

    def skip(self, memory: Any) -> tuple[Float[Array, " command"] | None, Any]:
        """The wind goes on without an exposure; see `LoopSensor`."""
        if not isinstance(memory, CarriedState):
            return self.followed.skip(memory)
        if memory.flow is None:
            command_m, followed = self.followed.skip(memory.followed)
            return command_m, memory._replace(followed=followed)
        flow = self.filter.skip(memory.flow)
        return self._command_m(flow), memory._replace(flow=flow)

    def _begun(self, state: CarriedState) -> CarriedState:
        """The air is carried from what is followed, if that is sure."""
        followed = state.followed
        if state.rest or followed is None or followed.memory is None or followed.sure < SURE:
            return state
        return state._replace(flow=self._flow_of(followed.memory), calm=1.0, doubts=0, since=followed.since)

    def _carried(
        self, counts: Array, usable: Array, mirror_m: Array, state: CarriedState, before: Flow
    ) -> tuple[Sight, CarriedState]:
        """An exposure of air that is carried."""
        flow, code, surprise = self._followed(counts, usable, mirror_m, before, jnp.asarray(state.calm))
        outcome, ffts, every = Outcome(int(code)), self.filter.ffts, self.followed.look_again_every
        doubts, since, calm = state.doubts, state.since + 1, state.calm
        if outcome is Outcome.NOT_EXPLAINED:
            doubts += 1  # not in the dark, where the wind goes on
        elif outcome.succeeded:
            doubts, calm = 0, calm + (float(surprise) - calm) / CALM_FRAMES
            if every and since >= every:
                flow, more = self._looked_again(counts, usable, mirror_m, flow)
                ffts, since = ffts + more, 0
        command_m = self._command_m(flow)
        residual_m = self.seen @ flow.whole_rad * self._radian_m - self.mirror.fitted(mirror_m)
        sight = Sight(residual_m, outcome, self.filter.left_rad * self._radian_m, ffts, True, command_m)
        if doubts >= DOUBTS:
            return sight, CarriedState(None, rest=state.pause, pause=2 * state.pause)
        return sight, state._replace(flow=flow, calm=calm, doubts=doubts, since=since)

    @property
    def _radian_m(self) -> float:
        return self.filter.solver.geometry.wavelength_m / (2 * np.pi)

    @eqx.filter_jit
    def _followed(
        self, counts: Array, usable: Array, mirror_m: Array, before: Flow, calm: Float[Array, ""]
    ) -> tuple[Flow, Int[Array, ""], Float[Array, ""]]:
        """The air of an exposure, how it ended, and its surprise."""
        known_rad = self.followed.reconstructor.phase_of(-self.followed.on_model(mirror_m))
        noise = self.followed.read_variance
        flow, surprise = self.filter.follow(counts, usable, before, read_variance=noise, known_rad=known_rad)
        code = jnp.where(surprise < SURPRISING * calm, Outcome.BUDGET_SPENT, Outcome.NOT_EXPLAINED)
        dark = jnp.any(jnp.sum(jnp.where(usable, counts, 0), axis=(1, 2)) <= 0)
        code = jnp.where(dark, Outcome.NO_LIGHT, code)
        finite = jnp.all(jnp.isfinite(flow.moving_rad))
        code = jnp.where(finite, code, Outcome.NOT_FINITE).astype(jnp.int32)
        gone: Flow = self.filter.skip(before)
        kept = Flow(*(jnp.where(dark | ~finite, old, new) for old, new in zip(gone, flow, strict=True)))
        return kept, code, surprise

    @eqx.filter_jit
    def _command_m(self, flow: Flow) -> Float[Array, " command"]:
        """The air of the exposure in which the next command acts."""
        still = self.seen[:, : flow.still_rad.size] @ flow.still_rad
        return (self.ahead @ flow.moving_rad + still) * self._radian_m

    def _looked_again(self, counts: Array, usable: Array, mirror_m: Array, flow: Flow) -> tuple[Flow, int]:
        """The air without the islands that a second look brings back, and its FFTs."""
        known_m, noise = -self.followed.on_model(mirror_m), self.followed.read_variance
        memory = self._memory_of(flow)
        looked = self.followed.second.look(counts, usable, memory, read_variance=noise, known_m=known_m)
        if looked.turned:
            flow = flow._replace(moving_rad=flow.moving_rad + self.filter.modes_of(looked.change_rad))
        return flow, looked.ffts

    @eqx.filter_jit
    def _memory_of(self, flow: Flow) -> Memory:
        """The air as waves and a tilt, as a second look wants it."""
        solver, phase_rad = self.filter.solver, self.filter.phase_rad(flow.whole_rad)
        slope = mean_slope(phase_rad, solver.level.light, solver.level.grid) * self._radian_m
        one, planes = jnp.ones((), phase_rad.dtype), jnp.ones((len(solver.geometry.distances_m), 1, 1))
        return Memory(
            phase_rad=phase_rad - tilt_phase(slope, solver.level.grid, solver.geometry.wavelength_m),
            slope=slope,
            left_open=jnp.zeros_like(solver.power),
            tilt_left_rad=0 * one,
            strength=self.strength * one,
            scale=PlaneScale(planes, 0 * planes),
            surprise_rad2=jnp.zeros(len(LAGS), phase_rad.dtype),
        )

    @eqx.filter_jit
    def _flow_of_mirror(self, mirror_m: Float[Array, "lit_y lit_x"]) -> Flow:
        """The air that a mirror corrects."""
        return self.filter.begun(self.followed.reconstructor.phase_of(self.followed.on_model(mirror_m)))

    @eqx.filter_jit
    def _flow_of(self, memory: Memory) -> Flow:
        """The air of waves and a tilt."""
        solver = self.filter.solver
        tilt_rad = tilt_phase(memory.slope, solver.level.grid, solver.geometry.wavelength_m)
        return self.filter.begun(memory.phase_rad + tilt_rad)
