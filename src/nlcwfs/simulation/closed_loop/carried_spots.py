"""Kalman's filter of the lenslets: the slopes of each exposure correct the air that the wind has carried on.

The same air, the same search for the wind and the same way ahead as for the curvature sensor (`loop_air`); slopes are
linear in the wavefront, so that one gain for a light and a spot does all (Kulcsar et al. 2006, Opt. Express 14, 7464).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from nlcwfs.estimation.moving_modes import Step, left_covariance, settled_covariance
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.wind import Wind
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.simulation.closed_loop.lenslets import SETTLED, FollowedSpots, SpotsState
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure


class SettledGain(NamedTuple):
    """What a filter does with its news once it has settled, and what it expects of itself.

    Attributes:
        gain: Metres of each mode for each radian that a slope is more than expected.
        left_m2: Covariance of what is left after an exposure.
    """

    gain: Float[np.ndarray, "mode slope"]
    left_m2: Float[np.ndarray, "mode mode"]


def settled_gain(
    step: Step,
    interaction: Float[np.ndarray, "slope mode"],
    *,
    noise_rad2: Float[np.ndarray, " slope"],
    finer_rad2: Float[np.ndarray, "slope slope"],
) -> SettledGain:
    r"""The gain of Kalman's filter after many exposures, :math:`(P^{-1} + G^T N^{-1} G)^{-1} G^T N^{-1}`.

    Args:
        step: Of the modes from exposure to exposure, in metres.
        interaction: Slopes of each mode, G.
        noise_rad2: Variance of each slope from photon and read noise.
        finer_rad2: Covariance of the slopes of what is finer than the modes; both together are N.

    Examples:
        One mode that is all new in every exposure, of variance 3; one slope with the noise 1.

        >>> new = Step(np.zeros((1, 1)), np.array([[3.0]]))
        >>> found = settled_gain(new, np.eye(1), noise_rad2=np.ones(1), finer_rad2=np.zeros((1, 1)))
        >>> found.gain.round(6).tolist(), found.left_m2.round(6).tolist()
        ([[0.75]], [[0.75]])
    """
    noise = scipy.linalg.cho_factor(finer_rad2 + np.diag(noise_rad2), lower=True)
    weighted = scipy.linalg.cho_solve(noise, interaction).T
    information = weighted @ interaction
    information = (information + information.T) / 2
    left_m2 = left_covariance(settled_covariance(step, information), information)
    return SettledGain(left_m2 @ weighted, left_m2)


class SpotsAir:
    """What lenslets see of the air that the wind carries, in double precision.

    Attributes:
        step: From exposure to exposure, in metres.
        interaction: Slopes of each mode of the air, in radians per metre.
        finer_rad2: Covariance of the slopes of what is finer than the modes.
        wind: As it was found.
    """

    def __init__(
        self,
        step: Step,
        interaction: Float[np.ndarray, "slope mode"],
        finer_rad2: Float[np.ndarray, "slope slope"],
        wind: Wind,
    ) -> None:
        self.step, self.interaction, self.finer_rad2, self.wind = step, interaction, finer_rad2, wind

    def gain(self, noise_rad2: Float[np.ndarray, " slope"]) -> SettledGain:
        """What the filter does with slopes of this noise."""
        return settled_gain(self.step, self.interaction, noise_rad2=noise_rad2, finer_rad2=self.finer_rad2)


class CarriedSpotsState(NamedTuple):
    """Memory of a loop with lenslets whose air is carried.

    Attributes:
        modes_m: The air of the last exposure.
        spot: Running mean of what a spot looks like.
        gain: Metres of each mode for each radian that a slope is more than expected.
        predicted_m: Error that the filter expects of itself.
        frames: Exposures with light since its wind was found.
    """

    modes_m: Float[Array, " mode"]
    spot: Float[Array, "1 v u"]
    gain: Float[Array, "mode slope"]
    predicted_m: float
    frames: int


class CarriedSpots(eqx.Module):
    """The Shack-Hartmann sensor with Kalman's filter.

    Until the loop has settled it is followed as before. The gain belongs to the spots and the light of a moment; it is
    made when the filter takes over and once more when the spots are as they stay, and lives in the memory.

    Attributes:
        followed: Measures the slopes.
        air: From which gains are made.
        again: What is seen again of the modes after an exposure.
        interaction: Slopes of each mode of the air, in radians per metre.
        pushed: Slopes of each command of the mirror.
        shapes: Modes of each command.
        seen: Commands that make the mirror the air of an exposure.
        ahead: ... of the exposure in which the next command acts.
        mirror: Whose commands they are.
    """

    followed: FollowedSpots
    air: SpotsAir = eqx.field(static=True)
    again: Float[Array, "mode mode"]
    interaction: Float[Array, "slope mode"]
    pushed: Float[Array, "slope command"]
    shapes: Float[Array, "mode command"]
    seen: Float[Array, "command mode"]
    ahead: Float[Array, "command mode"]
    mirror: Mirror

    @property
    def wind(self) -> Wind:
        """As it was found."""
        return self.air.wind

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "spot v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: SpotsState | CarriedSpotsState | None,
    ) -> tuple[Sight, SpotsState | CarriedSpotsState | None]:
        """What an exposure shows; see `LoopSensor`."""
        electrons = exposure.frames.electrons
        total = self.followed.total(electrons)
        if isinstance(memory, SpotsState) and memory.frames >= SETTLED and total > 0:
            modes_m = self.shapes @ self.mirror.fitted(mirror_m)  # which is where the air was an exposure ago
            empty = jnp.zeros((0, 0), modes_m.dtype)
            memory = self._made(CarriedSpotsState(modes_m, memory.spot, empty, 0.0, 0), total)
        if not isinstance(memory, CarriedSpotsState):
            return self.followed.measure(exposure, usable, mirror_m, memory)
        if not total > 0:
            found, outcome, after = self.again @ memory.modes_m, Outcome.NO_LIGHT, memory
        else:
            found, spot = self._carried(electrons, usable, mirror_m, memory[:3], jnp.asarray(total, memory.spot.dtype))
            outcome, after = Outcome.CONVERGED, memory._replace(spot=spot, frames=memory.frames + 1)
        sight = self._sight(found, mirror_m, outcome, memory.predicted_m)
        after = after._replace(modes_m=found)
        return sight, self._made(after, total) if outcome.succeeded and after.frames == SETTLED else after

    def skip(self, memory: Any) -> tuple[Float[Array, " command"] | None, Any]:
        """The wind goes on without an exposure; see `LoopSensor`."""
        if not isinstance(memory, CarriedSpotsState):
            return self.followed.skip(memory)
        modes_m = self.again @ memory.modes_m
        return self.ahead @ modes_m, memory._replace(modes_m=modes_m)

    def _made(self, state: CarriedSpotsState, total: float) -> CarriedSpotsState:
        """The same with a gain for the spots and the light as they are."""
        made = self.air.gain(self.followed.noise_rad2(state.spot, total))
        predicted_m = float(np.sqrt(np.trace(made.left_m2)))
        return state._replace(gain=jnp.asarray(made.gain, self.again.dtype), predicted_m=predicted_m)

    @eqx.filter_jit
    def _carried(
        self,
        electrons: Float[Array, "spot v u"],
        usable: Bool[Array, "spot v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        known: tuple[Float[Array, " mode"], Float[Array, "1 v u"], Float[Array, "mode slope"]],
        total: Float[Array, ""],
    ) -> tuple[Float[Array, " mode"], Float[Array, "1 v u"]]:
        """The air of an exposure, and the mean spot with this exposure in it."""
        modes_m, spot, gain = known
        slopes, seen = self.followed.slopes(electrons, usable, spot, total)
        expected_m = self.again @ modes_m
        expected_rad = self.interaction @ expected_m - self.pushed @ self.mirror.fitted(mirror_m)
        news = (slopes.slope - expected_rad.reshape(-1, 2)) * slopes.weight[:, None]
        kept = self.followed.settings.memory
        return expected_m + gain @ news.ravel(), kept * spot + (1 - kept) * seen

    def _sight(
        self, modes_m: Float[Array, " mode"], mirror_m: Float[Array, "lit_y lit_x"], outcome: Outcome, left_m: float
    ) -> Sight:
        residual_m = self.seen @ modes_m - self.mirror.fitted(mirror_m)
        return Sight(residual_m, outcome, left_m, 0, True, self.ahead @ modes_m)
