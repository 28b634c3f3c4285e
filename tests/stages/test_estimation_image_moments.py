"""Moments of images against closed forms, and against the law that they follow along the beam."""

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.fresnel import propagate_fresnel
from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.image_moments import image_moments

WAVELENGTH_M = 0.65e-6


def gaussian(grid: Grid, centre_m, covariance_m2) -> np.ndarray:
    y, x = np.broadcast_arrays(grid.y_m - centre_m[0], grid.x_m - centre_m[1])
    inverse = np.linalg.inv(covariance_m2)
    return np.exp(-0.5 * (inverse[0, 0] * y**2 + 2 * inverse[0, 1] * y * x + inverse[1, 1] * x**2))


def test_the_moments_of_a_gaussian_are_its_parameters():
    grid = Grid((60, 71), 0.25)
    centres = [(0.3, -0.8), (-0.45, 0.2)]
    covariances = [np.array([[1.0, 0.3], [0.3, 0.6]]), np.array([[0.5, -0.2], [-0.2, 1.2]])]
    counts = jnp.asarray([7e3 * gaussian(grid, *both) for both in zip(centres, covariances, strict=True)])
    centroid_m, second_m2 = image_moments(counts, jnp.ones(counts.shape, bool), grid)
    np.testing.assert_allclose(centroid_m, centres, atol=1e-6)  # the tails are cut at 6 sigma
    np.testing.assert_allclose(second_m2, [[c[0, 0], c[0, 1], c[1, 1]] for c in covariances], atol=1e-5)


@pytest.mark.parametrize("distance_m", [1.0e6, 3.1e6])
def test_moments_along_the_beam_follow_the_slopes_of_the_wavefront(distance_m):
    """d<a b>/dz = cov(a, theta_b) + cov(theta_a, b), whatever the wavefront: 4 rad of an asymmetric one here."""
    grid = Grid((120, 144), 0.2)
    y, x = np.broadcast_arrays(grid.y_m, grid.x_m)
    light = gaussian(grid, (0.4, -0.3), np.array([[1.6, 0.3], [0.3, 1.1]]))
    opd_m = 1e-7 * (0.8 * x**2 + 0.5 * x * y - 0.3 * y**2 + 0.1 * x**3 - 0.06 * x * y**2 + 0.7 * y - 0.9 * x)
    slope_y = 1e-7 * (0.5 * x - 0.6 * y - 0.12 * x * y + 0.7)
    slope_x = 1e-7 * (1.6 * x + 0.5 * y + 0.3 * x**2 - 0.06 * y**2 - 0.9)
    field = jnp.asarray(np.sqrt(light) * np.exp(2j * np.pi / WAVELENGTH_M * opd_m))

    def moments(z_m: float):
        far = propagate_fresnel(field, distance_m=z_m, wavelength_m=WAVELENGTH_M, pixel_m=grid.pixel_m)
        image = (jnp.abs(far) ** 2)[None]
        return [np.asarray(one[0]) for one in image_moments(image, jnp.ones(image.shape, bool), grid)]

    (centroid_after, second_after), (centroid_before, second_before) = moments(distance_m), moments(-distance_m)
    share = light / light.sum()

    def covariance(a, b):
        return np.sum(share * a * b) - np.sum(share * a) * np.sum(share * b)

    slopes = np.array([np.sum(share * slope_y), np.sum(share * slope_x)])
    # What is beyond the window, 10 pupil radii squared times 1e-7 of the light, is 3e-12 m of 1e-7 m.
    np.testing.assert_allclose((centroid_after - centroid_before) / (2 * distance_m), slopes, atol=1e-12)
    law = [
        2 * covariance(y, slope_y),
        covariance(y, slope_x) + covariance(slope_y, x),
        2 * covariance(x, slope_x),
    ]
    np.testing.assert_allclose((second_after - second_before) / (2 * distance_m), law, atol=1e-11)
    assert min(abs(np.array(law))) > 1e-8  # nothing above vanishes by symmetry


def test_a_masked_pixel_counts_as_its_neighbours():
    grid = Grid((9, 12), 0.5)
    counts = np.random.default_rng(4).uniform(5, 9, (1, 9, 12))
    hot, usable = counts.copy(), np.ones((1, 9, 12), bool)
    hot[0, 2, 8], usable[0, 2, 8] = 1e6, False
    filled = counts.copy()
    filled[0, 2, 8] = (counts[0, 1:4, 7:10].sum() - counts[0, 2, 8]) / 8
    share = filled[0] / filled[0].sum()
    y_m, x_m = np.sum(share * grid.y_m), np.sum(share * grid.x_m)
    spread = [(grid.y_m - y_m) ** 2, (grid.y_m - y_m) * (grid.x_m - x_m), (grid.x_m - x_m) ** 2]
    centroid_m, second_m2 = image_moments(jnp.asarray(hot), jnp.asarray(usable), grid)
    np.testing.assert_allclose(centroid_m[0], [y_m, x_m], atol=1e-12)  # rounding
    np.testing.assert_allclose(second_m2[0], [np.sum(share * one) for one in spread], atol=1e-12)


def test_a_dark_plane_has_no_moments():
    counts = jnp.stack([jnp.zeros((6, 8)), jnp.ones((6, 8))])
    centroid_m, second_m2 = image_moments(counts, jnp.ones(counts.shape, bool), Grid((6, 8), 1.0))
    assert not np.any(centroid_m[0])
    assert not np.any(second_m2[0])
    np.testing.assert_allclose(second_m2[1], [35 / 12, 0, 63 / 12])  # (n^2 - 1) / 12 of n pixels
