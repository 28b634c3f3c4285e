"""One maximum a posteriori solution, the islands brought back, and how well it fits."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.bayesian_unwrapping import unwrapped, unwrapping_ffts
from nlcwfs.estimation.iterate import iterate
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.resolution_level import LIT, Level, Measurement
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.turbulence_filter import expected_error
from nlcwfs.estimation.turn_islands import tearing_ffts, torn_phase
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase

SMALLEST_ISLAND_RAD = 0.1
"""Two solutions are one if they differ by less than this, whatever is expected: one pixel of a 45-pixel pupil that is a
turn off makes 0.16 rad."""


class Solution(NamedTuple):
    """A wavefront with its account.

    Attributes:
        unknown: The phase beside the known part, in units of the prior.
        model: Mean counts that it predicts.
        cost: Negative logarithm of the posterior, nats.
        misfit: By how many standard deviations the counts miss the model more than they should, see `misfit`.
        steps: Gauss-Newton steps so far.
        ffts: FFTs so far.
        rests: Whether the last steps converged.
    """

    unknown: Unknown
    model: Float[Array, "plane v u"]
    cost: Float[Array, ""]
    misfit: Float[Array, ""]
    steps: Int[Array, ""]
    ffts: Int[Array, ""]
    rests: Bool[Array, ""]


class Search(NamedTuple):
    """All that was tried for one exposure.

    Attributes:
        best: The most likely solution; its steps and FFTs are those of all.
        last: The last one.
        healings: How many were made by healing another.
        agreed: Whether the last healing led back to the best solution.
    """

    best: Solution
    last: Solution
    healings: Int[Array, ""]
    agreed: Bool[Array, ""]


class Task(NamedTuple):
    """All that the solutions of one exposure share.

    Attributes:
        problem: Counts and prior.
        prior: What is expected of the phase.
        level: The sensor.
        measured: The counts, as the field's iterations take them.
        scale: Counts of each plane.
        beyond: Variance of the phase that is finer than the model's cells, rad^2.
    """

    problem: gn.Problem
    prior: WhitenedPhase
    level: Level
    measured: Measurement
    scale: PlaneScale
    beyond: Float[Array, ""]


class Found(NamedTuple):
    """What one exposure led to.

    Attributes:
        task: What was to be solved.
        search: The solutions.
        slope: Starting tilt (y, x), metres per metre.
        strength: Variance of the turbulence over that of the prior.
        wrong_turn: Probability that a segment is whole wavelengths off; None where nothing tells.
        log_amplitude: Of the light on the model's grid; None where it is taken as known.
    """

    task: Task
    search: Search
    slope: Float[Array, "2"]
    strength: Float[Array, ""]
    wrong_turn: Float[Array, ""] | None = None
    log_amplitude: Float[Array, "y x"] | None = None


def seen_modes(task: Task) -> Float[Array, ""]:
    """How many modes of the pupil the light shows better than the prior: the degrees of freedom of a fit."""
    prior, light = task.prior, task.level.light
    gain = task.problem.information * prior.amplitude**2
    return jnp.sum(light) / light.size * jnp.sum(prior.twice * gain / (1 + gain))


def solved(task: Task, settings: MapSettings, unknown: Unknown, before: tuple[Array, Array]) -> Solution:
    """The nearest maximum of the posterior.

    Args:
        task: The exposure.
        settings: Steps and tolerance.
        unknown: Where to start.
        before: Steps and FFTs spent so far.
    """
    problem, inner = task.problem, settings.conjugate_gradients
    tolerance = settings.tolerance * seen_modes(task)
    state = iterate(
        lambda state: gn.step(problem, inner, state),
        lambda state: gn.terminate(state, steps=settings.steps, tolerance=tolerance),
        gn.init(problem, unknown),
    )
    model = problem.expected(problem.known_rad + problem.prior.phase_rad(state.unknown))
    planes = problem.counts.shape[0]
    colours = task.level.colour_count
    each, tried = gn.ffts_per_step(planes, inner, colours=colours), gn.ffts_per_try(planes, colours=colours)
    spent = state.iteration * each + (state.tries + 1) * tried
    return Solution(
        unknown=state.unknown,
        model=model,
        cost=state.cost,
        misfit=misfit(task, model),
        steps=before[0] + state.iteration,
        ffts=before[1] + spent,
        rests=state.predicted < tolerance,
    )


def searched(task: Task, settings: MapSettings, unknown: Unknown, before: tuple[Array, Array]) -> Search:
    """Solve, heal and solve again, until two solutions in a row agree or the healings are used up.

    Args:
        task: The exposure.
        settings: Healings, steps, tolerance.
        unknown: First guess.
        before: Steps and FFTs spent so far.
    """
    first = solved(task, settings, unknown, before)
    sigma_rad = expected_error(task.prior.amplitude**2, 1 / task.problem.information, task.level.grid)
    near_rad = jnp.maximum(settings.agreement * sigma_rad, SMALLEST_ISLAND_RAD)

    def again(search: Search) -> Search:
        last = healed(task, settings, search.last)
        apart_rad = disagreement_rad(task, last.unknown, search.best.unknown)
        return Search(likelier(last, search.best), last, search.healings + 1, apart_rad < near_rad)

    start = Search(first, first, jnp.asarray(0, jnp.int32), jnp.asarray(False))
    return jax.lax.while_loop(lambda search: ~search.agreed & (search.healings < settings.healings), again, start)


def likelier(tried: Solution, best: Solution, *, lead: float = 0.0) -> Solution:
    """The more likely of two solutions, with the account of what was tried last; it must lead by so many nats."""
    better = tried.cost < best.cost - lead
    kept: Solution = jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, best)
    return kept._replace(steps=tried.steps, ffts=tried.ffts)


def healed(task: Task, settings: MapSettings, solution: Solution) -> Solution:
    """Another solution, from the same light without the islands, see `turn_islands`."""
    problem, level = task.problem, task.level
    phase_rad = problem.known_rad + problem.prior.phase_rad(solution.unknown)
    torn_rad = torn_phase(
        level,
        task.measured,
        task.scale,
        phase_rad,
        iterations=settings.healing_iterations,
        gain=settings.healing_gain,
    )
    whole_rad = unwrapped(torn_rad - problem.known_rad, level.light > LIT, task.prior)
    start = task.prior.start(whole_rad, noise_variance=1 / problem.information)
    tearing = tearing_ffts(problem.counts.shape[0], settings.healing_iterations, moments=level.moment_count)
    ffts = tearing + unwrapping_ffts() + 1
    return solved(task, settings, start, (solution.steps, solution.ffts + ffts))


def misfit(task: Task, model: Float[Array, "plane v u"]) -> Float[Array, ""]:
    r"""Standard deviations by which the counts miss the model more than noise and unmodelled turbulence let them.

    :math:`\chi^2 = \sum (n - \mu)^2 / V` has the mean :math:`\sum (\mu + \sigma^2 + 2 \beta \mu^2) / V - k`: photon and
    read noise, speckles of the turbulence of variance :math:`\beta` beyond the model's cells (they take the share
    :math:`\beta` of the light, and beat with the rest), less the k modes that were fitted.
    """
    problem = task.problem
    variance = model + problem.dark
    found = jnp.sum(jnp.where(problem.usable, (problem.counts - model) ** 2 / variance, 0))
    noise = model + task.measured.read_variance + 2 * task.beyond * model**2
    expected = jnp.sum(jnp.where(problem.usable, noise / variance, 0)) - seen_modes(task)
    expected = jnp.maximum(expected, 1)
    return (found - expected) / jnp.sqrt(2 * expected)


def disagreement_rad(task: Task, a: Unknown, b: Unknown) -> Float[Array, ""]:
    """Rms over the pupil of the difference of two solutions, piston excluded."""
    difference = task.problem.prior.phase_rad(a) - task.problem.prior.phase_rad(b)
    if task.prior.steps is not None:  # its whole turns no colour tells, or are looked for when all else is found
        turns = task.prior.steps.means(difference) / (2 * jnp.pi)
        difference = difference - 2 * jnp.pi * jnp.round(turns - turns.ravel()[jnp.argmax(task.level.weight)])
    weight = task.level.weight
    mean = jnp.sum(weight * difference)
    return jnp.sqrt(jnp.sum(weight * (difference - mean) ** 2))
