"""Frames of frozen air whose wind is known: Kalman's filter in the modes of the pupil, with a whole covariance.

What the wind carries on is known to a few nanometres, what came in over the rim is not: a covariance that is dense in
modes tells them apart, which one that is diagonal in waves (`sequence_reconstructor`) cannot. The light is not linear in
the phase, so each frame takes some Gauss-Newton steps from the prediction (an iterated, extended filter; Bell & Cathey
1993, IEEE Trans. Autom. Control 38, 294). The covariance depends on the frames only through the information that one
has, and settles: it is made beforehand.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.beam.modes import ModalBasis
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


class Followed(NamedTuple):
    """What a frame shows.

    Attributes:
        modes_rad: Of the air, the mirror's shape not included.
        surprise: Square of what is new, over what is expected of air that was predicted rightly: 1 on average.
    """

    modes_rad: Float[Array, " mode"]
    surprise: Float[Array, ""]


class FlowFilter(eqx.Module):
    """Follows the modes of air that the wind carries.

    Attributes:
        solver: The sensor.
        level: Its optics; the pupil a little darker, by what the uncertain part of the phase scatters.
        scattered: That light over all, which lies on the frames like a haze.
        again: From the modes of one frame to those of the next.
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
        information: Float[np.ndarray, "mode mode"],
        *,
        beyond_rad2: float,
    ) -> "FlowFilter":
        """Settle the covariance for one wind.

        Args:
            solver: The sensor.
            basis: Modes on the model's grid.
            step: Of one interval, rad.
            information: That a frame has of the modes, 1/rad^2, see `modal_information`.
            beyond_rad2: Variance of the air beyond the modes.
        """
        level, dtype = solver.level, solver.power.dtype
        lit = np.flatnonzero(np.asarray(basis.weights).ravel() > 0)
        modes = np.asarray(basis.modes, float).reshape(basis.count, -1)[:, lit].T
        predicted = settled_covariance(step, information)
        left = left_covariance(predicted, information)
        open_rad2 = np.zeros(basis.weights.size)
        open_rad2[lit] = np.einsum("ck,ck->c", modes @ predicted, modes) + beyond_rad2
        modulus = np.asarray(level.modulus, float) * np.exp(-open_rad2.reshape(level.grid.shape) / 2)
        scattered = 1 - np.sum(modulus**2) / np.sum(np.asarray(level.modulus, float) ** 2)
        return cls(
            solver=solver,
            level=eqx.tree_at(lambda one: one.modulus, level, jnp.asarray(modulus, dtype)),
            scattered=float(scattered),
            again=jnp.asarray(step.again, dtype),
            prior=ModalPrior.build(modes, predicted, information, lit, level.grid.shape, str(dtype)),
            modes=jnp.asarray(modes, dtype),
            weights=jnp.asarray(np.asarray(basis.weights).ravel()[lit], dtype),
            nearest=jnp.asarray(_nearest(np.asarray(basis.weights) > 0)),
            left_rad=float(np.sqrt(np.trace(left))),
        )

    @property
    def ffts(self) -> int:
        """FFTs of one plane for a frame."""
        through = self.level.optics.transfer.shape[1] + 1
        return STEPS * (2 * through + INNER * 2 * through)

    def phase_rad(self, modes_rad: Float[Array, " mode"]) -> Float[Array, "y x"]:
        """The air's phase on the model's grid; beyond the light it is that of the nearest lit cell."""
        return (self.modes @ modes_rad)[self.nearest]

    def modes_of(self, phase_rad: Float[Array, "y x"]) -> Float[Array, " mode"]:
        """The modes of a phase on the model's grid."""
        lit_rad = phase_rad.reshape(-1)[self.prior.lit].astype(self.modes.dtype)
        return (self.weights * lit_rad) @ self.modes

    def follow(
        self,
        counts: Float[Array, "plane y x"],
        usable: Bool[Array, "plane y x"],
        modes_rad: Float[Array, " mode"],
        *,
        read_variance: float | Float[Array, ""] = 0.0,
        known_rad: Float[Array, "Y X"] | None = None,
    ) -> Followed:
        """The air behind the next frame.

        Args:
            counts: Photo-electrons on the frames' pixels, background subtracted.
            usable: False for pixels to ignore.
            modes_rad: What the last frame showed.
            read_variance: Variance of a pixel without light, electrons squared.
            known_rad: Phase on the model's grid beside the air's: minus the shape of a mirror.
        """
        solver, level = self.solver, self.level
        measured = solver.capture.measurement(counts, usable, read_variance).padded(level.measured_shape)
        expected = self.again @ modes_rad
        total_rad = solver.known_rad(jnp.zeros(2, expected.dtype)) + self.phase_rad(expected)
        if known_rad is not None:
            total_rad = total_rad + known_rad
        total = plane_counts(measured)
        scale = PlaneScale(total, total * self.scattered / measured.counts[0].size)  # the haze of what is uncertain
        one = jnp.ones((), expected.dtype)
        task = eqx.tree_at(lambda s: s.level, solver, level).task(measured, total_rad, scale, self.prior, one)
        unknown = self.prior.nothing()
        for _ in range(STEPS):
            direction, _ = gn.direction_of_step(task.problem, INNER, unknown)
            unknown = gn.plus(unknown, direction, 1.0)
        found = expected + self.prior.root @ unknown.waves
        shown = jnp.sum(self.prior.seen / (1 + self.prior.seen))
        return Followed(found, self.prior.dot(unknown, unknown) / shown)


def _nearest(lit: Bool[np.ndarray, "y x"]) -> Int[np.ndarray, "y x"]:
    """For each cell the number of the lit one that is nearest."""
    number = np.cumsum(lit).reshape(lit.shape) - 1
    row, column = np.asarray(scipy.ndimage.distance_transform_edt(~lit, return_distances=False, return_indices=True))
    return number[row, column]


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
        root = jnp.sqrt(problem.usable / (model + problem.dark))
        return (jax.vmap(along)(modes) * root).reshape(len(modes), -1)

    modes = jnp.asarray(basis.modes, phase_rad.dtype)
    parts = [np.asarray(rows(modes[k : k + CHUNK], phase_rad)) for k in range(0, basis.count, CHUNK)]
    seen = np.concatenate(parts).astype(float)
    return seen @ seen.T
