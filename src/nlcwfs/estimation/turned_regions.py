"""Regions of a phase that fit their surroundings better when moved by a whole turn: the cheapest cut between cells."""

from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

NEIGHBOURS = ((1, 0, 1.0), (0, 1, 1.0), (1, 1, 0.5), (1, -1, 0.5))
"""Rows, columns and weight of a neighbour; with the diagonals a slanted rim is hardly longer than a straight one."""

CAPACITY = 100
"""Steps of one rad^2 in the capacities, which the search for the cheapest cut wants as whole numbers."""

LOCAL_CELLS = 5.0
"""Slopes wider than this are taken out first, so that long cuts along a steep slope of the turbulence are not cheap."""

ROUNDS = 3
"""Moves by one turn in a row: one of them cannot bring back islands that are too high and too low."""

SMALLEST = 8
"""Cells of the smallest region that is worth a look."""


class TurnedRegion(NamedTuple):
    """Cells that may be a turn off.

    Attributes:
        cells: Where.
        turns: How many more, positive or negative, bring them back.
    """

    cells: Bool[np.ndarray, "y x"]
    turns: int


def turned_regions(
    phase_rad: Float[np.ndarray, "y x"], lit: Bool[np.ndarray, "y x"], *, ease: float = 1.0
) -> list[TurnedRegion]:
    r"""Connected regions whose move by a turn makes neighbours more alike, the largest first; the main one stays.

    Of all ways to move cells by a turn, one after the other, that with the least :math:`\sum w\,(\phi_p - \phi_q)^2`
    over neighbours, exactly, as the minimum cut of a graph (Bioucas-Dias & Valadao 2007, IEEE Trans. Image Process. 16,
    698).

    Args:
        phase_rad: A rough phase, unwrapped as far as is known.
        lit: Where it is known.
        ease: Below 1 a rim costs less than it should, and regions are found that are only perhaps turned.

    Examples:
        >>> phase_rad = np.zeros((16, 16))
        >>> phase_rad[:4, 3:8] += 6.0
        >>> [(int(one.cells.sum()), one.turns) for one in turned_regions(phase_rad, np.ones((16, 16), bool))]
        [(20, -1)]
    """
    local_rad = _local(np.asarray(phase_rad, float), lit)
    turns = np.zeros(lit.shape, int)
    for _ in range(ROUNDS):
        moved = _cheapest_move(local_rad + 2 * np.pi * turns, lit, ease)
        if moved.all(where=lit) or not moved.any():
            break
        turns += moved
    parts = []
    for turn in np.unique(turns[lit]):
        labels, count = scipy.ndimage.label(lit & (turns == turn))  # pyright: ignore
        parts += [TurnedRegion(labels == label, int(turn)) for label in range(1, count + 1)]
    parts.sort(key=lambda part: -int(part.cells.sum()))
    still = parts[0].turns
    others = [TurnedRegion(part.cells, part.turns - still) for part in parts[1:]]
    return [part for part in others if part.turns and part.cells.sum() >= SMALLEST]


def _local(phase_rad: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """The phase without its mean over the surroundings."""
    inside = np.where(lit, phase_rad, 0)
    sums = [scipy.ndimage.gaussian_filter(part, LOCAL_CELLS) for part in (inside, lit.astype(float))]
    return np.where(lit, inside - sums[0] / np.where(lit, sums[1], 1), 0)


def _cheapest_move(phase_rad: np.ndarray, lit: np.ndarray, ease: float) -> np.ndarray:
    """Cells on the source's side of the minimum cut: those that gain by a turn more."""
    count = int(lit.sum())
    number = np.full(lit.shape, -1)
    number[lit] = np.arange(count)
    alone, edges = np.zeros(count), []
    for rows, columns, weight in NEIGHBOURS:
        here, there = _pairs(lit.shape, rows, columns)
        both = lit[here] & lit[there]
        a, b = number[here][both], number[there][both]
        # (d + 2 pi)^2 - d^2 = 4 pi^2 + 4 pi d: the first part is paid at a rim only, the second by each cell alone.
        linear = weight * 4 * np.pi * (phase_rad[here][both] - phase_rad[there][both])
        alone += np.bincount(a, linear, count) - np.bincount(b, linear, count)
        rim = np.full(len(a), weight * 4 * np.pi**2 * ease)
        edges += [(a, b, rim), (b, a, rim)]
    source, sink, every = count, count + 1, np.arange(count)
    edges.append((np.where(alone > 0, every, source), np.where(alone > 0, sink, every), np.abs(alone)))
    begin, end, cost = (np.concatenate(part) for part in zip(*edges, strict=True))
    capacity = np.round(cost * CAPACITY).astype(np.int32)
    graph = coo_array((capacity, (begin, end)), shape=(count + 2, count + 2)).tocsr()
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = breadth_first_order(left, source, return_predecessors=False)
    moved = np.zeros(count + 2, bool)
    moved[reached] = True
    found = np.zeros(lit.shape, bool)
    found[lit] = moved[:count]
    return found


def _pairs(shape: tuple[int, ...], rows: int, columns: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Each cell and its neighbour so many rows below and columns to the right (left if negative)."""
    height, width = shape
    here = slice(0, height - rows), slice(max(0, -columns), width - max(0, columns))
    there = slice(rows, height), slice(max(0, columns), width - max(0, -columns))
    return here, there
