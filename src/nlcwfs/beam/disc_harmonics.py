"""The standing waves of a disc: smooth functions, evenly sharp everywhere, from which modes are made."""

import math

import numpy as np
from jaxtyping import Float
from scipy.special import jnp_zeros, jv

from nlcwfs.beam.grid import Grid

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
) -> tuple[Float[np.ndarray, "pixel wave"], Float[np.ndarray, " wave"]]:
    """The waves with `k R` up to `largest` on the lit pixels, and `k R` of each; cosine before sine."""
    y_m, x_m = np.broadcast_arrays(grid.y_m, grid.x_m)
    angle_rad = np.arctan2(y_m, x_m)[lit]
    # The symmetry of the grid leaves few different radii, and Bessel functions are what costs here.
    levels, level = np.unique(np.round(np.hypot(y_m, x_m)[lit] / radius_m, 12), return_inverse=True)
    waves, numbers = [], []
    for number, order in standing_waves(largest):
        radial = jv(order, number * levels)[level]
        waves.append(radial * np.cos(order * angle_rad))
        if order > 0:
            waves.append(radial * np.sin(order * angle_rad))
        numbers += [number] * (1 if order == 0 else 2)
    return np.stack(waves, axis=1), np.array(numbers)


def orthonormal_shells(
    start: Float[np.ndarray, "pixel first"],
    waves: Float[np.ndarray, "pixel wave"],
    numbers: Float[np.ndarray, " wave"],
    *,
    enough: int,
) -> tuple[Float[np.ndarray, "pixel kept"], Float[np.ndarray, " kept"]]:
    """Add waves to an orthonormal start, a shell of frequencies at a time, dropping what is not new.

    Each shell (one cycle per aperture wide) is cleaned of what is already spanned, twice ("twice is enough",
    Parlett 1980, sec. 6.9), then orthonormalised by a singular value decomposition. A shell that is new as a
    whole becomes the orthonormal set nearest to the waves themselves; of another, the new directions stay.

    Args:
        enough: Stop after the shell that brings this many columns.
    """
    basis, labels = start, [0.0] * start.shape[1]
    shells = np.floor(numbers / math.pi)
    for shell in np.unique(shells):
        members = np.flatnonzero(shells == shell)
        new = waves[:, members] / np.linalg.norm(waves[:, members], axis=0)
        for _ in range(2):
            new = new - basis @ (basis.T @ new)
        left, size, right = np.linalg.svd(new, full_matrices=False)
        keep = size > WORTH_KEEPING
        if keep.all():
            added, label = left @ right, numbers[members]
        else:
            label = (right[keep] ** 2) @ numbers[members]
            order = np.argsort(label, kind="stable")
            added, label = left[:, keep][:, order], label[order]
        basis = np.hstack([basis, added])
        labels += label.tolist()
        if basis.shape[1] >= enough:
            break
    return basis, np.array(labels)
