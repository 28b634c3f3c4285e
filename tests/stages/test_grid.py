"""Where the pixels lie: (y, x), row 0 at the smallest y, zero in the middle."""

import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.errors import SamplingError


def test_rows_grow_with_y_and_columns_with_x():
    grid = Grid((4, 3), pixel_m=0.5)
    np.testing.assert_array_equal(grid.y_m, [[-0.75], [-0.25], [0.25], [0.75]])
    np.testing.assert_array_equal(grid.x_m, [[-0.5, 0.0, 0.5]])
    assert grid.width_m == (2.0, 1.5)


@pytest.mark.parametrize("shape", [(6, 5), (5, 8)])
def test_frequencies_are_those_of_plane_waves_on_the_grid(shape):
    grid = Grid(shape, pixel_m=0.3)
    for axis, (frequencies, positions_m) in enumerate(
        [(grid.fy_per_m[:, 0], grid.y_m[:, 0]), (grid.fx_per_m[0], grid.x_m[0])]
    ):
        for order, frequency in enumerate(frequencies):
            wave = np.exp(2j * np.pi * frequency * positions_m)
            power = abs(np.fft.fft(wave)) ** 2
            expected = np.zeros(shape[axis])
            expected[order] = shape[axis] ** 2
            np.testing.assert_allclose(power, expected, atol=1e-12 * shape[axis] ** 2)  # rounding
            assert abs(frequency) <= 0.5 / 0.3 + 1e-12  # the lowest of the frequencies that look the same


def test_a_finer_grid_fills_the_same_window_and_a_padded_one_keeps_its_pixels():
    grid = Grid((4, 3), pixel_m=0.5)
    finer = grid.finer(3)
    assert (finer.shape, finer.width_m) == ((12, 9), (2.0, 1.5))
    # The mean position of three fine pixels is that of their coarse one.
    np.testing.assert_allclose(finer.y_m.reshape(4, 3).mean(axis=1), grid.y_m[:, 0], atol=1e-15)
    assert grid.padded((8, 7)) == Grid((8, 7), 0.5)


@pytest.mark.parametrize(
    ("shape", "pixel_m", "message"),
    [
        ((0, 3), 0.5, "grid.shape: must be at least one pixel along each axis, got (0, 3)"),
        ((3, 3), 0.0, "grid.pixel_m: must be a positive length, got 0.0"),
        ((3, 3), -1.0, "grid.pixel_m: must be a positive length, got -1.0"),
        ((3, 3), float("nan"), "grid.pixel_m: must be a positive length, got nan"),
        ((3, 3), float("inf"), "grid.pixel_m: must be a positive length, got inf"),
    ],
)
def test_impossible_grids_are_refused(shape, pixel_m, message):
    with pytest.raises(SamplingError) as refusal:
        Grid(shape, pixel_m)
    assert str(refusal.value) == message
