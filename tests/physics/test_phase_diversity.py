"""Phase diversity and curvature are one: a plane at z is the image of a lens that adds D^2 / (8 lambda z) waves."""

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.fraunhofer import propagate_fraunhofer
from nlcwfs.beam.fresnel import propagate_fresnel
from nlcwfs.beam.grid import Grid
from nlcwfs.config import load_config

WAVELENGTH_M, DIAMETER_M, CELLS, WIDE = 0.85e-6, 8.0, 96, 480
CELL_M = DIAMETER_M / CELLS


def soft_pupil():
    """Smooth, asymmetric, complex: what is not smooth is not the same on two grids."""
    grid = Grid((WIDE, WIDE), CELL_M)
    y, x = grid.y_m / DIAMETER_M, grid.x_m / DIAMETER_M
    amplitude = np.exp(-12 * (x**2 + 1.4 * y**2 + 0.5 * x * y)) * (1 + 0.8 * x)
    return amplitude * np.exp(2j * (3 * x**3 - 2 * y**2 + 4 * x * y + 1.5 * y))


def image_in_focus(waves, angles_rad):
    """Plain NumPy: direct sum over the pupil, defocus of so many waves at the rim of the telescope, peak to valley."""
    grid = Grid((WIDE, WIDE), CELL_M)
    radius2 = (grid.y_m**2 + grid.x_m**2) / (DIAMETER_M / 2) ** 2
    field = soft_pupil() * np.exp(2j * np.pi * waves * radius2)
    rows = np.exp(-2j * np.pi / WAVELENGTH_M * np.outer(angles_rad, grid.y_m))
    columns = np.exp(-2j * np.pi / WAVELENGTH_M * np.outer(angles_rad, grid.x_m))
    return np.abs(rows @ field @ columns.T * CELL_M**2) ** 2


@pytest.mark.parametrize("waves", [1.0, -1.0, 2.69, -5.0])
def test_the_image_of_a_defocused_star_is_a_plane_of_the_curvature_sensor(waves):
    (distance_km,) = load_config(None, [f"curvature_sensor.defocus_waves=[{waves}]"]).curvature_sensor.distances_km
    distance_m = 1e3 * distance_km
    light = {"distance_m": distance_m, "wavelength_m": WAVELENGTH_M, "pixel_m": CELL_M}
    plane = np.abs(propagate_fresnel(jnp.asarray(soft_pupil()), **light)) ** 2
    middle = slice(WIDE // 2 - 60, WIDE // 2 + 60)
    places_m = Grid((WIDE, WIDE), CELL_M).x_m.ravel()[middle]
    # The scale of the telescope: an angle times the distance; upstream images stand on their heads.
    image = image_in_focus(waves, places_m / abs(distance_m)) / (WAVELENGTH_M * distance_m) ** 2
    turned = image[::-1, ::-1] if distance_m < 0 else image
    peak = image.max()
    np.testing.assert_allclose(plane[middle, middle], turned, atol=1e-6 * peak)  # a Gaussian ends within the grid
    wrong = np.abs(plane[middle, middle] - turned[::-1, ::-1]).max()
    assert wrong > 0.1 * peak  # the pupil is asymmetric enough to see it


def test_our_own_travel_to_infinity_says_the_same():
    grid, angles = Grid((WIDE, WIDE), CELL_M), Grid((31, 31), 2e-8)
    radius2 = (grid.y_m**2 + grid.x_m**2) / (DIAMETER_M / 2) ** 2
    field = jnp.asarray(soft_pupil() * np.exp(2j * np.pi * 2.0 * radius2))
    ours = np.abs(propagate_fraunhofer(field, wavelength_m=WAVELENGTH_M, pixel_m=CELL_M, angles=angles)) ** 2
    direct = image_in_focus(2.0, angles.x_m.ravel())
    np.testing.assert_allclose(ours / ours.max(), direct / direct.max(), atol=1e-9)  # the same sum, rounding
