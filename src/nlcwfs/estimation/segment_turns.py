"""Whole wavelengths of the steps between segments: light of many colors tells them, one color does not."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.map_solution import Search, Solution, Task, likelier, solved
from nlcwfs.estimation.segment_light import SegmentLight
from nlcwfs.estimation.segment_steps import ALL_PAIRS_UP_TO, SegmentSteps
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.whitened_phase import Unknown

FARTHEST = 8
"""Turns that are looked at. A model of few colors shows fringes again on far turns, where the fringes of most of its
colors are in step: one of five colors over half the wavelength on the seventh."""

ALL_UP_TO = 4
"""Segments of a pupil of which all turns are looked at together: their number goes with the power."""

TOGETHER = 2
"""Turns of all segments at once: a first guess of steps up to two waves."""

STRETCHES = (1.0, 1.04, 1.08)
"""Turns of a band: the longer waves keep their fringes on wrong turns, which lie further apart by that."""

TRIED = 5
"""Turns that look most likely, for which all else is solved again."""

LEAD = 1.0
"""Nats by which other turns must be more likely: two that are as likely would take turns as each goes on to settle."""

PAIRS_AT_MOST = 256
"""Pairs of segments whose light fits into memory: 36 hexagons have 90, an ELT has thousands."""


def with_turns(task: Task, settings: EstimationSettings, search: Search) -> tuple[Search, Float[Array, ""] | None]:
    """The search, with whole wavelengths added to segments where that makes it more likely, all else solved again.

    A wrong turn is a maximum of its own: its fringes have less contrast, and those of other colors are shifted. Two
    segments that are off together may hold each other, and far off, where there are no fringes left, one turn makes no
    difference. So many turns are looked at, near and far, by the light of the segments alone (`segment_light`); the
    most likely of them are solved with all else, and what is likelier is kept, until nothing gains.

    Args:
        task: The exposure.
        settings: Sweeps over the segments, and how each try is solved.
        search: What was found with the turns of the first guess.

    Returns:
        The search, its best solution on the turns found; and the probability that these are wrong: the share of the
        posterior of all that was looked at around it. It is 1 if the sweeps were used up before the turns came to
        rest, and None where nothing tells turns: in one color, on one segment, of more than `PAIRS_AT_MOST` pairs.
    """
    steps = task.prior.steps
    asked = settings.map.turn_sweeps > 0 and settings.prior.segment_piston_nm > 0
    if not asked or steps is None or not task.level.has_band:
        return search, None
    if not 1 <= len(steps.pairs) <= PAIRS_AT_MOST:
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
    """Turns that are looked at: of one segment and of two up to `FARTHEST`, of few segments all up to `TOGETHER`.

    Turns of all segments together are no move: no light tells them. Of more than `ALL_PAIRS_UP_TO` segments no two
    move.

    Examples:
        >>> moves_of(2)[:, 1].tolist()
        [-8.0, -7.0, -6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]
        >>> len(moves_of(4)), len(moves_of(7)), len(moves_of(36))
        (238, 616, 576)
    """
    alone = list(np.eye(segments))
    paired = list(itertools.combinations(alone, 2)) if segments <= ALL_PAIRS_UP_TO else []
    ways = alone + [one + other for one, other in paired] + [one - other for one, other in paired]
    moves = [turns * way for way in ways for turns in range(-FARTHEST, FARTHEST + 1)]
    if segments <= ALL_UP_TO:
        near = range(-TOGETHER, TOGETHER + 1)
        moves += [np.array((0.0, *others)) for others in itertools.product(near, repeat=segments - 1)]
    unlike = {tuple(move - move[0]) for move in moves if 0 < np.ptp(move) <= FARTHEST}
    return np.array(sorted(unlike)) + 0.0


def _on_best_turns(
    task: Task, steps: SegmentSteps, settings: MapSettings, search: Search
) -> tuple[Search, Float[Array, ""]]:
    moves = jnp.asarray(moves_of(steps.count), search.best.cost.dtype)
    shining = steps.count * gn.ffts_per_try(task.problem.counts.shape[0], colours=task.level.colour_count)

    def sweep(carry: tuple[Solution, Array, Array, Array]) -> tuple[Solution, Array, Array, Array]:
        base, _, _, count = carry
        base = solved(task, settings, base.unknown, (base.steps, base.ffts))  # as many steps as those that are tried
        turns, costs = looked(SegmentLight.build(task, steps, base), moves)
        whole = jnp.round(turns - turns[:, :1])
        costs = jnp.where(jnp.all(whole == 0, axis=1), jnp.inf, base.cost + costs)

        def visit(number: Int[Array, ""], carry: tuple[Solution, Array, Array]) -> tuple[Solution, Array, Array]:
            best, costs, told = carry
            one = jnp.argmin(costs)
            tried = solved(task, settings, _moved(steps, base.unknown, turns[one]), (best.steps, best.ffts))
            came_back = jnp.all(_went(steps, base, tried) == 0) | jnp.isinf(costs[one])
            told = told.at[number].set(jnp.where(came_back, jnp.inf, jnp.maximum(tried.cost, base.cost)))
            same = jnp.all(whole == whole[one][None], axis=1)
            return likelier(tried, best, lead=LEAD), jnp.where(same, jnp.inf, costs), told

        told = jnp.full(TRIED, jnp.inf, costs.dtype)
        start = base._replace(ffts=base.ffts + shining)
        best, costs, told = jax.lax.fori_loop(0, TRIED, visit, (start, costs, told))
        others = jnp.concatenate([told, jnp.maximum(costs, base.cost)])
        return best, share_of_others(base.cost, others), jnp.any(_went(steps, base, best)), count + 1

    def goes_on(carry: tuple[Solution, Array, Array, Array]) -> Bool[Array, ""]:
        return carry[2] & (carry[3] < settings.turn_sweeps)

    start = (search.best, jnp.ones_like(search.best.cost), jnp.asarray(True), jnp.asarray(0, jnp.int32))
    best, wrong, changed, _ = jax.lax.while_loop(goes_on, sweep, start)
    return search._replace(best=best), jnp.where(changed, 1.0, wrong)


def looked(
    light: SegmentLight, moves: Float[Array, "move segment"]
) -> tuple[Float[Array, "look segment"], Float[Array, " look"]]:
    """Pistons near each move that fit best, and their cost; and what one move after the other leads to.

    Args:
        light: Of the segments.
        moves: See `moves_of`.
    """
    count = moves.shape[1]

    def around(turns: Float[Array, " segment"]) -> tuple[Array, Array]:
        stretched = turns[None, None] + jnp.asarray(STRETCHES, moves.dtype)[:, None, None] * moves[None]
        starts = jax.vmap(jax.vmap(light.cost))(stretched)
        near = jnp.take_along_axis(stretched, jnp.argmin(starts, axis=0)[None, :, None], axis=0)[0]
        return jax.vmap(light.fitted)(near)

    def further(_: Int[Array, ""], carry: tuple[Array, Array]) -> tuple[Array, Array]:
        turns, costs = around(carry[0])
        one = jnp.argmin(costs)
        better = costs[one] < carry[1]
        return jnp.where(better, turns[one], carry[0]), jnp.minimum(costs[one], carry[1])

    none = jnp.zeros(count, moves.dtype)
    last, cost = jax.lax.fori_loop(0, count, further, (none, jnp.zeros((), moves.dtype)))
    turns, costs = around(none)
    return jnp.concatenate([last[None], turns]), jnp.concatenate([cost[None], costs])


def _went(steps: SegmentSteps, first: Solution, last: Solution) -> Float[Array, " segment"]:
    """Whole turns against the first segment from one solution to another."""
    piston = (last.unknown.slope - first.unknown.slope)[2 : 2 + steps.count] * steps.rms_rad[0] / (2 * jnp.pi)
    return jnp.round(piston - piston[0])


def _moved(steps: SegmentSteps, unknown: Unknown, turns: Float[Array, " segment"]) -> Unknown:
    piston = 2 * jnp.pi / steps.rms_rad[0] * turns
    return Unknown(unknown.waves, unknown.slope.at[2 : 2 + steps.count].add(piston))
