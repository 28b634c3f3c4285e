"""Images behind a pyramid against HCIPy."""

import hcipy as hp
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.pyramid import Pyramid
from nlcwfs.comparison_sensors.settings import PyramidSettings

WAVELENGTH_M = 0.85e-6
CELLS, DIAMETER_M = 64, 8.0
CELL_M = DIAMETER_M / CELLS
SEPARATION, WINDOW = 1.5, 4  # in diameters; HCIPy's detector is so many wide
PADDING = 16  # HCIPy's focus in samples for each lambda / D: its light wraps around after as many diameters


def rough(grid: Grid) -> np.ndarray:
    """Metres: a wavefront without symmetry, 0.9 rad rms."""
    y, x = grid.y_m / DIAMETER_M, grid.x_m / DIAMETER_M
    waves = np.cos(2 * np.pi * (1.7 * x + 0.6 * y) + 0.4) + 0.7 * np.sin(2 * np.pi * (5.1 * y - 3.2 * x))
    return 1.2e-7 * (waves + 4 * x**2 * y) + 1e-7 * x - 0.5e-7 * y


def optics():
    """HCIPy's pyramid; its spatial filter, which ours has not, is opened as far as the cells go."""
    configuration = hp.Configuration()
    configuration.fourier.fft.method = ["scipy"]
    near = hp.make_uniform_grid([CELLS, CELLS], [DIAMETER_M] * 2)
    far = hp.make_uniform_grid([WINDOW * CELLS] * 2, [WINDOW * DIAMETER_M] * 2)
    made = hp.PyramidWavefrontSensorOptics(
        near,
        far,
        separation=SEPARATION * DIAMETER_M,
        pupil_diameter=DIAMETER_M,
        wavelength_0=WAVELENGTH_M,
        q=PADDING,
    )
    made.spatial_filter = hp.Apodizer(made.focal_grid.ones())
    return near, made


def theirs(pupil: np.ndarray, wavefronts_m: list[np.ndarray]) -> np.ndarray:
    """Mean image of several wavefronts, share of the light on each cell; two transforms turn it by 180 degrees."""
    near, made = optics()
    total = 0
    for opd_m in wavefronts_m:
        field = hp.Field((pupil * np.exp(2j * np.pi / WAVELENGTH_M * opd_m)).ravel(), near)
        total = total + np.asarray(made.forward(hp.Wavefront(field, WAVELENGTH_M)).intensity.shaped)
    return total[::-1, ::-1] / (pupil**2).sum() / len(wavefronts_m)


def windows(frame: np.ndarray, margin: int) -> np.ndarray:
    """The squares around the four images, in our order."""
    half, shift, middle = CELLS // 2 + margin, round(SEPARATION * CELLS / 2), WINDOW * CELLS // 2
    parts = [slice(middle + sign * shift - half, middle + sign * shift + half) for sign in (-1, 1)]
    return np.stack([frame[rows, columns] for rows in parts for columns in parts])


@pytest.mark.parametrize("modulation", [0.0, 2.5])
def test_hcipy_sees_the_same_images(modulation):
    grid, margin, points = Grid((CELLS, CELLS), CELL_M), 8, 20
    pupil = PupilShape(DIAMETER_M, 0.3).on(grid) * (1 - 0.5 * np.arange(CELLS) / CELLS)  # brighter at the left
    opd_m = rough(grid)
    sensor = Pyramid.build(
        pupil,
        grid,
        diameter_m=DIAMETER_M,
        spectrum=Spectrum.monochromatic(WAVELENGTH_M),
        settings=PyramidSettings(
            modulation_lambda_over_d=modulation,
            modulation_points=points,
            pixels=CELLS,
            margin_pixels=margin,
            separation=SEPARATION,
        ),
        dtype="float64",
    )
    ours = np.asarray(sensor.images(jnp.asarray(opd_m), 1.0).photons)
    angle = 2 * np.pi * (np.arange(points) + 0.5) / points
    radius = modulation * WAVELENGTH_M / DIAMETER_M
    tilts = [radius * (np.cos(one) * grid.x_m + np.sin(one) * grid.y_m) for one in angle]
    other = windows(theirs(pupil, [opd_m + tilt for tilt in tilts] if modulation else [opd_m]), margin)
    # 1e-2 of the brightest: HCIPy's facets end on samples of the focus, and its light wraps around.
    np.testing.assert_allclose(ours, other, atol=0.01 * other.max())
    np.testing.assert_allclose(ours.sum((1, 2)), other.sum((1, 2)), rtol=0.01)
    assert np.ptp(other.sum((1, 2))) > 0.1 * other.sum((1, 2)).mean()  # a wrong order of images would show
    assert abs(ours[:, ::-1, ::-1] - other).max() > 0.1 * other.max()  # and a turned image
