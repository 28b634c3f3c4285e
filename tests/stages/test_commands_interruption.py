"""Ctrl-C in the middle of many frames keeps what is done, and a later run goes on from there."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import small_frames, type_in

from nlcwfs.interop.frames_reconstruction import FramesReconstructor


@pytest.fixture
def frames(tmp_path):
    small_frames(tmp_path / "f.fits", "--frames", 4, "--seed", 1)
    return tmp_path / "f.fits"


def interrupted_after(count, monkeypatch):
    """Ctrl-C while a frame is computed, after `count` whole ones."""
    whole, calls = FramesReconstructor.reconstruct, []

    def reconstruct(self, number):
        calls.append(number)
        if len(calls) > count:
            raise KeyboardInterrupt
        return whole(self, number)

    monkeypatch.setattr(FramesReconstructor, "reconstruct", reconstruct)
    return calls


def reconstructed(*words):
    """With the method that compiles fastest: how frames are kept is the same for all."""
    return type_in("reconstruct", *words, "--method", "gerchberg-saxton")


def outcomes(path):
    return [str(name) for name in fits.getdata(path, "FRAMES")["outcome"]]


def test_what_is_done_is_kept_and_resumed(tmp_path, frames, monkeypatch):
    out = tmp_path / "w.fits"
    whole = reconstructed(frames, "--out", tmp_path / "whole.fits")
    assert whole.exit_code == 0
    with monkeypatch.context() as patch:
        interrupted_after(2, patch)
        result = reconstructed(frames, "--out", out)
    assert result.exit_code == 130
    assert "interrupted: 2 frames are in" in result.stderr
    assert "2 are not run; go on with --resume" in result.stderr
    assert outcomes(out)[2:] == ["not run", "not run"]
    opd_m = fits.getdata(out)
    assert np.isfinite(opd_m[:2]).any(axis=(1, 2)).all()
    assert np.isnan(opd_m[2:]).all()
    with monkeypatch.context() as patch:
        calls = interrupted_after(99, patch)
        result = reconstructed(frames, "--out", out, "--resume")
    assert result.exit_code == 0, result.output
    assert calls == [2, 3]
    assert "Done before: 2 frames" in result.stdout
    np.testing.assert_array_equal(fits.getdata(out), fits.getdata(tmp_path / "whole.fits"))
    np.testing.assert_array_equal(
        fits.getdata(out, "MODES")["coefficient_m"], fits.getdata(tmp_path / "whole.fits", "MODES")["coefficient_m"]
    )


def test_before_the_first_frame_nothing_is_written(tmp_path, frames, monkeypatch):
    interrupted_after(0, monkeypatch)
    result = reconstructed(frames, "--out", tmp_path / "w.fits")
    assert result.exit_code == 130
    assert result.stderr.strip() == "nlcwfs: interrupted before the first frame: nothing was written"
    assert not (tmp_path / "w.fits").exists()


def test_only_the_same_frames_and_settings_are_resumed(tmp_path, frames):
    out = tmp_path / "w.fits"
    assert reconstructed(frames, "--out", out, "--resume").exit_code == 0  # nothing there yet: from the start
    before = out.read_bytes()
    other = reconstructed(frames, "--out", out, "--resume", "--set", "estimation.modes=20")
    assert other.exit_code == 2
    assert "CFGHASH: must be of the same settings" in other.stderr
    small_frames(frames, "--frames", 4, "--seed", 2)
    other = reconstructed(frames, "--out", out, "--resume")
    assert other.exit_code == 2
    assert "INSHA256: must be of the same frames" in other.stderr
    assert out.read_bytes() == before


def test_bad_frames_are_left_out_named_and_flagged(tmp_path, frames):
    with fits.open(frames) as hdus:
        hdus[0].data[1] = 0
        hdus.writeto(tmp_path / "g.fits")
    result = reconstructed(tmp_path / "g.fits", "--out", tmp_path / "w.fits")
    assert result.exit_code == 1
    assert "frame 1 is left out: it must hold light, got zero everywhere" in result.stderr
    assert outcomes(tmp_path / "w.fits")[1] == "bad frame"
    assert [name == "converged" for name in outcomes(tmp_path / "w.fits")] == [True, False, True, True]


# A test run in the background of a shell is deaf to Ctrl-C, and its children inherit that: hear it again.
HEARING = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from nlcwfs.cli import main; main()"


def test_a_real_ctrl_c_keeps_what_is_done(tmp_path):
    path, out = tmp_path / "f.fits", tmp_path / "w.fits"
    small_frames(path, "--frames", 1)
    with fits.open(path) as hdus:
        hdus[0].data = np.repeat(hdus[0].data[None], 1000, axis=0)
        hdus.writeto(path, overwrite=True)
    command = [sys.executable, "-c", HEARING, "reconstruct", str(path), "--out", str(out)]
    command += ["--method", "gerchberg-saxton"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes, env=environment) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("Compiled"):  # from here on a frame is done in some 10 ms
                break
        try:
            process.wait(timeout=0.5)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in complaint
    done = fits.getheader(out)["NDONE"]
    assert 0 < done < 1000
    assert outcomes(out).count("not run") == 1000 - done
