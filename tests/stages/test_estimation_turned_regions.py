"""The cheapest move of cells by a turn: against all moves there are, and on torn turbulence with islands put in."""

import itertools

import numpy as np
import pytest

from nlcwfs.estimation.turned_regions import _cheapest_move, turned_regions

TURN_RAD = 2 * np.pi


def energy(phase_rad: np.ndarray, lit: np.ndarray) -> float:
    """Weighted squares of the differences of neighbours, diagonals half, by a plain double loop."""
    total = 0.0
    for i, j in itertools.product(*map(range, phase_rad.shape)):
        for rows, columns, weight in ((1, 0, 1.0), (0, 1, 1.0), (1, 1, 0.5), (1, -1, 0.5)):
            a, b = i + rows, j + columns
            inside = 0 <= a < phase_rad.shape[0] and 0 <= b < phase_rad.shape[1]
            if inside and lit[i, j] and lit[a, b]:
                total += weight * (phase_rad[i, j] - phase_rad[a, b]) ** 2
    return total


def screen(seed: int, size: int = 64, over_cell: float = 0.3) -> np.ndarray:
    """Kolmogorov's phase (Noll 1976, eq. 21), a cell `over_cell` of r0, cut from one four times as wide."""
    frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(4 * size)], indexing="ij"))
    power = 0.0229 * over_cell ** (5 / 3) * np.maximum(frequency, 1 / (8 * size)) ** (-11 / 3)
    white = np.fft.fft2(np.random.default_rng(seed).normal(size=2 * (4 * size,)))
    return np.fft.ifft2(white * np.sqrt(power)).real[:size, :size]


@pytest.mark.parametrize("seed", range(12))
def test_no_other_move_of_any_cells_is_cheaper(seed):
    rng = np.random.default_rng(seed)
    phase_rad, lit = rng.normal(size=(3, 4)) * 4, rng.random((3, 4)) < 0.85
    cells = np.flatnonzero(lit)
    least = np.inf
    for chosen in itertools.product((0, 1), repeat=len(cells)):
        moved = phase_rad.copy()
        moved.ravel()[cells] += TURN_RAD * np.array(chosen)
        least = min(least, energy(moved, lit))
    found = _cheapest_move(phase_rad, lit, 1.0)
    # capacities are whole hundredths of a rad^2, some 50 of them
    assert energy(phase_rad + TURN_RAD * found, lit) == pytest.approx(least, abs=0.6)
    assert not found[~lit].any()


def test_some_moves_are_worth_it():
    """The test above would pass for a function that never moves if nothing ever gained."""
    gained = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        phase_rad, lit = rng.normal(size=(3, 4)) * 4, rng.random((3, 4)) < 0.85
        gained.append(_cheapest_move(phase_rad, lit, 1.0).any())
    assert sum(gained) >= 6


@pytest.mark.parametrize("seed", range(5))
def test_islands_of_both_signs_are_found_in_rough_turbulence(seed):
    rng = np.random.default_rng(100 + seed)
    y, x = np.mgrid[:64, :64] - 31.5
    lit = np.hypot(y, x) < 30
    rough_rad = screen(seed) + rng.normal(0, 0.4, (64, 64))
    high, low = lit & (np.hypot(y - 24, x + 6) < 8), lit & (np.hypot(y + 5, x - 25) < 7)
    rough_rad = rough_rad + TURN_RAD * high - TURN_RAD * low
    rough_rad[~lit] = 1e9 * rng.normal(size=np.sum(~lit))  # nobody looks there
    found = turned_regions(rough_rad, lit)
    assert len(found) == 2
    for island, turns in ((high, -1), (low, 1)):
        region = next(one for one in found if one.turns == turns)
        missed = np.sum(region.cells ^ island)
        assert missed < 0.1 * island.sum()  # the noise of the cells at the rim


@pytest.mark.parametrize("seed", range(5))
def test_turbulence_with_a_steep_tilt_has_no_island(seed):
    _, x = np.mgrid[:64, :64]
    assert turned_regions(screen(seed) + 1.0 * x, np.ones((64, 64), bool)) == []


def test_with_less_to_pay_for_a_rim_a_doubtful_region_is_named():
    phase_rad = np.zeros((24, 24))
    phase_rad[:6, 8:14] += 0.45 * TURN_RAD  # less than half a turn: as it is, it is cheaper where it is
    lit = np.ones((24, 24), bool)
    assert turned_regions(phase_rad, lit) == []
    (region,) = turned_regions(phase_rad, lit, ease=0.8)
    assert region.turns == -1
    assert region.cells.sum() == 36


def test_regions_of_some_cells_are_left_alone():
    phase_rad = np.zeros((24, 24))
    phase_rad[3:5, 3:6] += TURN_RAD
    assert turned_regions(phase_rad, np.ones((24, 24), bool)) == []
    phase_rad[3:6, 3:6] = TURN_RAD
    assert len(turned_regions(phase_rad, np.ones((24, 24), bool))) == 1
