"""Pupils that are their own mirror image along both axes: a quarter of the pixels tells everything."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from nlcwfs.beam.grid import Grid

EVEN, ODD, SINE = 0, 1, 2
"""A wave `cos(m t)` is of kind `EVEN` or `ODD`, as its order is; of a wave `sin(m t)` the kind is `SINE` more."""

ALIKE = 1e-9
"""Rounding of a pupil's amplitude, relative to the brightest pixel."""


class Quarter(NamedTuple):
    """The pixels of a pupil that stand for all: those at y >= 0 and x >= 0 if it is symmetric, else every one.

    Functions on a symmetric pupil are of four kinds, even or odd along each axis. Functions of different kinds are
    orthogonal, whatever a quarter of their pixels says; without symmetry all are of one kind.

    Attributes:
        folded: Whether it is a quarter.
        lit: The lit pixels that stand for all.
        times: How many lit pixels each of them stands for.
    """

    folded: bool
    lit: Bool[np.ndarray, "y x"]
    times: Float[np.ndarray, " pixel"]

    @classmethod
    def of(cls, weights: Float[np.ndarray, "y x"], grid: Grid) -> "Quarter":
        """Look whether a pupil is symmetric.

        Examples:
            >>> Quarter.of(np.ones((4, 3)), Grid((4, 3), 1.0)).times
            array([2., 4., 2., 4.])
        """
        lit = weights > 0
        close = ALIKE * weights.max()
        folded = all(
            np.array_equal(lit, np.flip(lit, axis)) and np.allclose(weights, np.flip(weights, axis), rtol=0, atol=close)
            for axis in (0, 1)
        )
        if not folded:
            return cls(folded, lit, np.ones(int(lit.sum())))
        there = [np.where(axis > 0, 2.0, axis == 0) for axis in (grid.y_m, grid.x_m)]
        times = there[0] * there[1]
        lit = lit & (times > 0)
        return cls(folded, lit, times[lit])

    def kinds(self, kinds: Int[np.ndarray, " function"]) -> Int[np.ndarray, " function"]:
        """Kinds that are orthogonal here."""
        return kinds if self.folded else np.zeros_like(kinds)

    def images(self, values: Float[np.ndarray, "function pixel"], kind: int) -> Float[np.ndarray, "function y x"]:
        """Functions of a kind on all pixels, from their values on those that stand for all."""
        images = np.zeros((len(values), *self.lit.shape))
        images[:, self.lit] = values
        if self.folded:
            (ny, nx), (sign_y, sign_x) = self.lit.shape, _signs(kind)
            images[:, : ny // 2] = sign_y * images[:, ny - ny // 2 :][:, ::-1]
            images[:, :, : nx // 2] = sign_x * images[:, :, nx - nx // 2 :][:, :, ::-1]
        return images

    def part(self, images: Float[np.ndarray, "function y x"], kind: int) -> Float[np.ndarray, "function pixel"]:
        """The part of a kind in images, on the pixels that stand for all."""
        if not self.folded:
            return images[:, self.lit]
        sign_y, sign_x = _signs(kind)
        row, column = np.nonzero(self.lit)
        across = images[:, row, column] + sign_x * images[:, row, -1 - column]
        return (across + sign_y * (images[:, -1 - row, column] + sign_x * images[:, -1 - row, -1 - column])) / 4


def _signs(kind: int) -> tuple[int, int]:
    """What a flip of y, and of x, makes of a function; cos(m t) and sin(m t) with t from x to y."""
    sine, odd = kind & SINE, kind & ODD
    return (-1 if sine else 1), (-1 if bool(sine) != bool(odd) else 1)
