"""Images of stars and Strehl ratios against closed forms and HCIPy."""

import hcipy as hp
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j1

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.science.point_spread_function import point_spread_function, strehl_ratio

DIAMETER_M = 8.0
WAVELENGTH_M = 0.85e-6
RESOLUTION_RAD = WAVELENGTH_M / DIAMETER_M
GRID = Grid((122, 126), 0.066)  # 121 pixels across, not square


def picture(pupil, opd_m, angles: Grid) -> np.ndarray:
    psf = point_spread_function(
        pupil, jnp.asarray(opd_m), wavelength_m=WAVELENGTH_M, pixel_m=GRID.pixel_m, angles=angles
    )
    return np.asarray(psf)


def rough(scale_m: float) -> np.ndarray:
    """A wavefront without symmetry, waves up to 3 cycles across."""
    y, x = GRID.y_m / DIAMETER_M, GRID.x_m / DIAMETER_M
    shape = np.cos(2 * np.pi * (1.3 * x + 0.6 * y) + 0.4) + 0.7 * np.sin(2 * np.pi * (2.6 * y - 0.9 * x)) + 3 * x**2 * y
    return scale_m * shape


def test_a_perfect_circle_gives_the_airy_pattern():
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M)
    angles = Grid((41, 37), RESOLUTION_RAD / 4)
    radius = np.pi * np.hypot(angles.y_m, angles.x_m) / RESOLUTION_RAD
    radius[20, 18] = 1e-9  # the middle, where the formula is 0 / 0
    airy = (2 * j1(radius) / radius) ** 2
    # Antialiased edges are right to second order in the pixel: 1 / 121^2 of the ring's slope.
    np.testing.assert_allclose(picture(pupil, np.zeros(GRID.shape), angles), airy, atol=2e-4)


def test_an_obstructed_circle_gives_the_annular_pattern():
    ratio = 0.35
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M, obstruction_ratio=ratio)
    angles = Grid((1, 40), RESOLUTION_RAD / 5)
    radius = np.pi * abs(angles.x_m) / RESOLUTION_RAD
    amplitude = 2 * (j1(radius) - ratio * j1(ratio * radius)) / radius / (1 - ratio**2)
    np.testing.assert_allclose(picture(pupil, np.zeros(GRID.shape), angles), amplitude**2, atol=5e-4)


def test_hcipy_sees_the_same_star():
    pupil_grid = hp.make_pupil_grid(128, DIAMETER_M * 1.05)
    own = Grid((128, 128), pupil_grid.delta[0])
    pupil = circular_pupil(own, diameter_m=DIAMETER_M, obstruction_ratio=0.2)
    y, x = own.y_m / DIAMETER_M, own.x_m / DIAMETER_M
    opd_m = 60e-9 * (np.cos(9 * x + 4 * y) + np.sin(11 * y - 3 * x) + 6 * x**2 * y) + 2e-7 * x
    angles = Grid((48, 48), RESOLUTION_RAD / 4)
    focal_grid = hp.make_pupil_grid(48, 48 * angles.pixel_m)
    travel = hp.FraunhoferPropagator(pupil_grid, focal_grid, focal_length=1)

    def intensity(phase_rad):
        field = hp.Field(pupil.ravel() * np.exp(1j * phase_rad.ravel()), pupil_grid)
        return travel(hp.Wavefront(field, WAVELENGTH_M)).intensity.shaped

    reference = np.asarray(intensity(2 * np.pi / WAVELENGTH_M * opd_m))
    peak = (pupil.sum() * own.pixel_m**2 / WAVELENGTH_M) ** 2  # Fraunhofer at focal length 1, on the axis
    found = point_spread_function(
        pupil, jnp.asarray(opd_m), wavelength_m=WAVELENGTH_M, pixel_m=own.pixel_m, angles=angles
    )
    np.testing.assert_allclose(found, reference / peak, atol=1e-10)
    assert np.unravel_index(np.argmax(reference), reference.shape) != (23, 23)  # the tilt shows


@pytest.mark.parametrize("rms_m", [5e-9, 20e-9, 40e-9])
def test_small_aberrations_cost_what_marechal_says(rms_m):
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M)
    weights = pupil / pupil.sum()  # of the amplitude: the field on the axis is its sum
    opd_m = rough(1.0)
    opd_m = opd_m - np.sum(weights * opd_m)
    opd_m = opd_m * rms_m / np.sqrt(np.sum(weights * opd_m**2))
    variance = (2 * np.pi * rms_m / WAVELENGTH_M) ** 2
    found = float(strehl_ratio(pupil, jnp.asarray(opd_m), wavelength_m=WAVELENGTH_M))
    assert found == pytest.approx(np.exp(-variance), abs=0.5 * variance**1.5 + 1e-9)  # skewness is the next term
    assert found == pytest.approx(picture(pupil, opd_m, Grid((1, 1), RESOLUTION_RAD))[0, 0], abs=1e-12)


def test_an_astigmatism_that_splits_the_disc_in_closed_form():
    """Phase +a on one half and -a on the other: Strehl cos^2(a)."""
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M)
    for phase_rad in (0.3, 1.0, 2.0):
        halves_m = phase_rad * WAVELENGTH_M / (2 * np.pi) * np.where(GRID.x_m > 0, 1, -1) * np.ones((GRID.shape[0], 1))
        found = float(strehl_ratio(pupil, jnp.asarray(halves_m), wavelength_m=WAVELENGTH_M))
        assert found == pytest.approx(np.cos(phase_rad) ** 2, abs=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilt_moves_the_star_towards_it(axis):
    """A path that grows by 3 wavelengths over the diameter points 3 lambda / D to the same side."""
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M)
    along = (GRID.y_m, GRID.x_m)[axis] * np.ones(GRID.shape)
    psf = picture(pupil, 3 * WAVELENGTH_M / DIAMETER_M * along, Grid((33, 35), RESOLUTION_RAD / 2))
    middle = [16, 17]
    middle[axis] += 6
    assert list(np.unravel_index(np.argmax(psf), psf.shape)) == middle
    assert psf.max() == pytest.approx(1, abs=1e-9)


def test_piston_and_the_sign_of_a_symmetric_wavefront_do_not_show():
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M)
    opd_m = rough(80e-9)
    angles = Grid((20, 24), RESOLUTION_RAD / 2)
    plain = picture(pupil, opd_m, angles)
    np.testing.assert_allclose(picture(pupil, opd_m + 1e-7, angles), plain, atol=1e-12)
    turned = picture(pupil, -opd_m, angles)
    np.testing.assert_allclose(turned[::-1, ::-1], plain, atol=1e-12)  # conjugation mirrors the image
    assert abs(turned - plain).max() > 0.01
