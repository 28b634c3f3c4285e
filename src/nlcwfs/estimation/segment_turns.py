"""Whole wavelengths of the steps between segments: light of many colors tells them, one color does not."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.map_solution import Search, Solution, Task, likelier, solved
from nlcwfs.estimation.segment_steps import SegmentSteps
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.whitened_phase import Unknown

PAIRS_UP_TO = 12
"""Segments of a pupil of which two are moved at once: their number goes with the square."""

FAR = (2.1, 3.3)
"""Turns that are made at once, where there are no fringes left that one turn more would raise."""

ALL_UP_TO = 4
"""Segments of a pupil of which all turns are looked at: their number goes with the power."""

STRETCHES = (1.0, 1.04, 1.08)
"""Turns of a band: the longer waves keep their fringes on wrong turns, which lie further apart by that."""

NEAR = 30.0
"""A try that is less likely by more nats than this after its first step is given up."""


def with_turns(task: Task, settings: EstimationSettings, search: Search) -> tuple[Search, Float[Array, ""] | None]:
    """The search, with whole wavelengths added to segments where that makes it more likely, all else solved again.

    Of a few segments all turns are looked at first. Then each of `moves_of` is tried until none gains. A wrong turn is
    a maximum of its own: its fringes have less contrast, and those of other colors are shifted. Two segments that are
    off together may hold each other, and far off, where there are no fringes left, one turn makes no difference. A try
    takes one step, and more if it may win.

    Args:
        task: The exposure.
        settings: Sweeps over the segments, and how each try is solved.
        search: What was found with the turns of the first guess.

    Returns:
        The search, its best solution on the turns found; and the probability that these are wrong: the share of the
        posterior of all solutions that were tried around it. It is 1 if the sweeps were used up before the turns came
        to rest, and None where nothing tells turns: in one color, on one segment.
    """
    steps = task.prior.steps
    asked = settings.map.turn_sweeps > 0 and settings.prior.segment_piston_nm > 0
    if not asked or steps is None or steps.count < 2 or not task.level.has_band:
        return search, None
    return _on_best_turns(task, steps, settings.map, search)


def share_of_others(cost: Float[Array, ""], others: Float[Array, " other"]) -> Float[Array, ""]:
    """Share of the posterior of the other solutions, all taken as equally wide.

    Args:
        cost: Negative logarithm of the posterior of the one, nats.
        others: Of the others; infinite for none.

    Examples:
        Two that are ten times less likely have 2 of 12 parts.

        >>> share = share_of_others(jnp.asarray(5.0), 5.0 + jnp.log(jnp.asarray([10.0, 10.0, jnp.inf])))
        >>> round(float(share) * 12, 5)
        2.0
    """
    weights = jnp.sum(jnp.exp(cost - others))
    return weights / (1 + weights)


def moves_of(segments: int) -> Float[np.ndarray, "move segment"]:
    """Turns that are added to the segments of a pupil: to one, to two, and many to those; no two moves are alike.

    Turns of all segments together are no move: no light tells them. Of more than `PAIRS_UP_TO` segments no two move.

    Examples:
        >>> moves_of(2).tolist()[:4], len(moves_of(4)), len(moves_of(36))
        ([[-1.0, 0.0], [1.0, 0.0], [-1.0, 1.0], [1.0, -1.0]], 54, 216)
    """
    alone = list(np.eye(segments))
    paired = list(itertools.combinations(alone, 2)) if segments <= PAIRS_UP_TO else []
    together = [one + other for one, other in paired]
    moves = [sign * one for one in alone for sign in (-1, 1)]
    moves += [sign * one for one in together + [one - other for one, other in paired] for sign in (-1, 1)]
    moves += [sign * far * one for far in FAR for one in alone + together for sign in (-1, 1)]
    unlike: dict[tuple[float, ...], np.ndarray] = {}
    for move in moves:
        unlike.setdefault(tuple(np.round(move - move[0], 6)), move)
    unlike.pop((0.0,) * segments, None)
    return np.array(list(unlike.values())).reshape(-1, segments) + 0.0


def all_turns_of(segments: int) -> Float[np.ndarray, "move segment"]:
    """All turns against the first segment that a first guess of steps up to two waves may be off, and some longer.

    Examples:
        >>> all_turns_of(2)[:5, 1].tolist(), len(all_turns_of(4))
        ([-2.0, -1.0, 0.0, 1.0, 2.0], 375)
    """
    whole = [(0, *others) for others in itertools.product(range(-2, 3), repeat=segments - 1)]
    return np.concatenate([stretch * np.array(whole, float) for stretch in STRETCHES])


def _on_best_turns(
    task: Task, steps: SegmentSteps, settings: MapSettings, search: Search
) -> tuple[Search, Float[Array, ""]]:
    turn = 2 * jnp.pi / steps.rms_rad[0]
    best = _on_best_of_all(task, steps, settings, search.best)
    quick = settings.model_copy(update={"steps": 1})
    moves = jnp.asarray(moves_of(steps.count), search.best.cost.dtype)

    def more(solution: Solution) -> Solution:
        return solved(task, settings, solution.unknown, (solution.steps, solution.ffts))

    def visit(number: Int[Array, ""], carry: tuple[Solution, Array, Array]) -> tuple[Solution, Array, Array]:
        best, told, changed = carry
        first = solved(task, quick, _moved(steps, best.unknown, moves[number]), (best.steps, best.ffts))
        tried = jax.lax.cond(first.cost < best.cost + NEAR, more, lambda solution: solution, first)
        went = (tried.unknown.slope - best.unknown.slope)[2 : 2 + steps.count]
        came_back = jnp.dot(went, moves[number]) < turn / 2 * jnp.dot(moves[number], moves[number])
        told = told.at[number].set(jnp.where(came_back, jnp.inf, jnp.maximum(tried.cost, best.cost)))
        return likelier(tried, best), told, changed | (tried.cost < best.cost)

    def sweep(carry: tuple[Solution, Array, Array, Array]) -> tuple[Solution, Array, Array, Array]:
        best, told, _, count = carry
        best, told, changed = jax.lax.fori_loop(0, told.size, visit, (best, told, jnp.asarray(False)))
        return best, told, changed, count + 1

    def goes_on(carry: tuple[Solution, Array, Array, Array]) -> Bool[Array, ""]:
        return carry[2] & (carry[3] < settings.turn_sweeps)

    told = jnp.full(len(moves), jnp.inf, moves.dtype)
    start = (best, told, jnp.asarray(True), jnp.asarray(0, jnp.int32))
    best, told, changed, _ = jax.lax.while_loop(goes_on, sweep, start)
    return search._replace(best=best), jnp.where(changed, 1.0, share_of_others(best.cost, told))


def _on_best_of_all(task: Task, steps: SegmentSteps, settings: MapSettings, best: Solution) -> Solution:
    """Of a few segments all turns are looked at, as the light is predicted before anything else moves."""
    if steps.count > ALL_UP_TO:
        return best
    moves = jnp.asarray(all_turns_of(steps.count), best.cost.dtype)
    costs = jax.lax.map(lambda move: gn.cost(task.problem, _moved(steps, best.unknown, move)), moves)
    looked = gn.ffts_per_try(task.problem.counts.shape[0], colours=task.level.colour_count) * len(moves)
    move = moves[jnp.argmin(costs)]
    tried = solved(task, settings, _moved(steps, best.unknown, move), (best.steps, best.ffts + looked))
    return likelier(tried, best)


def _moved(steps: SegmentSteps, unknown: Unknown, turns: Float[Array, " segment"]) -> Unknown:
    piston = 2 * jnp.pi / steps.rms_rad[0] * turns
    return Unknown(unknown.waves, unknown.slope.at[2 : 2 + steps.count].add(piston))
