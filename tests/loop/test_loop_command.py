"""`nlcwfs loop`: the folder that it leaves, and what it says of bad input."""

import errno
import json
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import aotpy
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from small_loop import SMALL, small

sys.path.insert(0, str(Path(__file__).parents[1] / "stages"))
from command_line import type_in

from nlcwfs.commands import loop as command
from nlcwfs.commands.loop_keeping import Checkpoints
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import run_loop


def typed(out, *words, settings=()):
    sets = [word for setting in [*SMALL, *settings] for word in ("--set", setting)]
    return type_in("loop", "--out", out, *sets, *words)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("loop") / "run"
    result = typed(out)
    assert result.exit_code == 0, result.output
    return out, result.output


def test_the_folder_holds_what_happened(run):
    out, said = run
    numbers = json.loads((out / "summary.json").read_text())
    assert numbers["outcome"] == "closed"
    assert numbers["frames"] == 60
    assert set(numbers) >= {"rms_nm", "rms_by_group_nm", "strehl", "rate_hz", "frames_to_close", "seconds", "bounds"}
    assert f"{numbers['rms_nm']:.1f} nm rms" in said
    frames = Table.read(out / "frames.ecsv")
    assert len(frames) == 60
    counted = frames["rms_nm"][-numbers["frames_counted"] :]
    assert np.sqrt(np.mean(counted**2)) == pytest.approx(numbers["rms_nm"], abs=0.01)
    assert numbers["provenance"]["seed"] == 0
    assert (out / "loop.png").stat().st_size > 20_000


def test_the_image_is_fits_and_knows_its_strehl(run):
    out, _ = run
    with fits.open(out / "psf.fits") as hdus:
        hdus.verify("exception")
        image, header = hdus[0].data, hdus[0].header
    middle = np.array(image.shape) // 2
    assert np.unravel_index(np.argmax(image), image.shape) == pytest.approx(tuple(middle), abs=1)
    assert header["STREHL"] == pytest.approx(image[tuple(middle)], rel=0.02)  # the middle pixel is the axis
    # lambda / D / 2 is 43.8 mas for 2 m at 0.85 um.
    assert header["PIXSCALE"] == pytest.approx(0.0438, rel=0.01)


def test_the_telemetry_opens_as_the_standard_says(run):
    out, _ = run
    system = (
        aotpy.read_system_from_file(str(out / "telemetry.fits"))
        if hasattr(aotpy, "read_system_from_file")
        else aotpy.AOSystem.read_from_file(str(out / "telemetry.fits"))
    )
    (control,) = system.loops
    assert control.framerate == 500
    assert control.commands.data.shape[0] == 60
    assert np.all(np.asarray(control.commands.data)[0] == 0)  # the mirror is flat at first
    assert np.std(np.asarray(control.commands.data)[-1]) > 1e-8
    assert system.main_telescope.enclosing_diameter == 2.0


def test_a_folder_with_a_run_is_not_overwritten(run):
    out, _ = run
    result = typed(out)
    assert result.exit_code == 2
    assert "must be empty or new, got a folder with a run" in result.output


def test_a_run_goes_on_with_its_own_settings_only(run):
    out, _ = run
    result = typed(out, "--resume", settings=["seed=5"])
    assert result.exit_code == 2
    assert "must be resumed with the settings of" in result.output


def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path):
    config = small("loop.seconds=0.04")
    loop = Loop.build(config)
    _, whole = run_loop(loop)
    folder_of.prepare_folder(tmp_path / "run", config, resume=False)

    def stop(state, records):
        if len(records) == 12:
            folder_of.write_checkpoint(tmp_path / "run", config, state, records)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_loop(loop, watch=stop)
    state, records = folder_of.read_checkpoint(tmp_path / "run", config)
    _, resumed = run_loop(Loop.build(config), state=state, records=records)
    assert [one.rms_nm for one in resumed] == [one.rms_nm for one in whole]


def test_a_damaged_checkpoint_is_told(tmp_path):
    (tmp_path / "checkpoint.pickle").write_bytes(b"not one")
    result = typed(tmp_path, "--resume")
    assert result.exit_code == 2
    assert "checkpoint.pickle: must be a whole checkpoint" in result.output


def test_a_star_too_faint_ends_with_one(tmp_path):
    result = typed(tmp_path / "run", settings=["atmosphere.photons_per_s=2e3", "loop.give_up_s=0.03"])
    assert result.exit_code == 1
    assert "the loop is not closed: no wavefront was believed in 15 frames of 4 photons" in result.output
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["rms_nm"] is None


def test_a_star_is_told_by_its_magnitude(tmp_path):
    """Bessell's 3636 Jy at 0.545 um over h: 1.007e11 photons / s / m^2 / um of magnitude 0; 2 m, half obstructed."""
    star = ["atmosphere.photons_per_s=", "atmosphere.star.magnitude=10", "atmosphere.star.throughput=0.3"]
    fast = ["loop.sensor=ideal", "loop.seconds=0.02", "loop.settle_s=0", "beam.obstruction_ratio=0.5"]
    result = typed(tmp_path / "run", settings=[*star, *fast])
    assert result.exit_code == 0
    numbers = json.loads((tmp_path / "run" / "summary.json").read_text())
    expected = 1.0069e11 * 1e-4 * 0.5 * 0.3 * np.pi * 0.75
    assert numbers["magnitude"] == 10
    assert numbers["photons_per_s"] == pytest.approx(expected, rel=1e-3)
    assert numbers["photons_per_frame"] == pytest.approx(expected / 500, rel=1e-3)
    assert f"Star of magnitude 10: {expected:.3g} photons a second" in result.output


@pytest.mark.parametrize(
    ("setting", "rule"),
    [
        ("atmosphere.star.magnitude=13", "atmosphere.photons_per_s: must be left out with atmosphere.star.magnitude"),
        ("atmosphere.photons_per_s=0", "atmosphere.photons_per_s: must be"),
        ("loop.rate_hz=2", "loop.rate_hz: must be higher"),
        ("feedback.gain=3", "feedback.gain: must be"),
        ("mirror.cutoff_cpa=40", "mirror.cutoff_cpa"),
        ("loop.sensor=quadcell", "loop.sensor: must be"),
    ],
)
def test_settings_that_cannot_be_are_told_in_a_line(tmp_path, setting, rule):
    result = typed(tmp_path / "run", settings=[setting])
    assert result.exit_code == 2
    assert rule in result.output
    assert not (tmp_path / "run" / "summary.json").exists()


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    result = typed(tmp_path / "file" / "run")
    assert result.exit_code == 2
    assert "must be a folder that can be written" in result.output


FAST = ["loop.sensor=ideal", "loop.seconds=0.06", "loop.settle_s=0.01"]


def disturbed(monkeypatch, out, disturb):
    """A run in which something happens at frame 10; checkpoints after every frame, files for rescue beside it."""
    whole = Loop.step

    def step(self, state):
        if state.frame == 10:
            disturb()
        return whole(self, state)

    monkeypatch.setattr(Loop, "step", step)
    monkeypatch.setattr(command, "CHECKPOINT_EVERY_S", 0.0)
    (out.parent / "rescue").mkdir(exist_ok=True)
    monkeypatch.setattr(tempfile, "tempdir", str(out.parent / "rescue"))
    return typed(out, settings=FAST)


def full_disk(monkeypatch, where):
    """No file below a folder can be written any more, though some bytes of it are."""
    whole = Path.write_bytes

    def write(self, data):
        if self.is_relative_to(where):
            whole(self, data[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return whole(self, data)

    monkeypatch.setattr(Path, "write_bytes", write)


def warnings_in(result):
    return [line for line in result.stderr.splitlines() if line.startswith("warning: ")]


EVERYTHING = {
    "checkpoint.pickle",
    "config.toml",
    "frames.ecsv",
    "loop.png",
    "psf.fits",
    "summary.json",
    "telemetry.fits",
}


def test_a_folder_that_goes_away_is_told_once_and_made_again(tmp_path, monkeypatch):
    out = tmp_path / "run"
    result = disturbed(monkeypatch, out, lambda: shutil.rmtree(out))
    assert result.exit_code == 0
    line = f"{out}/checkpoint.pickle: output folder must exist, got no {out}; the run goes on and tries again"
    assert warnings_in(result) == [f"warning: {line}"]
    assert {path.name for path in out.iterdir()} == EVERYTHING
    assert json.loads((out / "summary.json").read_text())["frames"] == 30


def test_a_full_disk_costs_no_result(tmp_path, monkeypatch):
    out = tmp_path / "run"
    result = disturbed(monkeypatch, out, lambda: full_disk(monkeypatch, out))
    assert result.exit_code == 2
    why = f"{out}/checkpoint.pickle: cannot be written, got No space left on device"
    (rescue,) = (tmp_path / "rescue").iterdir()
    assert result.stderr.splitlines() == [
        f"warning: {why}; the run goes on and tries again",
        f"nlcwfs: {why}; the run is kept in {rescue}",
    ]
    assert "nm rms" in result.stdout
    assert {path.name for path in out.iterdir()} == {"checkpoint.pickle", "config.toml"}  # both from before, and whole
    config = small(*FAST)
    assert len(folder_of.read_checkpoint(out, config)[1]) == 10
    assert {path.name for path in rescue.iterdir()} == EVERYTHING
    assert len(folder_of.read_checkpoint(rescue, config)[1]) == 30


def test_a_disk_that_is_full_for_a_while_is_told_each_time_it_begins(tmp_path, monkeypatch, capsys):
    folder, config = tmp_path / "run", small(*FAST)
    checkpoints = Checkpoints(folder, config)
    loop = Loop.build(config)
    state = loop.init()
    for there in (False, False, True, False):
        shutil.rmtree(folder, ignore_errors=True)
        if there:
            folder.mkdir()
        checkpoints.write(state, [])
    assert capsys.readouterr().err.count("the run goes on and tries again") == 2


def test_a_run_that_can_be_kept_nowhere_says_so(tmp_path, monkeypatch):
    out = tmp_path / "run"
    result = disturbed(monkeypatch, out, lambda: full_disk(monkeypatch, tmp_path))
    assert result.exit_code == 2
    (last,) = (line for line in result.stderr.splitlines() if line.startswith("nlcwfs: "))
    assert "No space left on device; nor can the run be kept elsewhere: " in last
    assert not list((tmp_path / "rescue").iterdir())
    assert "nm rms" in result.stdout  # what was found is told all the same


def test_a_folder_that_becomes_a_file_costs_no_result(tmp_path, monkeypatch):
    out = tmp_path / "run"

    def replace():
        shutil.rmtree(out)
        out.write_text("")

    result = disturbed(monkeypatch, out, replace)
    assert result.exit_code == 2
    assert len(warnings_in(result)) == 1
    (rescue,) = (tmp_path / "rescue").iterdir()
    assert f"output folder must be a folder, got the file {out}; the run is kept in {rescue}" in result.stderr
    assert {path.name for path in rescue.iterdir()} == EVERYTHING


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_told_to_end_keeps_what_is_done(tmp_path, monkeypatch, number):
    out = tmp_path / "run"
    before = signal.getsignal(signal.SIGTERM)
    # In the background of a shell Python ignores Ctrl-C.
    as_it_was = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = disturbed(monkeypatch, out, lambda: signal.raise_signal(number))
    finally:
        signal.signal(signal.SIGINT, as_it_was)
    assert result.exit_code == 130
    assert result.stderr == "nlcwfs: interrupted\n"
    assert f"Kept 10 frames in {out}; --resume goes on." in result.stdout
    assert len(folder_of.read_checkpoint(out, small(*FAST))[1]) == 10
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_run_that_is_told_to_end_on_a_full_disk_is_kept_elsewhere(tmp_path, monkeypatch):
    out = tmp_path / "run"

    def both():
        full_disk(monkeypatch, out)
        raise KeyboardInterrupt

    result = disturbed(monkeypatch, out, both)
    assert result.exit_code == 130
    (rescue,) = (tmp_path / "rescue").iterdir()
    assert f"No space left on device; the run is kept in {rescue}" in result.stderr
    assert len(folder_of.read_checkpoint(rescue, small(*FAST))[1]) == 10
