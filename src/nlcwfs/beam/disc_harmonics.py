"""The standing waves of a disc: smooth functions, evenly sharp everywhere, from which modes are made."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import jnp_zeros, jv

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.mirror_images import EVEN, ODD, SINE

WORTH_KEEPING = 0.1
"""A wave is dropped when less than this part of its rms is new to the pupil: it would come back amplified."""


def standing_waves(largest: float) -> list[tuple[float, int]]:
    """Wave number times radius, and azimuthal order, of the waves of a disc whose edge is free.

    Waves `J_m(k r) cos(m t)` and `J_m(k r) sin(m t)` with zero slope at the edge, `J_m'(k R) = 0`. They are
    ordered by frequency; piston (k = 0) is left out.

    Args:
        largest: Highest `k R` wanted; `k R = pi * (cycles per aperture)`.

    Examples:
        >>> [(round(k, 3), m) for k, m in standing_waves(3.9)]
        [(1.841, 1), (3.054, 2), (3.832, 0)]
    """
    found: list[tuple[float, int]] = []
    for order in range(int(largest) + 2):  # the first zero of J_m' lies beyond m
        zeros = jnp_zeros(order, max(1, math.ceil((largest - order) / math.pi) + 2))
        found += [(float(zero), order) for zero in zeros if zero <= largest]
    return sorted(found)


def modes_up_to(cycles_per_aperture: float) -> int:
    """How many modes a full circle has up to a spatial frequency: the waves of a disc, piston left out.

    Close to `(pi c)^2 / 4 + pi c / 2` (Weyl's law for a free edge).

    Examples:
        >>> modes_up_to(16.0)
        653
    """
    return sum(1 if order == 0 else 2 for _, order in standing_waves(math.pi * cycles_per_aperture))


def sample_waves(
    grid: Grid, lit: np.ndarray, *, radius_m: float, largest: float
) -> tuple[Float[np.ndarray, "wave pixel"], Float[np.ndarray, " wave"], Int[np.ndarray, " wave"]]:
    """The waves with `k R` up to `largest` on the lit pixels, `k R` and kind of each; cosine before sine."""
    y_m, x_m = np.broadcast_arrays(grid.y_m, grid.x_m)
    angle_rad = np.arctan2(y_m, x_m)[lit]
    # The symmetry of the grid leaves few different radii, and Bessel functions are what costs here.
    levels, level = np.unique(np.round(np.hypot(y_m, x_m)[lit] / radius_m, 12), return_inverse=True)
    found = standing_waves(largest)
    turns = {order: (np.cos(order * angle_rad), np.sin(order * angle_rad)) for _, order in found}
    waves, numbers, kinds = [], [], []
    for number, order in found:
        radial, pair = jv(order, number * levels)[level], 1 if order == 0 else 2
        waves += [radial * turn for turn in turns[order][:pair]]
        numbers += [number] * pair
        kinds += [(EVEN, ODD)[order % 2] + kind for kind in (0, SINE)[:pair]]
    return np.stack(waves), np.array(numbers), np.array(kinds)


class Mixing(NamedTuple):
    """How orthonormal functions are made of others.

    Attributes:
        coefficients: Of each function that is given, in each that is made.
        numbers: `k R` of what is made.
        kinds: Its kind, see `beam.mirror_images`.
    """

    coefficients: Float[np.ndarray, "wave kept"]
    numbers: Float[np.ndarray, " kept"]
    kinds: Int[np.ndarray, " kept"]


def orthonormal_shells(
    products: Float[np.ndarray, "wave wave"],
    numbers: Float[np.ndarray, " wave"],
    kinds: Int[np.ndarray, " wave"],
    *,
    first: int,
    enough: int,
) -> Mixing:
    """Combine functions to orthonormal ones, a shell of frequencies at a time, dropping what is not new.

    Only the products of the functions are needed, not the functions on their many pixels. The first ones are taken
    in their order (Cholesky). Each shell (one cycle per aperture wide) is then cleaned of what is already spanned. A
    shell that is new as a whole becomes the orthonormal set nearest to the waves themselves; of another, the new
    directions stay.

    Args:
        products: Mean products of functions of unit rms; zero between kinds.
        numbers: `k R` of each; 0 for the first ones.
        kinds: Kind of each.
        first: How many come before the shells.
        enough: Stop after the shell that brings this many functions.
    """
    corner = np.linalg.inv(np.linalg.cholesky(products[:first, :first])).T
    mixing = np.vstack([corner, np.zeros((len(products) - first, first))])
    labels, of_kind = [numbers[:first]], [kinds[:first]]
    shells = np.where(np.arange(len(numbers)) < first, -1, np.floor(numbers / math.pi))
    for shell in np.unique(shells[first:]):
        for kind in np.unique(kinds[shells == shell]):
            members = np.flatnonzero((shells == shell) & (kinds == kind))
            added, label = _new_directions(mixing, products, members, numbers[members])
            mixing = np.hstack([mixing, added])
            labels.append(label)
            of_kind.append(np.full(len(label), kind))
        if mixing.shape[1] >= enough:
            break
    found, of_kind = np.concatenate(labels), np.concatenate(of_kind)
    order = np.argsort(found, kind="stable")
    return Mixing(mixing[:, order], found[order], of_kind[order])


def _new_directions(
    mixing: np.ndarray, products: np.ndarray, members: np.ndarray, numbers: np.ndarray
) -> tuple[Float[np.ndarray, "wave new"], Float[np.ndarray, " new"]]:
    """What some functions add to those that are mixed already, and `k R` of it."""
    spanned = mixing.T @ products[:, members]
    square, turn = np.linalg.eigh(products[np.ix_(members, members)] - spanned.T @ spanned)
    keep = square > WORTH_KEEPING**2
    turn, size = turn[:, keep], np.sqrt(square[keep])
    new = -mixing @ spanned
    new[members] += np.eye(len(members))
    if keep.all():
        return new @ (turn / size) @ turn.T, numbers
    strongest = np.take_along_axis(turn, np.argmax(np.abs(turn), axis=0)[None, :], axis=0)
    return new @ (turn * (np.sign(strongest) / size)), (turn.T**2) @ numbers
