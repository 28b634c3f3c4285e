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

SMALLEST = 8
"""Cells of the smallest region that is worth a look."""


class TurnedRegion(NamedTuple):
    """Cells that may be a turn off.

    Attributes:
        cells: Where.
        turns: 1 or -1: what brings them back.
    """

    cells: Bool[np.ndarray, "y x"]
    turns: int


def turned_regions(
    phase_rad: Float[np.ndarray, "y x"], lit: Bool[np.ndarray, "y x"], *, ease: float = 1.0
) -> list[TurnedRegion]:
    r"""Connected regions whose move by a turn makes neighbours more alike, the largest first; the main one stays.

    Of all ways to move cells by one turn the one with the least :math:`\sum w\,(\phi_p - \phi_q)^2` over neighbours,
    exactly, as the minimum cut of a graph (Bioucas-Dias & Valadao 2007, IEEE Trans. Image Process. 16, 698).

    Args:
        phase_rad: A rough phase, unwrapped as far as is known.
        lit: Where it is known.
        ease: Below 1 a rim costs less than it should, and regions are found that are only perhaps turned.

    Examples:
        >>> phase_rad = np.zeros((12, 12))
        >>> phase_rad[:4, 3:8] += 6.0
        >>> [(int(one.cells.sum()), one.turns) for one in turned_regions(phase_rad, np.ones((12, 12), bool))]
        [(20, -1)]
    """
    moved = _cheapest_move(np.asarray(phase_rad, float), lit, ease)
    parts = []
    for where, turns in ((moved & lit, 1), (~moved & lit, -1)):
        labels, count = scipy.ndimage.label(where)
        parts += [TurnedRegion(labels == label, turns) for label in range(1, count + 1)]
    parts.sort(key=lambda part: -int(part.cells.sum()))
    return [part for part in parts[1:] if part.cells.sum() >= SMALLEST]


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
