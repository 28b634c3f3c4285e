"""Frames of frozen air whose wind is known: Kalman's filter in the modes of the pupil, with a whole covariance.

What the wind carries on is known to a few nanometres, what came in over the rim is not: a covariance that is dense in
modes tells them apart, which one that is diagonal in waves (`sequence_reconstructor`) cannot. The light is not linear
in the phase, so each frame takes some Gauss-Newton steps from the prediction (an iterated, extended filter; Bell &
Cathey 1993, IEEE Trans. Autom. Control 38, 294). The covariance depends on the frames only through the information
that one has, and settles: it is made beforehand.

Not all that a telescope sees moves with the wind. A part of the phase that stays is a state of its own (Friedland 1969,
IEEE Trans. Autom. Control 14, 359); without it a bump that stays is taken for air, and never corrected.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.beam.modes import ModalBasis
from nlcwfs.beam.pupil import nearest_lit
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.modal_prior import ModalPrior
from nlcwfs.estimation.moving_modes import Step, left_covariance, settled_covariance
from nlcwfs.estimation.resolution_level import Level
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.sequence_memory import plane_counts

STEPS, INNER = 3, 8
"""Gauss-Newton steps of a frame and conjugate gradients of each."""

CHUNK = 20
"""Modes whose light is computed at a time."""


class Flow(NamedTuple):
    """What is known of the air's phase, mirror not included.

    Attributes:
        moving_rad: Modes of what the wind carries.
        still_rad: First modes of what stays.
    """

    moving_rad: Float[Array, " mode"]
    still_rad: Float[Array, " still"]

    @property
    def whole_rad(self) -> Float[Array, " mode"]:
        """Both."""
        return self.moving_rad.at[: self.still_rad.size].add(self.still_rad)


class Still(NamedTuple):
    """What is expected of the part of a phase that stays.

    Attributes:
        variance: Of each of the first modes, rad^2.
        kept: Share of it that a frame shows again, just below 1.
    """

    variance: Float[np.ndarray, " still"]
    kept: float


class FlowFilter(eqx.Module):
    """Follows the modes of air that the wind carries.

    Attributes:
        solver: The sensor.
        level: Its optics; the pupil a little darker, by what the uncertain part of the phase scatters.
        scattered: That light over all, which lies on the frames like a haze.
        again: From the modes of one frame to those of the next.
        kept: The same of what stays.
        to_still: What of a change belongs to what stays.
        prior: What is new, or was left open.
        modes: On the lit cells.
        weights: Light of these, sum 1.
        nearest: The lit cell, by number, whose phase each cell of the grid takes.
        left_rad: Rms error that is left of the modes.
    """

    solver: MaximumAPosteriori
    level: Level
    scattered: float = eqx.field(static=True)
    again: Float[Array, "mode mode"]
    kept: float = eqx.field(static=True)
    to_still: Float[Array, "still mode"]
    prior: ModalPrior
    modes: Float[Array, "cell mode"]
    weights: Float[Array, " cell"]
    nearest: Int[Array, "y x"]
    left_rad: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        solver: MaximumAPosteriori,
        basis: ModalBasis,
        step: Step,
        still: Still,
        information: Float[np.ndarray, "mode mode"],
        *,
        beyond_rad2: float,
    ) -> "FlowFilter":
        """Settle the covariance for one wind.

        Args:
            solver: The sensor.
            basis: Modes on the model's grid.
            step: Of one interval, rad.
            still: What does not move.
            information: That a frame has of the modes, 1/rad^2, see `modal_information`.
            beyond_rad2: Variance of the air beyond the modes.
        """
        level, dtype = solver.level, solver.power.dtype
        weights = np.asarray(basis.weights, float)
        lit = np.flatnonzero(weights > 0)
        modes = np.asarray(basis.modes, float).reshape(basis.count, -1)[:, lit].T
        predicted, to_still = settled_sum(step, still, information)
        open_rad2 = np.zeros(weights.size)
        open_rad2[lit] = np.einsum("ck,ck->c", modes @ predicted, modes) + beyond_rad2
        modulus = np.asarray(level.modulus, float) * np.exp(-open_rad2.reshape(level.grid.shape) / 2)
        scattered = 1 - np.sum(modulus**2) / np.sum(np.asarray(level.modulus, float) ** 2)
        return cls(
            solver=solver,
            level=eqx.tree_at(lambda one: one.modulus, level, jnp.asarray(modulus, dtype)),
            scattered=float(scattered),
            again=jnp.asarray(step.again, dtype),
            kept=still.kept,
            to_still=jnp.asarray(to_still, dtype),
            prior=ModalPrior.build(modes, predicted, information, lit, level.grid.shape, str(dtype)),
            modes=jnp.asarray(modes, dtype),
            weights=jnp.asarray(weights.ravel()[lit], dtype),
            nearest=jnp.asarray(nearest_lit(weights > 0)),
            left_rad=float(np.sqrt(np.trace(left_covariance(predicted, information)))),
        )

    @property
    def ffts(self) -> int:
        """FFTs of one plane for a frame."""
        through = self.level.optics.transfer.shape[1] + 1
        return STEPS * (2 * through + INNER * 2 * through)

    def begun(self, phase_rad: Float[Array, "y x"]) -> Flow:
        """A phase of which nothing is known to stay."""
        return Flow(self.modes_of(phase_rad), jnp.zeros(self.to_still.shape[0], self.modes.dtype))

    def skip(self, flow: Flow) -> Flow:
        """A frame later."""
        return Flow(self.again @ flow.moving_rad, self.kept * flow.still_rad)

    def phase_rad(self, modes_rad: Float[Array, " mode"]) -> Float[Array, "y x"]:
        """The phase on the model's grid; beyond the light it is that of the nearest lit cell."""
        return (self.modes @ modes_rad)[self.nearest]

    def modes_of(self, phase_rad: Float[Array, "y x"]) -> Float[Array, " mode"]:
        """The modes of a phase on the model's grid."""
        lit_rad = phase_rad.reshape(-1)[self.prior.lit].astype(self.modes.dtype)
        return (self.weights * lit_rad) @ self.modes

    def follow(
        self,
        counts: Float[Array, "plane y x"],
        usable: Bool[Array, "plane y x"],
        flow: Flow,
        *,
        read_variance: float | Float[Array, ""] = 0.0,
        known_rad: Float[Array, "Y X"] | None = None,
    ) -> tuple[Flow, Float[Array, ""]]:
        """The air behind the next frame.

        Args:
            counts: Photo-electrons on the frames' pixels, background subtracted.
            usable: False for pixels to ignore.
            flow: What the last frame showed.
            read_variance: Variance of a pixel without light, electrons squared.
            known_rad: Phase on the model's grid beside the air's: minus the shape of a mirror.

        Returns:
            What this one shows; and the surprise, the square of what is new over what is expected of it when the
            prediction is right: about 1 or less.
        """
        solver, level = self.solver, self.level
        measured = solver.capture.measurement(counts, usable, read_variance).padded(level.measured_shape)
        expected = self.skip(flow)
        total_rad = solver.known_rad(jnp.zeros(2, self.modes.dtype)) + self.phase_rad(expected.whole_rad)
        if known_rad is not None:
            total_rad = total_rad + known_rad
        total = plane_counts(measured)
        scale = PlaneScale(total, total * self.scattered / measured.counts[0].size)  # the haze of what is uncertain
        dimmed = eqx.tree_at(lambda s: s.level, solver, level)
        problem = dimmed.problem(measured, total_rad, scale, self.prior)
        unknown = self.prior.nothing()
        for _ in range(STEPS):
            direction, _ = gn.direction_of_step(problem, INNER, unknown)
            unknown = gn.plus(unknown, direction, 1.0)
        change_rad = self.prior.root @ unknown.waves
        still_rad = self.to_still @ change_rad
        moving_rad = (expected.moving_rad + change_rad).at[: still_rad.size].add(-still_rad)
        shown = jnp.sum(self.prior.seen / (1 + self.prior.seen))
        return Flow(moving_rad, expected.still_rad + still_rad), self.prior.dot(unknown, unknown) / shown


def settled_sum(
    step: Step, still: Still, information: Float[np.ndarray, "mode mode"]
) -> tuple[Float[np.ndarray, "mode mode"], Float[np.ndarray, "still mode"]]:
    r"""Covariance of the predicted sum of what moves and what stays, and the share of a change that stays.

    Light shows only the sum y = T z of the state z. With P the settled covariance of z, the sum has
    :math:`T P T^T`, and a change d of y is one of z by :math:`P T^T (T P T^T)^{-1} d`.

    Examples:
        >>> step, still = Step(np.array([[0.5]]), np.array([[1.0]])), Still(np.array([1.0]), 1 - 1e-9)
        >>> covariance, to_still = settled_sum(step, still, np.array([[1.0]]))
        >>> bool(to_still[0, 0] < 0.01), bool(covariance[0, 0] < 1.2)  # what stays is known after many frames
        (True, True)
    """
    count, few = len(step.again), len(still.variance)
    both = np.hstack([np.eye(count), np.eye(count, few)])
    again = scipy.linalg.block_diag(step.again, still.kept * np.eye(few))
    new = scipy.linalg.block_diag(step.new, np.diag(still.variance * (1 - still.kept**2)))
    settled = settled_covariance(Step(np.asarray(again), np.asarray(new)), both.T @ information @ both)
    predicted = both @ settled @ both.T
    to_still = scipy.linalg.solve(predicted, both @ settled[:, count:], assume_a="pos").T
    return (predicted + predicted.T) / 2, to_still


def modal_information(
    problem: gn.Problem, phase_rad: Float[Array, "y x"], basis: ModalBasis
) -> Float[np.ndarray, "mode mode"]:
    """Fisher information of a frame about the modes, 1/rad^2, at one phase.

    Args:
        problem: Light and noise; its counts do not matter.
        phase_rad: Where the light is linearised.
        basis: The modes, on the same grid.
    """

    @jax.jit
    def rows(modes: Float[Array, "some y x"], phase: Float[Array, "y x"]) -> Float[Array, "some datum"]:
        model, along = jax.linearize(problem.expected, phase)
        root = jnp.sqrt(problem.usable.astype(model.dtype) / (model + problem.dark))
        return (jax.vmap(along)(modes) * root[None]).reshape(len(modes), -1)

    modes = jnp.asarray(basis.modes, phase_rad.dtype)
    parts = [np.asarray(rows(modes[k : k + CHUNK], phase_rad)) for k in range(0, basis.count, CHUNK)]
    seen = np.concatenate(parts).astype(float)
    return seen @ seen.T
