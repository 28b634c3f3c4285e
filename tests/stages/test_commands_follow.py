"""`nlcwfs reconstruct --sequence`: frames that follow each other, those that are missing, and those that jump."""

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import small_frames, type_in

from nlcwfs.interop import read_frames
from nlcwfs.interop.frame_times import frame_times
from nlcwfs.interop.frames_reconstruction import FramesReconstructor

FEW = ("--set", "estimation.modes=100")
COUNT = 6
RATE_HZ = 500.0


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Six frames of one sky."""
    path = tmp_path_factory.mktemp("sequence") / "f.fits"
    narrow = ("--set", "atmosphere.screen_width_m=20")
    small_frames(path, "--sequence", "--rate", RATE_HZ, "--frames", COUNT, "--seed", 3, *narrow)
    return path


def changed(source, path, change=None, *, times_s=None, **header):
    """The frames with other pixels, other times or another header."""
    with fits.open(source) as hdus:
        parts = [hdu.copy() for hdu in hdus]
    if change is not None:
        change(parts[0].data)
    for key, value in header.items():
        if value is None:
            del parts[0].header[key]
        else:
            parts[0].header[key] = value
    if times_s is not None:
        parts.append(fits.ImageHDU(np.asarray(times_s, float), name="TIME"))
    fits.HDUList(parts).writeto(path)
    return path


def followed(path, out, *options):
    return type_in("reconstruct", path, "--out", out, "--sequence", *FEW, *options)


def rows_of(out):
    return fits.getdata(out, "FRAMES")


def test_frames_follow_the_first_at_a_tenth_of_its_ffts(tmp_path, frames):
    result = followed(frames, tmp_path / "w.fits")
    assert result.exit_code == 0, result.output
    assert "Sequence: 6 frames at 500 Hz; 97 FFTs for each frame that follows another." in result.stdout
    assert "Followed: 5 frames; reconstructed alone: 1." in result.stdout
    rows = rows_of(tmp_path / "w.fits")
    assert list(rows["ffts"][1:]) == [97] * 5  # 4 planes, 3 steps of 2, 2 and 1 conjugate gradients
    assert rows["ffts"][0] > 300
    assert [str(sentence) for sentence in rows["sentence"][1:]] == [f"done: it follows frame {n}" for n in range(5)]
    # 12 nm of photon noise alone, and what 24 pixels are too coarse for; several frames know more than the first.
    assert np.all(rows["error_nm"] < 45)
    assert rows["error_nm"][1:].mean() < rows["error_nm"][0]
    assert np.isfinite(rows["quantum_limit_nm"][0])
    assert np.isnan(rows["quantum_limit_nm"][1:]).all()


def test_a_missing_frame_is_a_step_of_time_and_a_jump_starts_again(tmp_path, frames):
    small_frames(tmp_path / "other.fits", "--seed", 11, atmosphere__opd_rms_nm=500)
    other = fits.getdata(tmp_path / "other.fits")

    def change(data):
        data[2] = 0
        data[4] = other  # another, wilder sky: a few steps do not lead there

    times_s = np.arange(COUNT) / RATE_HZ + np.where(np.arange(COUNT) > 2, 3 / RATE_HZ, 0)
    path = changed(frames, tmp_path / "g.fits", change, times_s=100 + times_s)
    result = followed(path, tmp_path / "w.fits")
    assert result.exit_code == 1, result.output  # for the frame that is zero
    assert "Sequence: 6 frames at 500 Hz, 3 intervals without a frame" in result.stdout
    assert "frame 2 is left out: it must hold light, got zero everywhere" in result.stderr
    rows = rows_of(tmp_path / "w.fits")
    assert [str(name) == "bad frame" for name in rows["outcome"]] == [False, False, True, False, False, False]
    assert str(rows["sentence"][3]) == "done: it follows frame 1"
    assert rows["ffts"][3] == 97 + 2 * 4  # two for each interval that passed: a dead frame and three of the clock
    assert "alone: as a follower of frame 3 it was not believed" in str(rows["sentence"][4])
    assert rows["ffts"][4] > 97 + 300  # both tries count
    assert rows["error_nm"][3] < 45


def test_an_interrupted_sequence_goes_on_alone_from_the_first_frame_that_is_left(tmp_path, frames, monkeypatch):
    whole, calls = FramesReconstructor.account, []

    def account(self, number, estimate, *, seconds):
        calls.append(number)
        if len(calls) > 3:
            raise KeyboardInterrupt
        return whole(self, number, estimate, seconds=seconds)

    with monkeypatch.context() as patch:
        patch.setattr(FramesReconstructor, "account", account)
        assert followed(frames, tmp_path / "w.fits").exit_code == 130
    first = fits.getdata(tmp_path / "w.fits")[:3]
    alone = type_in("reconstruct", frames, "--out", tmp_path / "w.fits", "--resume", *FEW)
    assert alone.exit_code == 2
    assert "CFGHASH: must be of the same settings" in alone.stderr  # a sequence is not continued as single frames
    result = followed(frames, tmp_path / "w.fits", "--resume")
    assert result.exit_code == 0, result.output
    assert "Done before: 3 frames" in result.stdout
    rows = rows_of(tmp_path / "w.fits")
    assert rows["ffts"][3] > 300
    assert str(rows["sentence"][4]) == "done: it follows frame 3"
    np.testing.assert_array_equal(fits.getdata(tmp_path / "w.fits")[:3], first)


STEADY_S = np.arange(COUNT) / RATE_HZ
REFUSED = {
    "no clock": ({"RATE": None}, None, (), "RATE: is required for --sequence, in hertz, or an HDU TIME"),
    "rate 0": ({"RATE": 0.0}, None, (), "RATE: must be a positive number of hertz, got 0"),
    "rate below 0": ({"RATE": -5.0}, None, (), "RATE: must be a positive number of hertz, got -5"),
    "times too few": ({}, STEADY_S[:4], (), "TIME: must hold the seconds of every frame, 6, got 4"),
    "times back": ({}, STEADY_S[::-1], (), "TIME: must ascend, got 0.008 s for frame 1 after 0.01 s"),
    "time twice": ({}, STEADY_S * [1, 1, 1, 1, 1, 0.8], (), "TIME: must ascend, got 0.008 s for frame 5 after 0.008 s"),
    "time missing": ({}, np.where(STEADY_S > 0.009, np.nan, STEADY_S), (), "TIME: must be finite, got nan for frame 5"),
    "times irregular": (
        {},
        STEADY_S + 0.0007 * (np.arange(COUNT) > 2),
        (),
        "TIME: must be whole multiples of 1/RATE = 0.002 s apart, within 1 % of it, got 0.0027 s between frames 2 ",
    ),
    "irregular without a rate": (
        {"RATE": None},
        STEADY_S + 0.0007 * (np.arange(COUNT) > 2),
        (),
        "TIME: must be whole multiples of the shortest interval apart, within 1 % of it, got 0.0027 s between",
    ),
    "linear": ({}, None, ("--method", "linear"), "--sequence: must come with --method map, got linear"),
    "paper": ({}, None, ("--method", "gerchberg-saxton"), "must come with --method map, got gerchberg-saxton"),
    "few FFTs": (
        {},
        None,
        ("--set", "estimation.map.ffts_per_frame=10"),
        "estimation.map.ffts_per_frame: must be at least 75 for 4 planes and 3 steps, got 10",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_sequences_that_cannot_be_followed_are_refused_in_a_line(tmp_path, frames, name):
    header, times_s, options, rule = REFUSED[name]
    path = changed(frames, tmp_path / "g.fits", times_s=times_s, **header)
    result = followed(path, tmp_path / "w.fits", *options)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert rule in result.stderr
    assert not (tmp_path / "w.fits").exists()


def test_a_clock_that_jitters_a_little_or_a_rate_that_is_rounded_is_taken(tmp_path, frames):
    jitter_s = 0.003 / RATE_HZ * np.array([0, 1, -1, 1, 0, -1])  # differences up to 0.6 % of a frame
    steps = np.array([0, 1, 2, 100, 101, 180])
    path = changed(frames, tmp_path / "g.fits", times_s=1.7e9 + steps / 499.5 + jitter_s)
    times = frame_times(read_frames(path), path)
    assert times.steps == tuple(steps)
    assert times.interval_s == pytest.approx(1 / 499.5, rel=1e-4)
