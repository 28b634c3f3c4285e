"""What the modes of a pupil show again when the wind has carried the air on, rim included.

Frozen air is the same air a step further: the covariance of what two displaced pupils see of it tells both how much of
the next wavefront is known, and what comes in over the rim (Poyneer, Macintosh & Veran 2007, JOSA A 24, 2645, in
Fourier modes, without the rim).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.modes import ModalBasis

FEW = 16
"""Modes that are smeared at a time."""

INSIDE = ((-0.75, 0.125), (-0.25, 0.375), (0.25, 0.375), (0.75, 0.125))
"""Distances in a cell and their weights: two cells see their own means of the phase."""

LEAST = 1e-9
"""Smallest share of new air in any combination of modes, of the largest: below, rounding rules."""

DIRECTIONS = 12
"""Of a wind whose direction is not known."""


class Step(NamedTuple):
    """How the modes of the next frame follow from those of this one: `next = again @ now + new air`.

    Attributes:
        again: What is seen again.
        new: Covariance of the new air, squared unit of the modes.
    """

    again: Float[np.ndarray, "mode mode"]
    new: Float[np.ndarray, "mode mode"]


def displaced_covariance(
    basis: ModalBasis, pixel_m: float, air: Turbulence, moves_m: Sequence[tuple[float, float]]
) -> Float[np.ndarray, "mode mode"]:
    """Covariance in m^2 of the modes after the air has moved, and before: the mean over several moves.

    For modes without piston :math:`-D / 2` stands for the covariance of the air, D its structure function.

    Args:
        basis: Modes of the pupil.
        pixel_m: Their pixels.
        air: Frozen while it moves.
        moves_m: How far it moves, towards +y and +x; (0, 0) gives the covariance of one moment.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.modes import modal_basis
        >>> grid, air = Grid((24, 24), 0.1), Turbulence(0.15)
        >>> pupil = (np.hypot(grid.x_m, grid.y_m) < 1.0).astype(float)
        >>> basis = modal_basis(pupil, grid, diameter_m=2.0, count=5)
        >>> now = displaced_covariance(basis, 0.1, air, [(0.0, 0.0)])
        >>> later = displaced_covariance(basis, 0.1, air, [(0.0, 0.2)])
        >>> bool(later[0, 0] < now[0, 0]), round(1e9 * now[0, 0] ** 0.5)
        (True, 463)
    """
    weights = np.asarray(basis.weights, float)
    ny, nx = weights.shape
    kernel = np.zeros((2 * ny, nx + 1), complex)
    y = np.fft.fftfreq(2 * ny, 1 / (2 * ny))[:, None] * pixel_m
    x = np.fft.fftfreq(2 * nx, 1 / (2 * nx))[None, :] * pixel_m
    for moved_y, moved_x in moves_m:
        for (dy, share_y), (dx, share_x) in itertools.product(INSIDE, repeat=2):
            apart_m = np.hypot(y + dy * pixel_m - moved_y, x + dx * pixel_m - moved_x)
            kernel += np.asarray(scipy.fft.rfft2(-share_y * share_x / 2 * air.structure_m2(apart_m))) / len(moves_m)
    lit = weights > 0
    modes = np.asarray(basis.modes, float)
    rows = (modes * weights)[:, lit]
    smeared = np.empty_like(rows)
    for first in range(0, len(rows), FEW):
        part = slice(first, first + FEW)
        spectra = np.asarray(scipy.fft.rfft2(modes[part] * weights, s=(2 * ny, 2 * nx))) * kernel
        whole = np.asarray(scipy.fft.irfft2(spectra, s=(2 * ny, 2 * nx)))
        smeared[part] = whole[:, :ny, :nx][:, lit]
    return rows @ smeared.T


def carried(now_m2: Float[np.ndarray, "mode mode"], later_m2: Float[np.ndarray, "mode mode"]) -> Step:
    r"""The best linear prediction: :math:`A = C_1 C_0^{-1}`, and :math:`C_0 - A C_0 A^T` for what is new.

    Args:
        now_m2: Covariance of one moment.
        later_m2: Of the next with this one, see `displaced_covariance`.

    Examples:
        >>> step = carried(np.eye(2), 0.6 * np.eye(2))
        >>> step.again.round(2).tolist(), step.new.round(2).tolist()
        ([[0.6, 0.0], [0.0, 0.6]], [[0.64, 0.0], [0.0, 0.64]])
    """
    again = scipy.linalg.solve(now_m2, later_m2.T, assume_a="pos").T
    variance, shape = np.linalg.eigh(_even(now_m2 - again @ now_m2 @ again.T))
    return Step(again, (shape * np.maximum(variance, LEAST * variance[-1])) @ shape.T)


def settled_covariance(
    step: Step, information: Float[np.ndarray, "mode mode"], *, doublings: int = 12
) -> Float[np.ndarray, "mode mode"]:
    r"""Covariance of a prediction after many frames, the fixed point of :math:`P = A (P^{-1} + H)^{-1} A^T + Q`.

    By doubling (Anderson 1978, Int. J. Control 28, 295; Chu et al. 2004): each round does as many frames as all before.

    Args:
        step: A and Q.
        information: Fisher information H of one frame.
        doublings: Rounds.

    Examples:
        >>> step = Step(np.array([[0.9]]), np.array([[0.19]]))
        >>> p = settled_covariance(step, np.array([[5.0]]))
        >>> after = 1 / (1 / p + 5.0)
        >>> bool(np.isclose(p, 0.81 * after + 0.19))
        True
    """
    a, g, p = step.again.T, information, step.new
    one = np.eye(len(a))
    for _ in range(doublings):
        mixed = np.linalg.solve(one + g @ p, np.hstack([a, g]))
        turned, gained = mixed[:, : len(a)], mixed[:, len(a) :]
        p = _even(p + a.T @ p @ turned)
        g = _even(g + a @ gained @ a.T)
        a = a @ turned
    return p


def left_covariance(
    predicted: Float[np.ndarray, "mode mode"], information: Float[np.ndarray, "mode mode"]
) -> Float[np.ndarray, "mode mode"]:
    """What is left of a prediction's covariance when a frame has been seen, `(P^-1 + H)^-1` without inverting P.

    Examples:
        >>> left_covariance(np.array([[4.0]]), np.array([[0.75]])).tolist()
        [[1.0]]
    """
    root = np.linalg.cholesky(predicted)
    inner = np.linalg.cholesky(np.eye(len(root)) + root.T @ information @ root)
    half = scipy.linalg.solve_triangular(inner, root.T, lower=True)
    return half.T @ half


def _even(matrix: np.ndarray) -> np.ndarray:
    """Symmetric, against rounding."""
    return (matrix + matrix.T) / 2
