"""Segmented pupils: areas, moments and labels known by hand, and impossible ones refused in one line."""

import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders
from nlcwfs.beam.segment_layouts import elt, gmt, keck, segments_of, sparse
from nlcwfs.beam.segments import Segment, Segments
from nlcwfs.beam.settings import BeamSettings
from nlcwfs.config import load_config
from nlcwfs.errors import SamplingError, SettingsError


def area_m2(amplitude, grid):
    return amplitude.sum() * grid.pixel_m**2


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, 90.0])
def test_a_hexagon_has_the_area_and_the_inertia_of_its_formulas(angle_deg):
    grid = Grid((61, 70), 0.11)
    amplitude = Segments((Segment(0.4, -0.7, 4.0, sides=6, angle_deg=angle_deg),)).amplitude(grid)
    # sqrt(3)/2 w^2, and 5 w^2 / 72 about any axis; 1e-3: straight edges over 8 x 8 parts of a pixel.
    assert area_m2(amplitude, grid) == pytest.approx(np.sqrt(3) / 2 * 16, rel=1e-3)
    share = amplitude / amplitude.sum()
    y, x = (share * grid.y_m).sum(), (share * grid.x_m).sum()
    assert (y, x) == (pytest.approx(0.4, abs=2e-4), pytest.approx(-0.7, abs=2e-4))
    assert (share * (grid.y_m - y) ** 2).sum() == pytest.approx(5 * 16 / 72, rel=3e-3)  # pixels are not points
    assert (share * (grid.y_m - y) * (grid.x_m - x)).sum() == pytest.approx(0.0, abs=2e-3)


def test_a_mirror_seen_askew_is_an_ellipse_short_towards_the_centre():
    grid = Grid((80, 81), 0.1)
    amplitude = Segments((Segment(1.2, 1.6, 3.0, squeeze=0.8),)).amplitude(grid)
    assert area_m2(amplitude, grid) == pytest.approx(np.pi * 1.5 * 1.2, rel=3e-4)
    along = (grid.y_m * 0.6 + grid.x_m * 0.8 - 2.0) ** 2
    across = (grid.y_m * 0.8 - grid.x_m * 0.6) ** 2
    # Variance of an ellipse along a half axis a is a^2 / 4; 1 %: a pixel is a fifteenth of the half axis.
    assert (amplitude * along).sum() / amplitude.sum() == pytest.approx(1.2**2 / 4, rel=0.01)
    assert (amplitude * across).sum() / amplitude.sum() == pytest.approx(1.5**2 / 4, rel=0.01)


@pytest.mark.parametrize(
    ("layout", "count", "wanted_m2"),
    [
        (sparse, 4, np.pi * 4 * 1.2**2),
        (gmt, 7, np.pi / 4 * (8.293**2 - 3.495**2 + 6 * 8.35**2 * np.cos(np.deg2rad(13.522)))),
        # A shadow of 2.65 m reaches over the six inner mirrors, but for the missing one in the middle.
        (keck, 36, 36 * 1.5 * np.sqrt(3) * 0.81 - (np.pi * 1.325**2 - np.sqrt(3) / 2 * (1.8 * np.sqrt(0.75)) ** 2)),
        (elt, 798, 798 * 1.5 * np.sqrt(3) * 0.725**2),
    ],
)
def test_telescopes_have_the_area_of_their_mirrors(layout, count, wanted_m2):
    segments = layout()
    assert len(segments.parts) == count
    reach_m = max(np.hypot(*part.corners_m().T).max() for part in segments.parts)
    grid = Grid((300, 300), 2 * reach_m / 298)
    # 1e-3: gaps of Keck's that the shadow covers, and edges over 8 x 8 parts of a pixel.
    assert area_m2(segments.amplitude(grid), grid) == pytest.approx(wanted_m2, rel=1e-3)


@pytest.mark.parametrize("layout", [sparse, gmt, keck])
def test_telescopes_are_their_own_point_reflection(layout):
    amplitude = layout(spiders=Spiders.evenly(2, width_m=0.2, first_angle_deg=17.0)).amplitude(Grid((200, 200), 0.135))
    np.testing.assert_allclose(amplitude, amplitude[::-1, ::-1], atol=1e-12)
    assert not np.allclose(amplitude, amplitude[::-1], atol=0.1)  # the vane tells up from down


def test_every_cell_has_one_label_that_of_the_nearest_rim():
    segments = Segments((Segment(0.0, -2.0, 2.0), Segment(0.0, 3.0, 4.0), Segment(5.0, 0.0, 1.0)))
    grid = Grid((90, 81), 0.15)
    labels = segments.labels(grid)
    rims = [
        np.hypot(grid.y_m - y, grid.x_m - x) - width / 2
        for y, x, width in ((0.0, -2.0, 2.0), (0.0, 3.0, 4.0), (5.0, 0.0, 1.0))
    ]
    np.testing.assert_array_equal(labels, np.argmin(rims, axis=0))
    assert sorted(np.unique(labels)) == [0, 1, 2]


@pytest.mark.parametrize("layout", [gmt, keck])
def test_labels_part_the_light_of_the_segments(layout):
    """Each segment alone shines on the cells of its label, and on next to none of another's."""
    segments = layout()
    grid = Grid((256, 256), 0.1)
    labels = segments.labels(grid)
    for number in (0, 3, 5):
        alone = Segments((segments.parts[number],)).amplitude(grid)
        foreign = alone[labels != number].sum() / alone.sum()
        # Rim pixels may lie half on either side: rim / area * pixel / 4 is 0.06 for Keck's mirrors.
        assert foreign < 0.06
        assert (alone[labels == number] > 0.99).sum() > 0.8 * alone.sum()


def test_ties_go_to_the_lower_number():
    segments = Segments((Segment(0.0, 2.0, 1.0), Segment(0.0, -2.0, 1.0)))
    assert segments.labels(Grid((3, 3), 1.0))[:, 1].tolist() == [0, 0, 0]


def test_vanes_and_the_shadow_lie_over_all_segments():
    grid = Grid((120, 120), 0.07)
    discs = (Segment(0.0, -2.0, 3.9), Segment(0.0, 2.0, 3.9))
    clear = Segments(discs).amplitude(grid)
    crossed = Segments(discs, obstruction_m=2.0, spiders=Spiders((0.0,), 0.2)).amplitude(grid)
    inner = np.hypot(grid.y_m, grid.x_m) < 0.9
    assert crossed[inner].max() == 0
    # A vane of 0.2 m from the shadow, 1 m out, to the far rim at 3.95 m; 2 %: its round end.
    beyond = np.hypot(grid.y_m, grid.x_m) > 1.1
    taken_m2 = (clear - crossed)[beyond].sum() * grid.pixel_m**2
    assert taken_m2 == pytest.approx(0.2 * (3.95 - 1.1), rel=0.02)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (
            ["beam.segments.layout=discs", "beam.segments.centres_m=[[0,1],[0,-1]]", "beam.segments.widths_m=[3]"],
            "beam.segments.centres_m: must keep segments apart; two overlap, got segments 0 and 1, 1 m deep",
        ),
        (
            ["beam.segments.layout=hexagons", "beam.segments.centres_m=[[0,3],[0,0]]", "beam.segments.widths_m=[3]"],
            "beam.diameter_m: must hold all segments; segment 0 reaches to 9.16515 m, got 8",
        ),
        (
            ["beam.segments.layout=gmt"],
            "beam.diameter_m: must hold all segments; segment 1 reaches to 25.4241 m, got 8",
        ),
        (
            ["beam.segments.layout=sparse", "beam.segments.pistons_nm=[1,2,3]"],
            "beam.segments.pistons_nm: must be one for each of 4 segments, got 3",
        ),
        (["beam.segments.layout=discs"], "beam.segments.centres_m: must be given with layout = discs"),
        (["beam.segments.layout=six"], "beam.segments.layout: must be "),
        (
            ["beam.segments.layout=discs", "beam.segments.centres_m=[[0,0]]", "beam.segments.widths_m=[0]"],
            "beam.segments.widths_m: must be positive lengths, got 0",
        ),
        (["beam.segments.piston_range_nm=300"], "beam.segments: pistons_nm, piston_range_nm and tilt_rms_nm must be"),
    ],
)
def test_an_impossible_pupil_is_refused_in_one_line(settings, says):
    with pytest.raises(SettingsError) as caught:
        load_config(None, settings)
    assert str(caught.value).startswith(says)
    assert "\n" not in str(caught.value)


def test_mirrors_that_touch_are_not_refused():
    side_m = 1.0 / np.sqrt(3)
    Segments((Segment(0.0, 0.0, 1.0, sides=6), Segment(0.0, 1.0, 1.0, sides=6)))
    Segments((Segment(0.0, 0.0, 1.0, sides=6), Segment(1.5 * side_m, 0.5, 1.0, sides=6)))
    with pytest.raises(SettingsError, match=r"0\.005 m deep"):
        Segments((Segment(0.0, 0.0, 1.0, sides=6), Segment(0.0, 0.99, 1.0, sides=6)))


def test_a_grid_that_cuts_a_segment_is_refused():
    with pytest.raises(SamplingError, match="segment 1 at"):
        Segments((Segment(0.0, 0.0, 1.0), Segment(0.0, 4.0, 1.0))).amplitude(Grid((8, 8), 1.0))


def test_settings_make_the_segments_that_they_name():
    text = 'beam.segments={layout="hexagons", centres_m=[[1.0, -2.0], [1.0, 2.0]], widths_m=[1.0, 2.0], angle_deg=30.0}'
    beam = load_config(None, [text, "beam.obstruction_ratio=0.25", "beam.spider_count=3"]).beam
    segments = segments_of(beam)
    assert segments is not None
    assert [(p.y_m, p.x_m, p.width_m, p.sides, p.angle_deg) for p in segments.parts] == [
        (1.0, -2.0, 1.0, 6, 30.0),
        (1.0, 2.0, 2.0, 6, 30.0),
    ]
    assert segments.obstruction_m == 2.0
    assert segments.spiders == Spiders.evenly(3, width_m=0.05)
    assert segments_of(BeamSettings()) is None
