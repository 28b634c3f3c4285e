"""`simulate` and `reconstruct` on a pupil made of segments: what the file holds, what is said, what is refused."""

import numpy as np
import pytest
from astropy.io import fits
from command_line import type_in

from nlcwfs.interop import read_frames
from nlcwfs.interop.frames_sensor import sensor_geometry

SPARSE = {
    "beam.wavelength_um": 0.65,
    "beam.segments.layout": "sparse",
    "beam.segments.pistons_nm": [0, 150, -100, 60],
    "atmosphere.photons": 2e8,
    "atmosphere.opd_rms_nm": 60,
    "detector.pixels_across_pupil": 32,
    "detector.window_pixels": 64,
    "simulation.light_oversampling": 4,
}


def simulate(path, *options, **changes):
    settings = SPARSE | {key.replace("__", "."): value for key, value in changes.items()}
    sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    return type_in("simulate", "--out", path, *sets, *options)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    path = tmp_path_factory.mktemp("segments") / "frames.fits"
    assert simulate(path).exit_code == 0
    return path


def test_the_file_says_which_pixel_belongs_to_which_segment(frames):
    written = fits.getdata(frames, "SEGMENTS")
    assert sorted(np.unique(written)) == [1, 2, 3, 4]
    # The order of the settings: at +x, +y, -x, -y; a pixel at each.
    assert [written[32, 50], written[50, 32], written[32, 13], written[13, 32]] == [1, 2, 3, 4]
    truth_m = fits.getdata(frames, "TRUTH")
    means = [np.nanmean(truth_m[written == number]) * 1e9 for number in (1, 2, 3, 4)]
    # The air, 60 nm rms over 8 m with its tilt, moves each by less than 100 nm from where it was put.
    np.testing.assert_allclose(np.array(means) - np.mean(means), np.array([-27.5, 122.5, -127.5, 32.5]), atol=100)
    geometry = sensor_geometry(read_frames(frames))
    np.testing.assert_array_equal(geometry.pupil.labels(geometry.frame), written - 1)


def test_reconstruct_tells_how_good_the_steps_are(frames, tmp_path):
    result = type_in("reconstruct", frames, "--out", tmp_path / "wavefront.fits", "--set", "estimation.map.healings=0")
    assert (
        "Segments: 4. One color tells the steps between them only up to whole wavelengths of 650 nm." in result.output
    )
    line = next(line for line in result.output.splitlines() if line.startswith("Steps: error "))
    piston_nm = float(line.split()[2])
    # Rims of the PUPIL map are those of pixels of 0.25 m: it costs a nanometre.
    assert 0 < piston_nm < 4
    assert "whole wavelengths off in 0 of 1 frames" in line


def test_reconstruct_tells_whole_wavelengths_of_a_band(tmp_path):
    """Steps of up to 1.7 wavelengths; the model has five wavelengths, the light more than twice as many."""
    path, found = tmp_path / "frames.fits", tmp_path / "wavefront.fits"
    light = {"beam__spectrum__shape": "flat", "beam__spectrum__bandwidth_ratio": 0.5, "beam__spectrum__wavelengths": 15}
    pixels = {"detector__pixels_across_pupil": 20, "detector__window_pixels": 40, "atmosphere__photons": 1e5}
    assert simulate(path, **light, **pixels, beam__segments__pistons_nm=[0, 700, -400, 300]).exit_code == 0
    result = type_in("reconstruct", path, "--out", found, "--set", "estimation.map.wavelengths=5")
    assert "Segments: 4. Whole wavelengths of the steps are right with probability 0.9999 or more." in result.output
    assert "whole wavelengths off in 0 of 1 frames" in result.output
    assert 0 <= fits.getval(found, "WRONGTRN") < 1e-4


def test_a_hand_written_map_of_segments_is_filled_to_the_rim(frames, tmp_path):
    path = tmp_path / "hand.fits"
    with fits.open(frames) as hdus:
        written = hdus["SEGMENTS"].data.astype(float) * 5
        written[hdus["PUPIL"].data < 0.5] = 0
        hdus["SEGMENTS"].data = written
        hdus.writeto(path)
    labels = read_frames(path).segments
    assert sorted(np.unique(labels)) == [0, 1, 2, 3]
    lit = fits.getdata(frames, "PUPIL") >= 0.5
    np.testing.assert_array_equal(labels[lit], fits.getdata(frames, "SEGMENTS")[lit] - 1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda map: map * 0, "SEGMENTS: must be whole numbers, 0 for no segment, got 0 to 0"),
        (lambda map: map + 0.5, "SEGMENTS: must be whole numbers, 0 for no segment, got 1.5 to 4.5"),
        (lambda map: map[1:], "SEGMENTS: must be an image of 64 x 64 pixels, as the frames"),
        (lambda map: np.where(map == 2, 1, map) + (np.indices(map.shape).sum(axis=0) == 0) * 8.0, "got 11 without"),
    ],
)
def test_a_map_of_segments_that_cannot_be_is_refused_in_one_line(frames, tmp_path, change, says):
    path = tmp_path / "bad.fits"
    with fits.open(frames) as hdus:
        hdus["SEGMENTS"].data = change(hdus["SEGMENTS"].data.astype(float))
        hdus.writeto(path)
    result = type_in("reconstruct", path, "--out", tmp_path / "wavefront.fits")
    assert result.exit_code == 2
    assert says in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_a_step_that_no_light_tells_is_refused(tmp_path):
    result = simulate(tmp_path / "frames.fits", curvature_sensor__distances_km=[-10, 10], atmosphere__photons=2e4)
    assert result.exit_code == 2
    assert "the step of segment 3 is not observable" in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_reconstruct_warns_of_a_step_that_no_light_tells(frames, tmp_path):
    path = tmp_path / "near.fits"
    with fits.open(frames) as hdus:
        for number in range(1, 5):
            hdus[0].header[f"ZPLANE{number}"] = (-2.0, -1.0, 1.0, 2.0)[number - 1]
        hdus.writeto(path)
    result = type_in("reconstruct", path, "--out", tmp_path / "w.fits", "--method", "gerchberg-saxton")
    warned = [line for line in result.output.splitlines() if "SEGMENTS: the step of segment" in line]
    assert len(warned) == 1
    assert "is not observable" in warned[0]


def test_segments_that_move_are_for_single_exposures(frames, tmp_path):
    moving = simulate(tmp_path / "frames.fits", "--sequence", "--rate", "500")
    assert moving.exit_code == 2
    assert "beam.segments: must have no pistons and tilts in a sequence or a loop" in moving.output
    with fits.open(frames) as hdus:
        hdus[0].data = np.stack([hdus[0].data] * 2)
        hdus[0].header["RATE"] = 500.0
        hdus.writeto(tmp_path / "two.fits")
    followed = type_in("reconstruct", tmp_path / "two.fits", "--out", tmp_path / "w.fits", "--sequence")
    assert followed.exit_code == 2
    assert "pupil: must be one piece to be followed from frame to frame" in followed.output
