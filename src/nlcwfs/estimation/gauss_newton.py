"""Fisher scoring: the Gauss-Newton method for counts of light, without matrices."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation.whitened_phase import Unknown, scaled

BACKTRACKS = 3
"""A step that makes the fit worse is shortened so often before it is given up."""

SHORTER = 0.4
"""... each time to this part."""


@runtime_checkable
class Prior(Protocol):
    """What is expected of a phase, or of a `ComplexPhase`: unknowns of unit variance, see `WhitenedPhase`."""

    def phase_rad(self, unknown: Unknown) -> Float[Array, "*both y x"]:
        """The phase of these unknowns, or phase and log-amplitude."""
        ...

    def transposed(self, gradient: Float[Array, "*both y x"]) -> Unknown:
        """The transpose of `phase_rad`."""
        ...

    def dot(self, a: Unknown, b: Unknown) -> Float[Array, ""]:
        """Inner product."""
        ...

    def preconditioner(self, information: Float[Array, ""], shown: Unknown) -> Unknown:
        """About the inverse of the curvature of a fit."""
        ...


class Problem(NamedTuple):
    """Counts to be explained by a phase.

    Attributes:
        expected: Mean counts of the measured pixels for a phase (rad, on the model's grid).
        counts: Photo-electrons; anything where not usable.
        usable: Which pixels were measured.
        dark: Variance of a pixel without light, electrons squared.
        known_rad: Phase that is known beforehand: starting tilt, static aberration, prior mean.
        prior: What is expected of the rest.
        information: Mean Fisher information of the phase of one cell (1/rad^2), for the preconditioner.
        shown: What each unknown has of that, see `wave_sensitivity`; 1 in speckled light.
    """

    expected: Callable[[Float[Array, "*both y x"]], Float[Array, "plane v u"]]
    counts: Float[Array, "plane v u"]
    usable: Bool[Array, "plane v u"]
    dark: Float[Array, "plane 1 1"]
    known_rad: Float[Array, "*both y x"]
    prior: Prior
    information: Float[Array, ""]
    shown: Unknown


class GaussNewtonState(eqx.Module):
    """What a step hands to the next.

    Attributes:
        unknown: The phase beside the known part, in units of the prior.
        cost: Negative logarithm of the posterior, nats.
        predicted: Decrease of the cost that the last step promised, nats.
        iteration: Steps so far.
        tries: Evaluations of the cost so far.
        accepted: Whether the last step made the fit better.
    """

    unknown: Unknown
    cost: Float[Array, ""]
    predicted: Float[Array, ""]
    iteration: Int[Array, ""]
    tries: Int[Array, ""]
    accepted: Bool[Array, ""]


def init(problem: Problem, unknown: Unknown) -> GaussNewtonState:
    """The state before the first step."""
    one = jnp.asarray(1, jnp.int32)
    far = jnp.asarray(jnp.inf, problem.counts.dtype)
    return GaussNewtonState(unknown, cost(problem, unknown), far, 0 * one, one, jnp.asarray(True))


def step(problem: Problem, inner: int, state: GaussNewtonState) -> GaussNewtonState:
    """One step of Fisher scoring, shortened until the fit is better."""
    direction, predicted = direction_of_step(problem, inner, state.unknown)

    def shorter(trial: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        length, _, tries = trial
        length = jnp.where(tries > 0, length * SHORTER, length)
        return length, cost(problem, plus(state.unknown, direction, length)), tries + 1

    def worse(trial: tuple[Array, Array, Array]) -> Array:
        return ~(trial[1] < state.cost) & (trial[2] <= BACKTRACKS)

    start = (jnp.ones_like(state.cost), state.cost, jnp.asarray(0, jnp.int32))
    length, found, tries = jax.lax.while_loop(worse, shorter, start)
    accepted = found < state.cost
    return GaussNewtonState(
        unknown=plus(state.unknown, direction, jnp.where(accepted, length, 0)),
        cost=jnp.where(accepted, found, state.cost),
        predicted=predicted,
        iteration=state.iteration + 1,
        tries=state.tries + tries,
        accepted=accepted,
    )


def direction_of_step(problem: Problem, inner: int, unknown: Unknown) -> tuple[Unknown, Float[Array, ""]]:
    r"""A step of Fisher scoring and the decrease of the cost that it promises, nats.

    Solves :math:`(S J^T V^{-1} J S + 1)\, d = S J^T V^{-1} (n - \mu) - x` by `inner` conjugate gradients, with
    :math:`V = \mu + \mathrm{dark}` and the exact Jacobian J.
    """
    prior = problem.prior
    phase_rad = problem.known_rad + prior.phase_rad(unknown)
    model, along = jax.linearize(problem.expected, phase_rad)
    back = jax.linear_transpose(along, phase_rad)
    weight = problem.usable.astype(model.dtype) / (model + problem.dark)
    (pull,) = back(weight * (problem.counts - model))
    gradient = plus(prior.transposed(pull), unknown, -1.0)

    def curvature(v: Unknown) -> Unknown:
        (seen,) = back(weight * along(prior.phase_rad(v)))
        return plus(prior.transposed(seen), v, 1.0)

    direction = conjugate_gradients(
        curvature, gradient, prior.preconditioner(problem.information, problem.shown), prior, inner
    )
    return direction, prior.dot(gradient, direction) / 2


def terminate(state: GaussNewtonState, *, steps: int, tolerance: Float[Array, ""]) -> Array:
    """Whether the steps are used up, promise less than `tolerance` (nats), or fail to make the fit better."""
    return (state.iteration >= steps) | (state.predicted < tolerance) | ~state.accepted


def cost(problem: Problem, unknown: Unknown) -> Float[Array, ""]:
    r"""Negative logarithm of the posterior, nats, zero for a perfect fit of the flat phase.

    Read noise of variance d is a Poisson count d that is known to be there (Snyder, Hammoud & White 1993, JOSA A
    10, 1014): :math:`\sum \mu - n - (n + d) \log((\mu + d) / (n + d)) + |x|^2 / 2`.
    """
    model = problem.expected(problem.known_rad + problem.prior.phase_rad(unknown))
    return deviance(problem, model) / 2 + problem.prior.dot(unknown, unknown) / 2


def deviance(problem: Problem, model: Float[Array, "plane v u"]) -> Float[Array, ""]:
    """Twice the negative logarithm of the likelihood over that of a perfect fit; about 1 a pixel when all is well."""
    seen = jnp.maximum(problem.counts + problem.dark, 0)
    light = model + problem.dark
    ratio = jnp.where(seen > 0, jnp.maximum(seen, 1e-9) / light, 1.0)
    each = light - seen + seen * jnp.log(ratio)
    return 2 * jnp.sum(jnp.where(problem.usable, each, 0))


def conjugate_gradients(
    curvature: Callable[[Unknown], Unknown],
    gradient: Unknown,
    preconditioner: Unknown,
    prior: Prior,
    count: int,
) -> Unknown:
    """So many conjugate gradients towards `curvature^-1 gradient`, from zero, with a diagonal preconditioner.

    Examples:
        A curvature of four for every unknown is solved by the first.

        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.estimation.whitened_phase import WhitenedPhase
        >>> prior = WhitenedPhase.build(Grid((8, 8), 1.0), jnp.ones((8, 5)), tilt_rms_rad=1.0, diameter_m=8.0)
        >>> pull = prior.start(jnp.zeros((8, 8)).at[2, 3].set(1.0), noise_variance=0.0)
        >>> same = Unknown(jnp.ones((8, 5)), jnp.ones(2))
        >>> found = conjugate_gradients(lambda v: plus(v, v, 3.0), pull, same, prior, 1)
        >>> round(float(prior.dot(found, pull)), 5)
        0.25
    """

    def conditioned(v: Unknown) -> Unknown:
        return Unknown(scaled(v.waves, preconditioner.waves), v.slope * preconditioner.slope)

    def one(carry: tuple[Unknown, Unknown, Unknown, Array], _: None) -> tuple[tuple, None]:
        found, rest, search, norm = carry
        bent = curvature(search)
        length = norm / jnp.maximum(prior.dot(search, bent), jnp.finfo(norm.dtype).tiny)
        found, rest = plus(found, search, length), plus(rest, bent, -length)
        steepest = conditioned(rest)
        renewed = prior.dot(rest, steepest)
        search = plus(steepest, search, renewed / jnp.maximum(norm, jnp.finfo(norm.dtype).tiny))
        return (found, rest, search, renewed), None

    nothing = Unknown(jnp.zeros_like(gradient.waves), jnp.zeros_like(gradient.slope))
    first = conditioned(gradient)
    carry = (nothing, gradient, first, prior.dot(gradient, first))
    return jax.lax.scan(one, carry, None, length=count)[0][0]


def ffts_per_step(planes: int, inner: int, *, colours: int = 1) -> int:
    """Two-dimensional complex FFTs of one step without its tries; two real ones count as one.

    Light there, gradient back, and for each conjugate gradient both; the phase of an unknown is half an FFT.

    Examples:
        >>> ffts_per_step(4, 5), ffts_per_step(4, 5, colours=3)
        (66, 186)
    """
    through = colours * (planes + 1)
    return 2 * through + 1 + inner * (2 * through + 1)


def ffts_per_try(planes: int, *, colours: int = 1) -> int:
    """FFTs of one evaluation of the cost, rounded up.

    Examples:
        >>> ffts_per_try(4), ffts_per_try(4, colours=3)
        (6, 16)
    """
    return colours * (planes + 1) + 1


def plus(a: Unknown, b: Unknown, factor: float | Float[Array, ""]) -> Unknown:
    """`a + factor * b`.

    Examples:
        >>> one = Unknown(jnp.ones((1, 1), complex), jnp.ones(2))
        >>> plus(one, one, 2.0).slope.tolist()
        [3.0, 3.0]
    """
    return Unknown(a.waves + scaled(b.waves, factor), a.slope + factor * b.slope)
