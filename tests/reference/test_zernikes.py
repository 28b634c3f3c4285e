"""Zernikes against packages written by others."""

import aotools
import hcipy
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.zernike import nm_to_noll, noll_to_nm, zernike, zernikes

GRID = Grid((46, 52), 0.1)  # even, wider than high: a swapped axis cannot pass
DIAMETER_M = 4.4
INSIDE = np.hypot(GRID.y_m, GRID.x_m) < DIAMETER_M / 2 - GRID.pixel_m


@pytest.mark.parametrize("noll", range(2, 16))
def test_zernikes_agree_with_hcipy(noll):
    points = hcipy.CartesianGrid(
        hcipy.UnstructuredCoords([(GRID.x_m + 0 * GRID.y_m).ravel(), (GRID.y_m + 0 * GRID.x_m).ravel()])
    )
    theirs = np.asarray(hcipy.zernike(*hcipy.noll_to_zernike(noll), D=DIAMETER_M, grid=points))
    ours = zernike(noll, GRID, diameter_m=DIAMETER_M)
    # 1e-10: the same polynomials at the same points, nothing but rounding.
    np.testing.assert_allclose(ours[INSIDE], theirs.reshape(GRID.shape)[INSIDE], atol=1e-10)


@pytest.mark.parametrize("noll", range(2, 16))
def test_zernikes_agree_with_aotools(noll):
    pixels = 44
    theirs = aotools.zernike_noll(noll, pixels)
    grid = Grid((pixels, pixels), 1.0)
    ours = zernike(noll, grid, diameter_m=float(pixels))
    inside = np.hypot(grid.y_m, grid.x_m) < pixels / 2 - 1
    np.testing.assert_allclose(ours[inside], theirs[inside], atol=1e-3)


def test_noll_indices_agree_with_aotools_to_1100():
    for noll in range(1, 1101):
        assert noll_to_nm(noll) == tuple(aotools.zernIndex(noll))
        assert nm_to_noll(*noll_to_nm(noll)) == noll


def test_radial_polynomials_hold_their_digits_to_noll_1000():
    grid = Grid((1, 101), 0.02)  # along +x the angle is 0: sines vanish, cosines show the radial polynomial
    stack = zernikes(1000, grid, diameter_m=2.0)[:, 0, :]
    for noll in (496, 703, 990, 1000):
        n, m = noll_to_nm(noll)
        exact = exact_radial(n, abs(m), np.arange(-50, 51))
        scale = np.sqrt((n + 1) * (1 if m == 0 else 2))
        side = np.where(np.arange(-50, 51) < 0, (-1.0) ** m, 1.0)
        expected = scale * exact * side if m >= 0 else np.zeros(101)
        # 1e-9 of values up to 60: rounding of a recurrence of 45 steps (a sine sees sin(m pi) too).
        np.testing.assert_allclose(stack[noll - 1], expected, atol=1e-9)


def exact_radial(n, m, fiftieths):
    """The textbook sum of factorials in exact integers; float64 would lose all digits here."""
    from fractions import Fraction
    from math import factorial

    values = []
    for r in (Fraction(abs(int(i)), 50) for i in fiftieths):
        total = Fraction(0)
        for k in range((n - m) // 2 + 1):
            bottom = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
            total += Fraction((-1) ** k * factorial(n - k), bottom) * r ** (n - 2 * k)
        values.append(float(total))
    return np.array(values)
