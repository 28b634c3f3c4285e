"""Images behind lenslets against HCIPy."""

import hcipy as hp
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann
from nlcwfs.estimation.spot_centroids import centre_of_gravity
from nlcwfs.estimation.spot_model import SpotModel

WAVELENGTH_M = 0.85e-6
LENSLETS, CELLS = 4, 128
DIAMETER_M = 8e-3
PITCH_M = DIAMETER_M / LENSLETS
CELL_M = PITCH_M / CELLS
F_NUMBER = CELL_M * 8 / WAVELENGTH_M  # a cell is lambda / 8d in the focal plane, as wide as a pixel here
FIELD = 64
MARGIN = CELLS  # around the pupil, for HCIPy's light that leaves a lenslet


def rough(grid: Grid) -> np.ndarray:
    """Metres: a wavefront without symmetry, with slopes of half of lambda / d and a curl within each lenslet."""
    y, x = grid.y_m / DIAMETER_M, grid.x_m / DIAMETER_M
    waves = np.cos(2 * np.pi * (1.7 * x + 0.6 * y) + 0.4) + 0.7 * np.sin(2 * np.pi * (3.1 * y - 1.2 * x))
    return 1.2e-7 * (waves + 4 * x**2 * y) + 4e-7 * x - 2e-7 * y


@pytest.fixture(scope="module")
def both():
    """HCIPy's image of each lenslet lit alone, so that no neighbour's light falls into it, and ours."""
    across = LENSLETS * CELLS + 2 * MARGIN
    grid = Grid((across, across), CELL_M)
    pupil = np.zeros(grid.shape)
    pupil[MARGIN:-MARGIN, MARGIN:-MARGIN] = 1 - 0.5 * (np.arange(512) / 512)[None, :] ** 2  # brighter at the left
    opd_m = rough(grid)
    sensor = ShackHartmann.build(
        pupil,
        grid,
        diameter_m=DIAMETER_M,
        spectrum=Spectrum.monochromatic(WAVELENGTH_M),
        settings=ShackHartmannSettings(subapertures=LENSLETS, least_light=0.2),
        dtype="float64",
    )
    ours = np.asarray(sensor.images(jnp.asarray(opd_m), 1.0).photons)

    configuration = hp.Configuration()
    configuration.fourier.fft.method = ["scipy"]
    pupil_grid = hp.make_uniform_grid([across, across], [across * CELL_M] * 2)
    # The lattice of HCIPy starts at -D: lenslet centres are half a pitch from where an even lattice has them.
    lattice = (np.arange(LENSLETS) - (LENSLETS - 1) / 2) * PITCH_M
    lenslets = hp.CartesianGrid(hp.SeparatedCoords((lattice, lattice)))
    lens_array = hp.MicroLensArray(pupil_grid, lenslets, F_NUMBER * PITCH_M)
    optics = hp.ShackHartmannWavefrontSensorOptics(pupil_grid, lens_array)
    theirs = []
    for row, column in np.asarray(sensor.places):
        part = np.zeros_like(pupil)
        rows = slice(MARGIN + row * CELLS, MARGIN + (row + 1) * CELLS)
        columns = slice(MARGIN + column * CELLS, MARGIN + (column + 1) * CELLS)
        part[rows, columns] = pupil[rows, columns]
        field = hp.Field((part * np.exp(2j * np.pi / WAVELENGTH_M * opd_m)).ravel(), pupil_grid)
        image = np.asarray(optics.forward(hp.Wavefront(field, WAVELENGTH_M)).intensity.shaped)
        middle = (slice(one.start + CELLS // 2 - 32, one.start + CELLS // 2 + 32) for one in (rows, columns))
        theirs.append(image[tuple(middle)])
    return sensor, ours, np.array(theirs) / (pupil**2).sum()


def test_hcipy_sees_the_same_spots(both):
    sensor, ours, theirs = both
    assert sensor.count == LENSLETS**2
    # 1e-2 of the peak: the lenslets of HCIPy are sampled quadratic phases on a grid where light wraps around.
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, other, atol=0.01 * other.max())
    turned = ours[:, ::-1, ::-1]
    assert abs(turned - theirs).max() > 0.1 * theirs.max()  # a wrong sign would show


def test_hcipy_counts_the_same_light_in_every_spot(both):
    _, ours, theirs = both
    np.testing.assert_allclose(ours.sum((1, 2)), theirs.sum((1, 2)), rtol=0.01)
    assert np.ptp(ours.sum((1, 2))) > 0.1 * ours.sum((1, 2)).mean()


def test_centroids_are_those_of_hcipys_images(both):
    sensor, ours, theirs = both
    place = np.arange(64) - 31.5
    found = np.asarray(centre_of_gravity(SpotModel.of_sensor(sensor)).measure(jnp.asarray(ours)).slope)
    expected = np.stack([theirs.sum(2) @ place, theirs.sum(1) @ place], axis=1) / theirs.sum((1, 2))[:, None]
    np.testing.assert_allclose(found / sensor.pixel_rad, expected, atol=0.05)  # of a pixel, lambda / 8d
    assert abs(expected).max() > 1
