"""Whole wavelengths of the steps between segments: light of many colors tells them, one color does not."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.map_solution import Search, Solution, Task, solved
from nlcwfs.estimation.segment_steps import SegmentSteps
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.whitened_phase import Unknown

PAIRS_UP_TO = 12
"""Segments of a pupil of which two are moved at once: their number goes with the square."""

REACH = 3
"""Turns that one segment is moved at once: a first guess of steps up to two waves may be so far off."""

NEAR = 30.0
"""A try that is less likely by more nats than this after its first step is given up."""


def with_turns(task: Task, settings: EstimationSettings, search: Search) -> tuple[Search, Float[Array, ""] | None]:
    """The search, with whole wavelengths added to segments where that makes it more likely, all else solved again.

    Each of `moves_of` is tried until none gains. A wrong turn is a maximum of its own: its fringes have less contrast,
    and those of other colors are shifted. Two segments that are off together may hold each other, and far off, where
    there are no fringes left, one turn makes no difference. A try takes one step, and more if it may win.

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
    if not asked or steps is None or steps.count < 2 or task.level.colours is None:
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


def moves_of(segments: int) -> Int[np.ndarray, "move segment"]:
    """Turns that are added to the segments of a pupil: to one, to two, and to one up to `REACH`; no two are alike.

    Turns of all segments together are no move: no light tells them. Of more than `PAIRS_UP_TO` segments no two move.

    Examples:
        >>> moves_of(2).tolist(), len(moves_of(4)), len(moves_of(36))
        ([[-1, 0], [1, 0], [-1, 1], [1, -1], [-3, 0], [3, 0]], 42, 216)
    """
    alone = np.eye(segments, dtype=int)
    moves = [sign * one for one in alone for sign in (-1, 1)]
    if segments <= PAIRS_UP_TO:
        pairs = itertools.combinations(alone, 2)
        moves += [first * one + second * other for one, other in pairs for first in (-1, 1) for second in (-1, 1)]
    moves += [turns * one for far in range(2, REACH + 1) for one in alone for turns in (-far, far)]
    unlike: dict[tuple[int, ...], np.ndarray] = {}
    for move in moves:
        unlike.setdefault(tuple(move - move[0]), move)
    unlike.pop((0,) * segments, None)
    return np.array(list(unlike.values())).reshape(-1, segments)


def _on_best_turns(
    task: Task, steps: SegmentSteps, settings: MapSettings, search: Search
) -> tuple[Search, Float[Array, ""]]:
    turn = 2 * jnp.pi / steps.rms_rad[0]
    quick = settings.model_copy(update={"steps": 1})
    moves = jnp.asarray(moves_of(steps.count), search.best.cost.dtype)

    def more(solution: Solution) -> Solution:
        return solved(task, settings, solution.unknown, (solution.steps, solution.ffts))

    def visit(number: Int[Array, ""], carry: tuple[Solution, Array, Array]) -> tuple[Solution, Array, Array]:
        best, told, changed = carry
        pistons, rest = best.unknown.slope[2 : 2 + steps.count], best.unknown.slope[2 + steps.count :]
        slope = jnp.concatenate([best.unknown.slope[:2], pistons + turn * moves[number], rest])
        first = solved(task, quick, Unknown(best.unknown.waves, slope), (best.steps, best.ffts))
        tried = jax.lax.cond(first.cost < best.cost + NEAR, more, lambda solution: solution, first)
        went = tried.unknown.slope[2 : 2 + steps.count] - pistons
        came_back = jnp.dot(went, moves[number]) < turn / 2 * jnp.dot(moves[number], moves[number])
        better = tried.cost < best.cost
        told = told.at[number].set(jnp.where(came_back, jnp.inf, jnp.maximum(tried.cost, best.cost)))
        kept: Solution = jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, best)
        return kept._replace(steps=tried.steps, ffts=tried.ffts), told, changed | better

    def sweep(carry: tuple[Solution, Array, Array, Array]) -> tuple[Solution, Array, Array, Array]:
        best, told, _, count = carry
        best, told, changed = jax.lax.fori_loop(0, told.size, visit, (best, told, jnp.asarray(False)))
        return best, told, changed, count + 1

    def goes_on(carry: tuple[Solution, Array, Array, Array]) -> Bool[Array, ""]:
        return carry[2] & (carry[3] < settings.turn_sweeps)

    told = jnp.full(len(moves), jnp.inf, moves.dtype)
    start = (search.best, told, jnp.asarray(True), jnp.asarray(0, jnp.int32))
    best, told, changed, _ = jax.lax.while_loop(goes_on, sweep, start)
    return search._replace(best=best), jnp.where(changed, 1.0, share_of_others(best.cost, told))
