"""Modes of a segmented pupil: orthonormal, pistons first, with the turbulence of Noll's tables."""

import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.segment_layouts import gmt
from nlcwfs.beam.segment_modes import segment_basis
from nlcwfs.beam.segments import Segment, Segments
from nlcwfs.errors import SamplingError, SettingsError

UNEQUAL = Segments((Segment(-1.0, -2.0, 2.4), Segment(1.5, 1.2, 3.2), Segment(-2.0, 2.0, 1.6)))


@pytest.fixture(scope="module")
def basis_and_labels():
    grid = Grid((60, 64), 0.125)
    labels = UNEQUAL.labels(grid)
    return segment_basis(UNEQUAL.amplitude(grid), grid, labels, diameter_m=8.0, inside=12), labels, grid


def test_they_are_orthonormal_and_without_the_piston_of_the_whole(basis_and_labels):
    basis, _, _ = basis_and_labels
    weighted = np.asarray(basis.modes) * np.asarray(basis.weights)
    products = np.einsum("ayx,byx->ab", weighted, basis.modes)
    np.testing.assert_allclose(products, np.eye(3 * 13 - 1), atol=1e-10)  # rounding of the fast waves' shells
    np.testing.assert_allclose(weighted.sum(axis=(1, 2)), 0, atol=1e-12)
    assert basis.condition == 1.0


def test_pistons_tips_and_tilts_of_all_segments_are_spanned_exactly(basis_and_labels):
    basis, labels, grid = basis_and_labels
    stand_m = np.choose(labels, [3e-7, -1e-7, 5e-8]) + np.choose(labels, [0, 2e-8, -4e-8]) * grid.x_m
    stand_m = stand_m + np.choose(labels, [1e-8, 0, 3e-8]) * grid.y_m
    first = basis.first(2)
    coefficients = np.asarray(basis.project(stand_m))
    made = np.asarray(basis.combine(coefficients))
    mean = np.sum(np.asarray(basis.weights) * stand_m)
    lit = np.asarray(basis.weights) > 0
    np.testing.assert_allclose(made[lit], (stand_m - mean)[lit], atol=1e-15)
    # Pistons, then two ramps of every segment: no other mode is needed.
    ramps = [2 + 12 * number + axis for number in range(3) for axis in (0, 1)]
    others = np.setdiff1d(np.arange(basis.count), [0, 1, *ramps])
    np.testing.assert_allclose(coefficients[others], 0, atol=1e-20)
    for number in range(3):
        own = labels == number
        assert np.ptp(np.asarray(first.modes)[:, own & lit], axis=1).max() < 1e-12


def test_the_turbulence_of_a_tilt_is_nolls():
    grid = Grid((128, 132), 0.06)
    labels = UNEQUAL.labels(grid)
    basis = segment_basis(UNEQUAL.amplitude(grid), grid, labels, diameter_m=8.0)
    weights = np.asarray(basis.weights)
    for number, width_m in enumerate((2.4, 3.2, 1.6)):
        share = weights[labels == number].sum()
        along = np.asarray(basis.kolmogorov_rad2)[2 + 2 * number : 4 + 2 * number]
        # Noll 1976, table 4: 0.449 (d / r0)^(5/3) of a disc; a mode has its rms over the whole pupil.
        # 3 %: rim cells have the square of their amplitude.
        np.testing.assert_allclose(along / share, 0.449 * (width_m / 8) ** (5 / 3), rtol=0.03)


def test_the_turbulence_of_a_piston_is_that_of_a_sum_over_pairs_of_pixels():
    grid = Grid((12, 20), 0.4)
    discs = Segments((Segment(0.3, -2.0, 2.4), Segment(-0.2, 2.1, 3.0)))
    labels = discs.labels(grid)
    basis = segment_basis(discs.amplitude(grid), grid, labels, diameter_m=8.0, inside=0)
    y, x = (axis.ravel() for axis in np.broadcast_arrays(grid.y_m, grid.x_m))
    apart = np.hypot(y[:, None] - y, (x[:, None] - x) * 1.001) / 8
    weighted = (np.asarray(basis.weights) * np.asarray(basis.modes)[0]).ravel()
    direct = -0.5 * weighted @ (6.8839 * apart ** (5 / 3)) @ weighted
    assert float(basis.kolmogorov_rad2[0]) == pytest.approx(direct, rel=1e-3)  # digits of 6.88


def test_gmt_has_six_pistons_and_fourteen_ramps():
    grid = Grid((90, 90), 0.29)
    segments = gmt()
    basis = segment_basis(segments.amplitude(grid), grid, segments.labels(grid), diameter_m=25.448)
    assert basis.count == 6 + 14
    assert (np.asarray(basis.kolmogorov_rad2) > 0).all()
    assert np.all(np.diff(np.asarray(basis.cycles_per_aperture)[:6]) == pytest.approx(0, abs=0.1))


def test_what_cannot_be_is_refused_in_one_line():
    grid = Grid((16, 16), 0.5)
    two = Segments((Segment(0.0, -2.0, 3.0), Segment(0.0, 2.0, 3.0)))
    pupil, labels = two.amplitude(grid), two.labels(grid)
    with pytest.raises(SettingsError, match=r"modes\.inside: must be at least 0, got -1"):
        segment_basis(pupil, grid, labels, diameter_m=8.0, inside=-1)
    with pytest.raises(SettingsError, match="let some light through, got none on 1"):
        segment_basis(np.where(labels == 1, 0, pupil), grid, labels, diameter_m=8.0)
    with pytest.raises(SamplingError, match=r"modes\.count: must be at most"):
        segment_basis(pupil, grid, labels, diameter_m=8.0, inside=200)
