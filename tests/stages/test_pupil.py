"""Pupils: areas known by hand, the right way up, and bad ones refused in one line."""

import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders, circular_pupil, inside, light_weights, pupil_from_map, pupil_of_discs
from nlcwfs.errors import SamplingError, SettingsError


def lit_area_m2(pupil, grid):
    return pupil.sum() * grid.pixel_m**2


@pytest.mark.parametrize("pixels", [12, 45, 90, 91])
def test_an_obstructed_circle_has_the_area_of_a_ring(pixels):
    grid = Grid((pixels + 3, pixels + 8), 8 / pixels)
    pupil = circular_pupil(grid, diameter_m=8.0, obstruction_ratio=0.3)
    # 3e-4: an edge cuts 8 x 8 parts of a pixel; coarse supersampling or amplitude^2 would miss by percents.
    assert lit_area_m2(pupil, grid) == pytest.approx(np.pi * 16 * (1 - 0.09), rel=3e-4)


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, 45.0])
@pytest.mark.parametrize("width_m", [0.02, 0.31])
def test_a_vane_takes_its_length_times_its_width(angle_deg, width_m):
    grid = Grid((49, 52), 8 / 45)
    clear = circular_pupil(grid, diameter_m=8.0, obstruction_ratio=0.3)
    crossed = circular_pupil(grid, diameter_m=8.0, obstruction_ratio=0.3, spiders=Spiders((angle_deg,), width_m))
    taken_m2 = lit_area_m2(clear, grid) - lit_area_m2(crossed, grid)
    # 1.5 %: the round ends of the strip and parts of pixels at an angle.
    assert taken_m2 == pytest.approx(width_m * 4 * (1 - 0.3), rel=0.015)


def test_a_single_vane_lies_where_its_angle_says():
    grid = Grid((40, 41), 0.2)
    spiders = Spiders((60.0,), 0.3)
    clear = circular_pupil(grid, diameter_m=8.0)
    dark = (clear - circular_pupil(grid, diameter_m=8.0, spiders=spiders)) * (np.hypot(grid.y_m, grid.x_m) < 3.8)
    # Centroid of a strip from 0 to 3.8 m at 60 degrees from +x towards +y; 0.05 m is a quarter pixel.
    assert (dark * grid.x_m).sum() / dark.sum() == pytest.approx(1.9 * 0.5, abs=0.05)
    assert (dark * grid.y_m).sum() / dark.sum() == pytest.approx(1.9 * np.sqrt(3) / 2, abs=0.05)


def test_edge_pixels_hold_their_lit_fraction():
    grid = Grid((7, 7), 1.0)
    pupil = circular_pupil(grid, diameter_m=5.0)
    fine = (np.arange(2000) - 999.5) / 2000
    by_counting = np.mean(np.hypot(2 + fine[:, None], 1 + fine[None, :]) < 2.5)
    assert pupil[3 + 2, 3 + 1] == pytest.approx(by_counting, abs=2e-3)  # 8 x 8 parts with straight edges
    assert pupil[3, 3] == 1
    assert pupil[0, 0] == 0


def test_segments_stand_where_they_are_put():
    grid = Grid((60, 64), 0.15)
    pupil = pupil_of_discs(grid, centres_m=[(2.0, -1.5), (-1.0, 1.0)], disc_diameter_m=2.0)
    assert lit_area_m2(pupil, grid) == pytest.approx(2 * np.pi, rel=3e-4)
    assert (pupil * grid.y_m).sum() / pupil.sum() == pytest.approx(0.5, abs=1e-3)
    assert (pupil * grid.x_m).sum() / pupil.sum() == pytest.approx(-0.25, abs=1e-3)


def test_weights_follow_the_light_not_the_amplitude():
    np.testing.assert_allclose(light_weights(np.array([[1.0, 0.5, 0.0]])), [[0.8, 0.2, 0.0]], rtol=1e-15)
    assert inside(np.array([[1.0, 0.5, 0.49]])).tolist() == [[True, True, False]]


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda g: circular_pupil(g, diameter_m=-1.0), SamplingError, "beam.diameter_m: must be positive"),
        (lambda g: circular_pupil(g, diameter_m=float("nan")), SamplingError, "got nan"),
        (lambda g: circular_pupil(g, diameter_m=11.0), SamplingError, "fit on the grid of 10 m, got 11.0"),
        (
            lambda g: circular_pupil(g, diameter_m=5.0, obstruction_ratio=1.0),
            SettingsError,
            "below 1, got 1.0",
        ),
        (lambda g: pupil_from_map(np.ones((3, 3)), g), SamplingError, r"\(10, 12\), got \(3, 3\)"),
        (lambda g: pupil_from_map(np.zeros((10, 12)), g), SettingsError, "got zero everywhere"),
        (lambda g: pupil_from_map(np.full((10, 12), 1.5), g), SettingsError, "got 1.5 to 1.5"),
        (lambda g: pupil_from_map(np.full((10, 12), np.nan), g), SettingsError, "got 120 pixels"),
        (
            lambda g: Spiders((0.0,), 0.0),
            SettingsError,
            "spiders.width_m: must be a positive length, got 0.0",
        ),
        (lambda g: Spiders((np.inf,), 0.1), SettingsError, "spiders.angles_deg"),
    ],
)
def test_a_bad_pupil_is_refused_in_one_line(make, error, says):
    with pytest.raises(error, match=says) as caught:
        make(Grid((10, 12), 1.0))
    assert "\n" not in str(caught.value)
