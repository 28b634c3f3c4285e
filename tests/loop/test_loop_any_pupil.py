"""A loop behind a pupil that was measured: its light is weighed as the map says, and it closes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from small_loop import SMALL, small

sys.path.insert(0, str(Path(__file__).parents[1] / "stages"))
from command_line import type_in

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders, circular_pupil
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.seed import reseeded


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """A telescope of 2 m with two vanes, whose left half has lost three quarters of its light."""
    grid = Grid((100, 100), 0.0202)
    shape = circular_pupil(grid, diameter_m=2.0, obstruction_ratio=0.2, spiders=Spiders((90.0, 270.0), 0.06))
    path = tmp_path_factory.mktemp("pupil") / "uneven.fits"
    fits.writeto(path, np.where(grid.x_m < 0, 0.5, 1.0) * shape, fits.Header({"PIXSCALE": grid.pixel_m}))
    return path


def test_light_is_weighed_as_the_map_says_under_every_seed(uneven):
    config = small(f"beam.pupil_map={uneven}", "loop.sensor=ideal", "loop.seconds=0.02")
    loop = Loop.build(config, pupil_of(config))
    for one in (loop, reseeded(loop, 7)):
        weights = np.asarray(one.light.weights)
        halves = weights[:, : weights.shape[1] // 2].sum(), weights[:, weights.shape[1] // 2 :].sum()
        assert halves[1] / halves[0] == pytest.approx(4.0, rel=1e-3)
        assert np.asarray(one.light.still.weights).sum() == pytest.approx(1.0)


def test_the_loop_closes_behind_it(uneven, tmp_path):
    words = [word for setting in [*SMALL, f"beam.pupil_map={uneven}"] for word in ("--set", setting)]
    result = type_in("loop", "--out", tmp_path / "run", *words)
    assert result.exit_code == 0, result.output
    numbers = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert numbers["outcome"] == "closed"
    assert numbers["rms_nm"] < numbers["bounds"]["open_loop_nm"] / 4
