"""The linear regime of a loop: one matrix product a frame while it holds, another estimator while it does not.

Guyon (2010), sec. 5.3. What captures the wavefront is the curvature sensor's most likely wavefront, or, for the linear
curvature sensor, a matrix made for the open loop. As soon as it has closed and the linear model explains the light for
some frames in a row, the matrix of the closed loop takes over; it hands back when it does not.
"""

import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nlcwfs.estimation.image_matrix import ImageMatrix
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure

SURE = 5
"""Frames in a row that the linear model must explain before it takes over."""

DOUBTS = 2
"""Frames in a row that it does not explain before it hands back."""

HALVED = 0.5
"""While an open loop closes, what is left to correct falls at least so far, in square, within `STEADY` frames."""

LOST = 2.0
"""The last matrix is given up for the first when more is left to correct than so many times what it is made for."""

STEADY = 2
"""Frames in a row without such a fall after which a loop with matrices alone counts as closed."""


@runtime_checkable
class Capture(Protocol):
    """What works while the linear model does not hold; see `LoopSensor`."""

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "image v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: Any,
    ) -> tuple[Sight, Any]:
        """See `LoopSensor`."""
        ...

    def skip(self, memory: Any) -> tuple[Float[Array, " mode"] | None, Any]:
        """See `LoopSensor`."""
        ...


class HandedState(NamedTuple):
    """Memory of a loop that hands over.

    Attributes:
        captured: Memory of what captures; None while the matrix works.
        linear: Whether the matrix works.
        good: Frames in a row that the linear model explained while the other worked.
        doubts: Frames in a row that it did not explain while it worked.
    """

    captured: Any
    linear: bool
    good: int
    doubts: int


class Look(NamedTuple):
    """What the matrix makes of an exposure.

    Attributes:
        residual_m: Of the mirror's modes.
        chi2: Of data less linear model, over what is expected.
        size_m: Rms of the driven modes.
        dark: Whether a plane has no light.
    """

    residual_m: Float[Array, " mode"]
    chi2: float
    size_m: float
    dark: bool


class MatrixLook(eqx.Module):
    """A matrix in a loop.

    Attributes:
        matrix: From images to driven modes.
        to_command: From driven modes to the mirror's.
        reference_m: Command that leaves the reference wavefront on the sensor.
    """

    matrix: ImageMatrix
    to_command: Float[Array, "mode driven"]
    reference_m: Float[Array, " mode"]

    def look(self, electrons: Float[Array, "plane v u"], usable: Bool[Array, "plane v u"]) -> Look:
        """What the matrix makes of an exposure."""
        residual_m, chi2, size_m, dark = self._looked(electrons, usable)
        return Look(residual_m, float(chi2), float(size_m), bool(dark))

    def holds(self, look: Look) -> bool:
        """Whether the linear model explains an exposure, and what it finds is within its range."""
        reach = self.matrix.range
        return reach.serves and not look.dark and look.chi2 < reach.limit_chi2 and look.size_m < reach.limit_m

    @eqx.filter_jit
    def _looked(self, electrons: Array, usable: Array) -> tuple[Array, Array, Array, Array]:
        modes_m = self.matrix.modes_m(electrons, usable)
        dark = jnp.any(jnp.sum(jnp.where(usable, electrons, 0), axis=(1, 2)) <= 0)
        residual_m = self.to_command @ modes_m + self.reference_m
        size_m = jnp.sqrt(jnp.sum(modes_m**2))
        return residual_m, self.matrix.chi2(electrons, usable, modes_m), size_m, dark


class HandedOver(eqx.Module):
    """A sensor that is linear where it may be.

    Attributes:
        capture: Works while the loop is open, or the linear model fails.
        linear: Works else.
    """

    capture: Capture
    linear: MatrixLook

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "plane v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: HandedState | None,
    ) -> tuple[Sight, HandedState]:
        """What an exposure shows; see `LoopSensor`."""
        state = memory or HandedState(None, False, 0, 0)
        look = self.linear.look(exposure.frames.electrons, usable)
        holds = self.linear.holds(look)
        if state.linear:
            if look.dark:
                return self._sight(look, Outcome.NO_LIGHT), state
            doubts = 0 if holds else state.doubts + 1
            if doubts < DOUBTS:
                outcome = Outcome.CONVERGED if holds else Outcome.NOT_EXPLAINED
                return self._sight(look, outcome), state._replace(doubts=doubts)
            state = HandedState(None, False, 0, 0)
        sight, captured = self.capture.measure(exposure, usable, mirror_m, state.captured)
        good = state.good + 1 if holds and sight.closed and sight.outcome.succeeded else 0
        if good >= SURE:
            return sight, HandedState(None, True, 0, 0)
        return sight, HandedState(captured, False, good, 0)

    def skip(self, memory: HandedState | None) -> tuple[Float[Array, " mode"] | None, HandedState | None]:
        """An exposure later; see `LoopSensor`."""
        if memory is None or memory.linear:
            return None, memory
        command_m, captured = self.capture.skip(memory.captured)
        return command_m, memory._replace(captured=captured)

    def _sight(self, look: Look, outcome: Outcome) -> Sight:
        predicted_m = self.linear.matrix.predicted_m
        return Sight(look.residual_m, outcome, predicted_m, 0, closed=True, linear=True)


class OpenState(NamedTuple):
    """Memory of a loop with matrices alone that is open.

    Attributes:
        least_m2: The least that was ever left to correct, in square.
        steady: Exposures in a row in which it was not halved.
        stage: Matrix in use.
    """

    least_m2: float
    steady: int
    stage: int


class OpenMatrix(eqx.Module):
    """Captures with matrices: for all of the turbulence, then for what that one leaves; believes all light.

    Attributes:
        stages: The matrices.
    """

    stages: tuple[MatrixLook, ...]

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "plane v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: OpenState | None,
    ) -> tuple[Sight, OpenState]:
        """What an exposure shows; see `LoopSensor`."""
        state = memory or OpenState(math.inf, 0, 0)
        stage = self.stages[state.stage]
        look = stage.look(exposure.frames.electrons, usable)
        if look.dark:
            return Sight(jnp.zeros_like(look.residual_m), Outcome.NO_LIGHT, math.nan, 0, False), state
        left_m2 = look.size_m**2
        steady = 0 if left_m2 < HALVED * state.least_m2 else state.steady + 1
        sight = Sight(look.residual_m, Outcome.CONVERGED, stage.matrix.predicted_m, 0, False)
        if steady < STEADY:
            return sight, OpenState(min(left_m2, state.least_m2), steady, state.stage)
        if state.stage + 1 < len(self.stages):
            return sight, OpenState(math.inf, 0, state.stage + 1)
        far = left_m2 > (LOST * stage.matrix.range.rms_m[0]) ** 2
        return sight._replace(closed=True), OpenState(math.inf, 0, 0) if far else state._replace(steady=steady)

    def skip(self, memory: OpenState | None) -> tuple[None, OpenState | None]:
        """Nothing changes; see `LoopSensor`."""
        return None, memory
