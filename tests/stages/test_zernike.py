"""Zernikes: orientation, unit rms, and their fit on pupils where they are not orthogonal."""

import jax
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders, circular_pupil, pupil_of_discs
from nlcwfs.beam.zernike import nm_to_noll, noll_to_nm, zernike, zernike_fit, zernikes
from nlcwfs.errors import SamplingError, SettingsError

GRID = Grid((50, 57), 0.2)
PUPIL = circular_pupil(GRID, diameter_m=8.0, obstruction_ratio=0.3, spiders=Spiders((10.0, 100.0, 215.0), 0.2))


def closed_forms(grid, radius_m):
    """Noll 1976, table 1, in x and y: independent of angles and radial polynomials."""
    x, y = grid.x_m / radius_m + 0 * grid.y_m, grid.y_m / radius_m + 0 * grid.x_m
    r2 = x**2 + y**2
    return {
        1: np.ones_like(x),
        2: 2 * x,
        3: 2 * y,
        4: np.sqrt(3) * (2 * r2 - 1),
        5: np.sqrt(6) * 2 * x * y,
        6: np.sqrt(6) * (x**2 - y**2),
        7: np.sqrt(8) * (3 * r2 - 2) * y,
        8: np.sqrt(8) * (3 * r2 - 2) * x,
        9: np.sqrt(8) * (3 * x**2 * y - y**3),
        10: np.sqrt(8) * (x**3 - 3 * x * y**2),
        11: np.sqrt(5) * (6 * r2**2 - 6 * r2 + 1),
    }


@pytest.mark.parametrize("noll", range(1, 12))
def test_zernikes_are_nolls_polynomials_the_right_way_round(noll):
    disc = np.hypot(GRID.y_m, GRID.x_m) <= 4.0
    expected = closed_forms(GRID, 4.0)[noll]
    np.testing.assert_allclose(zernike(noll, GRID, diameter_m=8.0)[disc], expected[disc], atol=1e-12)


def test_zernikes_are_orthonormal_on_the_disc():
    grid = Grid((200, 200), 0.01)
    weights = circular_pupil(grid, diameter_m=2.0)
    modes = zernikes(36, grid, diameter_m=2.0)[:, weights > 0]
    gram = (modes * weights[weights > 0]) @ modes.T / weights.sum()
    np.testing.assert_allclose(gram, np.eye(36), atol=5e-3)  # one edge pixel of 100 along the radius


def test_the_rim_carries_a_value_and_the_dark_does_not():
    values = zernike(4, GRID, diameter_m=8.0)
    radius_m = np.hypot(GRID.y_m, GRID.x_m)
    rim = (radius_m > 4.0) & (radius_m < 4.2)
    assert rim.sum() > 50
    np.testing.assert_allclose(values[rim], np.sqrt(3), rtol=1e-12)
    assert np.all(values[radius_m >= 4.2] == 0)


@pytest.mark.parametrize("batched", [False, True])
def test_a_fit_finds_the_coefficients_that_made_the_wavefront(batched):
    coefficients_m = 1e-9 * np.array([5, -3, 2, 7, 1, -4, 6, -2, 3, 8, -1.0])
    opd_m = sum(c * shape for c, shape in zip(coefficients_m, closed_forms(GRID, 4.0).values(), strict=True))
    opd_m = np.where(np.hypot(GRID.y_m, GRID.x_m) <= 4.0, opd_m, 0)
    pupil = np.where(np.hypot(GRID.y_m, GRID.x_m) <= 4.0, PUPIL, 0)
    fit = zernike_fit(pupil, GRID, diameter_m=8.0, count=11)
    found_m = jax.vmap(fit.coefficients)(opd_m[None])[0] if batched else fit.coefficients(opd_m)
    np.testing.assert_allclose(found_m, coefficients_m, atol=1e-21)  # rounding of a well conditioned solve


def test_the_fit_ignores_what_lies_outside_the_pupil():
    fit = zernike_fit(PUPIL, GRID, diameter_m=8.0, count=11)
    opd_m = np.where(PUPIL > 0, 2e-9, 1.0)
    np.testing.assert_allclose(fit.coefficients(opd_m), [2e-9] + [0] * 10, atol=1e-20)


def test_the_fit_ignores_nan_outside_the_pupil():
    fit = zernike_fit(PUPIL, GRID, diameter_m=8.0, count=4)
    opd_m = np.where(PUPIL > 0, 2e-9, np.nan)  # how the wavefront FITS marks the outside
    np.testing.assert_allclose(fit.coefficients(opd_m), [2e-9, 0, 0, 0], atol=1e-20)


def test_the_condition_is_that_of_the_weighted_polynomials():
    fit = zernike_fit(PUPIL, GRID, diameter_m=8.0, count=6)
    disc = PUPIL > 0
    root = PUPIL[disc] / np.sqrt((PUPIL**2).sum())
    inside = {noll: shape[disc] for noll, shape in closed_forms(GRID, 4.0).items()}
    singular = np.linalg.svd(np.array([inside[noll] for noll in range(1, 7)]) * root, compute_uv=False)
    # 2 %: dim pixels just outside the disc take the value at the edge in one and beyond it in the other.
    assert fit.condition == pytest.approx(singular[0] / singular[-1], rel=0.02)


def test_a_pupil_that_cannot_tell_zernikes_apart_is_refused():
    slit = pupil_of_discs(GRID, centres_m=[(0.0, -3.0), (0.0, 3.0)], disc_diameter_m=0.8)
    with pytest.raises(SamplingError, match=r"zernikes.count: the pupil must tell .* got 15"):
        zernike_fit(slit, GRID, diameter_m=8.0, count=15)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: noll_to_nm(0),
        lambda: nm_to_noll(2, 1),
        lambda: nm_to_noll(1, 3),
        lambda: zernikes(0, GRID, diameter_m=8.0),
        lambda: zernike(2, GRID, diameter_m=0.0),
    ],
)
def test_impossible_indices_are_refused(wrong):
    with pytest.raises(SettingsError, match="must"):
        wrong()
