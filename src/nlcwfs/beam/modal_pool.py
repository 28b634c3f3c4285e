"""Orthonormal functions on the pupil at hand, from the standing waves of a disc around it."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nlcwfs.beam.disc_harmonics import orthonormal_shells, sample_waves
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.mirror_images import EVEN, ODD, SINE, Quarter

CLEAN = 1e-13
"""Products of orthonormal modes are 0 and 1 to this much, a few hundred roundings; else a second pass mends them."""


class Pool(NamedTuple):
    """Orthonormal functions on a pupil.

    Attributes:
        rows: Function times root.
        kinds: Kind of each, see `beam.mirror_images`; those of different kinds are orthogonal.
        cycles: Cycles per aperture of each.
        root: Root of the light that each pixel stands for.
        quarter: The pixels.
    """

    rows: Float[np.ndarray, "mode pixel"]
    kinds: Int[np.ndarray, " mode"]
    cycles: Float[np.ndarray, " mode"]
    root: Float[np.ndarray, " pixel"]
    quarter: Quarter


def orthonormal_pool(grid: Grid, weights: np.ndarray, diameter_m: float, enough: int) -> tuple[Pool, float]:
    """So many, but for rounding, without piston, and those of their shell; and the raw condition."""
    lit, quarter = weights > 0, Quarter.of(weights, grid)
    y_m, x_m = np.broadcast_arrays(grid.y_m, grid.x_m)
    radius_m = max(diameter_m / 2, float(np.hypot(y_m, x_m)[lit].max()) - grid.pixel_m)
    finest = math.pi * radius_m / grid.pixel_m  # k R of half a cycle per pixel
    # Weyl: the lit area A carries A k^2 / (4 pi) waves, less at its edges; 40 more cover the low end.
    light_area_m2 = grid.pixel_m**2 * int(lit.sum())
    wanted = math.sqrt(4 * math.pi * (1.1 * enough + 40) / light_area_m2) * radius_m
    root = np.sqrt(weights[quarter.lit] * quarter.times)
    slow = np.stack([np.ones_like(root), x_m[quarter.lit], y_m[quarter.lit]])
    while True:
        waves, numbers, kinds = sample_waves(grid, quarter.lit, radius_m=radius_m, largest=min(wanted, finest))
        waves, numbers = np.concatenate([slow, waves]) * root, np.concatenate([np.zeros(len(slow)), numbers])
        kinds = quarter.kinds(np.concatenate([[EVEN, ODD, ODD + SINE], kinds]))
        waves /= np.linalg.norm(waves, axis=1)[:, None]
        products = np.where(kinds[:, None] == kinds, waves @ waves.T, 0)
        mixing = orthonormal_shells(products, numbers, kinds, first=len(slow), enough=enough)
        if len(mixing.numbers) >= enough or wanted >= finest:
            break
        wanted *= 1.2
    used = int(np.sum(numbers < math.pi * (math.floor(mixing.numbers[-1] / math.pi) + 1)))
    spread = np.linalg.eigvalsh(products[len(slow) : used, len(slow) : used])
    raw_condition = math.sqrt(spread[-1] / max(spread[0], np.finfo(float).eps * spread[-1]))
    cycles = mixing.numbers / (math.pi * 2 * radius_m) * diameter_m
    tilt_cycles = 0.5  # an aperture-wide ramp is half a period
    cycles[1:3] = tilt_cycles
    rows = mixing.coefficients[:used, 1:].T @ waves[:used]
    return Pool(rows, mixing.kinds[1:], cycles[1:], root, quarter), raw_condition


def cleaned(pool: Pool) -> tuple[Pool, float]:
    """Take out what rounding has left of piston and of other modes, where there is any; and the condition."""
    rows, same = pool.rows, pool.kinds[:, None] == pool.kinds
    products = np.where(same, rows @ rows.T, 0)
    for _ in range(2):  # each squares what is wrong
        wrong, piston = products - np.eye(len(rows)), np.where(pool.kinds == EVEN, rows @ pool.root, 0)
        if max(np.abs(wrong).max(), np.abs(piston).max()) < CLEAN:
            break
        rows = rows - wrong @ rows / 2 - piston[:, None] * pool.root
        products = np.where(same, rows @ rows.T, 0)
    spread = np.linalg.eigvalsh(products)
    return pool._replace(rows=rows), float(np.sqrt(spread[-1] / spread[0]))
