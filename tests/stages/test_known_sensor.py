"""What a reconstructor is told of the light: its mean phase behind chromatic lenses, the size of the star."""

import numpy as np
import pytest
import scipy.special

from nlcwfs.beam.grid import Grid
from nlcwfs.config import load_config
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_sensor import sensor_geometry
from nlcwfs.simulation.exposure import ExposureSimulator
from nlcwfs.simulation.known_sensor import geometry_of

SMALL = [
    "curvature_sensor.distances_km=[-4000, 4000]",
    "detector.pixels_across_pupil=16",
    "detector.window_pixels=24",
    "simulation.light_oversampling=2",
    "atmosphere.opd_rms_nm=100",
]
FLAT = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.4", "beam.spectrum.wavelengths=3"]
EFFECTIVE_M = 0.34e-6 / np.log(1.02 / 0.68)
"""Of a flat band from 0.68 to 1.02 um: its width over the logarithm of its ends."""


def geometry(*settings: str):
    config = load_config(None, [*SMALL, *settings])
    return geometry_of(config, ExposureSimulator.build(config))


def test_one_colour_stands_at_the_mean_phase_where_lenses_are_chromatic():
    ideal = geometry(*FLAT, "curvature_sensor.lenses=ideal")
    assert ideal.wavelength_m == pytest.approx(EFFECTIVE_M, rel=1e-12)
    np.testing.assert_allclose(ideal.distances_m, np.array([-4e6, 4e6]) * 0.85e-6 / EFFECTIVE_M, rtol=1e-12)
    glass = geometry(*FLAT, "curvature_sensor.lenses=doublet")
    assert glass.wavelength_m == ideal.wavelength_m
    assert np.abs(np.array(glass.distances_m) / ideal.distances_m - 1).max() < 0.01  # nulls of the doublet are near
    for others in (["estimation.map.wavelengths=3", "curvature_sensor.lenses=ideal"], ["estimation.modes=100"]):
        found = geometry(*FLAT, *others)
        assert (found.wavelength_m, found.distances_m) == (0.85 * 1e-6, (-4e6, 4e6))
    assert geometry("curvature_sensor.lenses=ideal").wavelength_m == 0.85 * 1e-6  # light of one colour


@pytest.mark.parametrize(("chromatic", "expected_m"), [(True, EFFECTIVE_M), (False, 0.85e-6)])
def test_frames_of_chromatic_lenses_say_so(chromatic, expected_m):
    counts = np.ones((1, 2, 8, 9))
    frames = FramesFile(
        electrons=counts,
        masked=np.zeros(counts.shape, bool),
        has_frame_axis=False,
        pixel_m=1.0,
        wavelength_m=0.85e-6,
        diameter_m=8.0,
        distances_m=(-2.5e6, 2.5e6),
        bandwidth_m=0.34e-6,
        chromatic_lenses=chromatic,
    )
    found = sensor_geometry(frames)
    assert found.wavelength_m == pytest.approx(expected_m, rel=1e-12)
    assert found.distances_m[1] * found.wavelength_m == pytest.approx(2.5e6 * 0.85e-6, rel=1e-12)


def test_a_model_of_one_colour_knows_the_size_of_the_star_if_it_is_told():
    star, grid = "atmosphere.star.size_mas=20", Grid((24, 24), 0.5)
    assert geometry(star).in_colour(grid, dtype="float64") is None
    assert geometry("estimation.map.star=told").in_colour(grid, dtype="float64") is None  # a point
    told = geometry(star, "estimation.map.star=told").in_colour(grid, dtype="float64")
    assert told is not None
    assert told.visibility is not None
    x = np.pi * 20 * np.pi / 180 / 3600e3 * 4e6 * (5 / 12)  # five waves in 12 m
    assert float(told.visibility[0, 0, 5, 0]) == pytest.approx(2 * scipy.special.j1(x) / x, rel=1e-9)
    assert told.spectrum.wavelengths_m == (0.85 * 1e-6,)
