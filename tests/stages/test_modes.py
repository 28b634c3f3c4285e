"""Modal bases: orthonormal on every kind of pupil, complete, the right way round."""

import jax
import numpy as np
import pytest

from nlcwfs.beam.disc_harmonics import modes_up_to
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.mirror_images import Quarter
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import Spiders, circular_pupil, pupil_of_discs
from nlcwfs.errors import SamplingError, SettingsError


def ring(count, radius_m, first_deg):
    angles_rad = np.deg2rad(first_deg + 360 / count * np.arange(count))
    return [(radius_m * float(np.sin(a)), radius_m * float(np.cos(a))) for a in angles_rad]


def grid_across(pixels, diameter_m):
    return Grid((pixels + 2, pixels + 5), diameter_m / pixels)


def circle(pixels):
    grid = grid_across(pixels, 8.0)
    return circular_pupil(grid, diameter_m=8.0), grid, 8.0


def crossed(pixels):
    grid = grid_across(pixels, 8.0)
    spiders = Spiders((10.0, 95.0, 190.0, 300.0), 0.1)
    return circular_pupil(grid, diameter_m=8.0, obstruction_ratio=0.3, spiders=spiders), grid, 8.0


def sparse(pixels):
    grid = grid_across(pixels, 8.0)
    return pupil_of_discs(grid, centres_m=ring(4, 2.7, 20.0), disc_diameter_m=2.4), grid, 8.0


def segmented(pixels):
    grid = grid_across(pixels, 25.4)
    centres_m = [(0.0, 0.0), *ring(6, 8.71, 30.0)]
    return pupil_of_discs(grid, centres_m=centres_m, disc_diameter_m=8.365), grid, 25.4


@pytest.fixture(scope="module")
def on_crossed():
    pupil, grid, diameter_m = crossed(45)
    return modal_basis(pupil, grid, diameter_m=diameter_m, count=400), pupil, grid


@pytest.mark.parametrize(
    ("telescope", "pixels", "count", "kind"),
    [
        (circle, 45, 820, "karhunen-loeve"),
        (circle, 45, 820, "disc-harmonics"),
        (crossed, 45, 820, "karhunen-loeve"),
        (crossed, 45, 820, "disc-harmonics"),
        (segmented, 45, 820, "karhunen-loeve"),
        (sparse, 45, 400, "karhunen-loeve"),
        (sparse, 45, 400, "disc-harmonics"),
        (sparse, 90, 820, "karhunen-loeve"),
    ],
)
def test_modes_are_orthonormal_on_the_light_of_any_pupil(telescope, pixels, count, kind):
    pupil, grid, diameter_m = telescope(pixels)
    basis = modal_basis(pupil, grid, diameter_m=diameter_m, count=count, kind=kind)
    light = np.where(pupil >= 0.1, pupil, 0) ** 2  # dimmer rim pixels carry no mode, see `modes.DIM`
    lit = light > 0
    modes = np.asarray(basis.modes)[:, lit]
    assert len(modes) == count
    weighted = modes * light[lit] / light.sum()
    np.testing.assert_allclose(weighted @ modes.T, np.eye(count), atol=1e-12)  # rounding of 800 projections
    np.testing.assert_allclose(weighted.sum(axis=1), 0, atol=1e-12)
    assert not np.asarray(basis.modes)[:, ~lit].any()
    assert 0 <= basis.condition - 1 < 1e-12
    assert np.abs(modes).max() < 100  # no mode lives on a few dim rim pixels alone
    assert np.all(np.diff(basis.cycles_per_aperture) >= -1e-9)


def test_the_first_modes_are_tilt_and_grow_towards_plus_x_and_y(on_crossed):
    basis, _, grid = on_crossed
    share = basis.weights[np.newaxis] * basis.modes[:2]
    along_x, along_y = (share * grid.x_m).sum(axis=(1, 2)), (share * grid.y_m).sum(axis=(1, 2))
    # The pupil is not symmetric: the strongest two modes are ramps, somewhat turned and bent.
    assert sorted([np.argmax(np.abs([along_x[i], along_y[i]])) for i in (0, 1)]) == [0, 1]
    rms_m = np.sqrt((basis.weights * (grid.x_m**2 + grid.y_m**2) / 2).sum())
    assert max(along_x) == pytest.approx(rms_m, rel=0.06)
    assert max(along_y) == pytest.approx(rms_m, rel=0.06)


def test_a_wavefront_made_of_modes_comes_back(on_crossed):
    basis, _, _ = on_crossed
    coefficients_m = np.random.default_rng(3).normal(size=basis.count) * 1e-8
    np.testing.assert_allclose(basis.project(basis.combine(coefficients_m)), coefficients_m, atol=1e-20)


def test_the_rms_is_the_root_of_the_summed_squares(on_crossed):
    basis, _, _ = on_crossed
    coefficients_m = np.random.default_rng(4).normal(size=basis.count) * 1e-8
    opd_m = np.asarray(basis.combine(coefficients_m))
    rms_m = np.sqrt((np.asarray(basis.weights) * opd_m**2).sum())
    assert rms_m == pytest.approx(np.sqrt((coefficients_m**2).sum()), rel=1e-12)


def test_an_oblique_ripple_survives_the_modes_unflipped(on_crossed):
    basis, _, grid = on_crossed
    ripple_m = 1e-8 * np.sin(2 * np.pi * (3 * grid.x_m + 1.5 * grid.y_m + 1.0) / 8)
    fitted_m = np.asarray(basis.combine(basis.project(ripple_m)))
    weights = np.asarray(basis.weights)
    left_m = ripple_m - (weights * ripple_m).sum() - fitted_m
    # 3.4 cycles with 400 modes, to 12 cycles and more: 3 % is left at the edges; flipped it would be 140 %.
    assert np.sqrt((weights * left_m**2).sum() / (weights * ripple_m**2).sum()) < 0.03


def test_nan_outside_the_pupil_is_not_looked_at(on_crossed):
    basis, _, grid = on_crossed
    opd_m = np.where(np.asarray(basis.weights) > 0, 1e-9 * grid.x_m * np.ones(grid.shape), np.nan)
    assert np.all(np.isfinite(basis.project(opd_m)))


def test_single_precision_stays_single(on_crossed):
    basis, _, _ = on_crossed
    coefficients = np.linspace(-1, 1, basis.count, dtype=np.float32)
    back = jax.jit(lambda basis, c: basis.project(basis.combine(c)))(basis, coefficients)
    assert back.dtype == np.float32
    np.testing.assert_allclose(back, coefficients, atol=2e-5)  # rounding of sums over 1500 pixels


def test_combine_is_the_transpose_of_project(on_crossed):
    basis, _, grid = on_crossed
    random = np.random.default_rng(5)
    opd, coefficients = random.normal(size=grid.shape), random.normal(size=basis.count)
    left = np.dot(np.asarray(basis.project(opd)), coefficients)
    right = (np.asarray(basis.weights) * opd * np.asarray(basis.combine(coefficients))).sum()
    assert left == pytest.approx(right, rel=1e-10)


def test_a_basis_is_cut_by_number_and_by_frequency(on_crossed):
    basis, _, _ = on_crossed
    assert basis.first(7).count == 7
    np.testing.assert_array_equal(basis.first(7).modes, basis.modes[:7])
    slow = basis.up_to(6.0)
    assert slow.cycles_per_aperture[-1] <= 6.0 < basis.cycles_per_aperture[slow.count]
    for wrong in (0, 401):
        with pytest.raises(SettingsError, match=f"modes.count: must be between 1 and 400, got {wrong}"):
            basis.first(wrong)


def test_the_same_pupil_gives_the_same_modes_whatever_surrounds_it():
    pupil, grid, _ = circle(24)
    narrow = modal_basis(pupil, grid, diameter_m=8.0, count=60)
    wide_grid = Grid((grid.shape[0] + 10, grid.shape[1] + 4), grid.pixel_m)
    wide = modal_basis(np.pad(pupil, ((5, 5), (2, 2))), wide_grid, diameter_m=8.0, count=60)
    # 1e-7: twins are told apart by one part in a thousand, which magnifies rounding a million times at most.
    np.testing.assert_allclose(wide.modes[:, 5:-5, 2:-2], narrow.modes, atol=1e-7)


@pytest.mark.parametrize(("telescope", "pixels", "count"), [(sparse, 45, 820), (circle, 12, 200)])
def test_more_modes_than_the_pixels_carry_are_refused(telescope, pixels, count):
    pupil, grid, diameter_m = telescope(pixels)
    with pytest.raises(SamplingError, match=f"modes.count: must be at most .* half a cycle .* got {count}"):
        modal_basis(pupil, grid, diameter_m=diameter_m, count=count)


def test_no_modes_at_all_are_refused():
    pupil, grid, diameter_m = circle(12)
    with pytest.raises(SettingsError, match=r"modes.count: must be at least 1, got 0"):
        modal_basis(pupil, grid, diameter_m=diameter_m, count=0)


@pytest.mark.parametrize("cycles", [2.0, 5.0, 16.0, 25.0])
def test_the_number_of_disc_modes_follows_the_law_of_weyl(cycles):
    weyl = (np.pi * cycles) ** 2 / 4 + np.pi * cycles / 2
    # 2 sqrt(k R): the known size of the ripple about Weyl's law for a disc.
    assert abs(modes_up_to(cycles) - weyl) < 2 * np.sqrt(np.pi * cycles)


def annulus(shape):
    grid = Grid(shape, 0.5)
    return circular_pupil(grid, diameter_m=7.5, obstruction_ratio=0.3), grid


def slanted(shape):
    grid = Grid(shape, 0.5)
    return circular_pupil(grid, diameter_m=7.5, spiders=Spiders((20.0, 110.0), 0.4)), grid


@pytest.mark.parametrize("telescope", [annulus, slanted])
@pytest.mark.parametrize("shape", [(16, 17), (17, 18), (19, 19), (16, 16)])
def test_turbulence_excites_the_modes_independently(telescope, shape):
    """The double sum over all pairs of pixels, of a symmetric pupil too, of which the code sums a quarter."""
    pupil, grid = telescope(shape)
    basis = modal_basis(pupil, grid, diameter_m=7.5, count=60)
    lit = np.asarray(basis.weights) > 0
    y, x = (axis[lit] / 7.5 for axis in np.broadcast_arrays(grid.y_m, grid.x_m))
    apart = np.hypot(y[:, None] - y, 1.001 * (x[:, None] - x))  # the twins are told apart, see `modes`
    structure = 6.8839 * apart ** (5 / 3)  # Fried 1965
    weighted = np.asarray(basis.modes)[:, lit] * np.asarray(basis.weights)[lit]
    covariance = -weighted @ structure @ weighted.T / 2
    expected = np.diag(basis.kolmogorov_rad2)
    # 1e-5: digits of Fried's constant; between modes rounding alone, against a tilt of 0.45 rad^2.
    np.testing.assert_allclose(np.diag(covariance), np.diag(expected), rtol=1e-5)
    np.testing.assert_allclose(covariance - np.diag(np.diag(covariance)), 0, atol=1e-12)


def test_a_quarter_stands_for_a_pupil_that_is_symmetric_and_only_for_that():
    pupil, grid = annulus((18, 19))
    folded = Quarter.of(pupil**2, grid)
    assert folded.folded
    assert folded.times.sum() == np.sum(pupil > 0)
    assert not Quarter.of(slanted((18, 19))[0], grid).folded
    dimmer = pupil**2
    dimmer[4, 9] *= 0.99
    assert not Quarter.of(dimmer, grid).folded
    upside_down = pupil[::-1] * np.linspace(1, 2, 19)  # symmetric along y alone
    assert not Quarter.of(upside_down, grid).folded
