"""Whole wavelengths of the steps between segments: light of many colors tells them, one color does not."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.map_solution import Search, Solution, Task, solved
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.whitened_phase import Unknown


def with_turns(task: Task, settings: EstimationSettings, search: Search) -> tuple[Search, Float[Array, ""] | None]:
    """The search on its best turns and the probability that they are wrong; None where nothing tells.

    Light of one color does not, and a pupil of one piece has none.

    Examples:
        >>> EstimationSettings().map.wavelengths > 1  # so nothing tells
        False
    """
    asked = settings.map.turn_sweeps > 0 and settings.prior.segment_piston_nm > 0
    if not asked or task.prior.steps is None or task.level.colours is None:
        return search, None
    return on_best_turns(task, settings.map, search)


def on_best_turns(task: Task, settings: MapSettings, search: Search) -> tuple[Search, Float[Array, ""]]:
    """The solution with whole wavelengths added to segments where that makes it more likely, all else solved again.

    One segment after the other goes a wavelength up and down, until none gains by it. A wrong turn is a maximum of its
    own: its fringes have less contrast, and those of other colors are shifted.

    Args:
        task: The exposure, with a model of many colors and segments.
        settings: Sweeps over the segments, and how each try is solved.
        search: What was found with the turns of the first guess.

    Returns:
        The search, its best solution on the turns found; and the probability that these are wrong: the share of the
        posterior of all solutions that are one turn of one segment away. It is 1 if the sweeps were used up before
        the turns came to rest.

    Raises:
        ValueError: If the pupil has no segments.

    Examples:
        >>> settings = MapSettings(wavelengths=5, turn_sweeps=4)
        >>> most_tries(settings, segments=7)
        56
    """
    steps = task.prior.steps
    if steps is None:
        raise ValueError("prior.steps: must be there, got None")
    turn = 2 * jnp.pi / steps.rms_rad[0]

    def visit(number: Int[Array, ""], carry: tuple[Solution, Array, Array]) -> tuple[Solution, Array, Array]:
        best, told, changed = carry
        place, sign = 2 + number // 2, 1 - 2 * (number % 2)
        slope = best.unknown.slope
        moved = Unknown(best.unknown.waves, slope.at[place].add(sign * turn))
        tried = solved(task, settings, moved, (best.steps, best.ffts))
        came_back = jnp.abs(tried.unknown.slope[place] - slope[place]) < turn / 2
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

    told = jnp.full(2 * steps.count, jnp.inf, search.best.cost.dtype)
    start = (search.best, told, jnp.asarray(True), jnp.asarray(0, jnp.int32))
    best, told, changed, _ = jax.lax.while_loop(goes_on, sweep, start)
    return search._replace(best=best), jnp.where(changed, 1.0, share_of_others(best.cost, told))


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


def most_tries(settings: MapSettings, *, segments: int) -> int:
    """Solutions that `on_best_turns` makes at most.

    Examples:
        >>> most_tries(MapSettings(turn_sweeps=0), segments=4)
        0
    """
    return 2 * segments * settings.turn_sweeps
