"""Writing whole or not at all, and the stamp of every file."""

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from nlcwfs.errors import FileFormatError
from nlcwfs.interop import (
    Provenance,
    atomic_write,
    check_writable,
    provenance,
    read_provenance,
    settings_digest,
)
from nlcwfs.interop.fits_keywords import header_of, write_hdus


def one_line(caught, path):
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{path}: ")
    assert caught.value.__cause__ is None
    return line.removeprefix(f"{path}: ")


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failure_in_the_middle_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    path = tmp_path / "w.fits"
    path.write_text("old")

    def fail_half_way():
        with atomic_write(path) as temporary:
            temporary.write_text("half of the n")
            assert temporary.parent == tmp_path
            assert temporary.suffix == ".fits"
            raise failure

    with pytest.raises(failure):
        fail_half_way()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_new_file_takes_the_place_of_the_old(tmp_path):
    path = tmp_path / "w.fits"
    path.write_text("old")
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "w.fits"
    path.write_text("old")

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(FileFormatError) as caught:
        write_hdus(path, [fits.PrimaryHDU(np.ones((3, 4)))])
    assert one_line(caught, path) == "cannot be written, got No space left on device"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_output_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    expected = {
        tmp_path / "none" / "w.fits": f"output folder must exist, got no {tmp_path / 'none'}",
        tmp_path / "file" / "w.fits": f"output folder must be a folder, got the file {tmp_path / 'file'}",
        tmp_path / "folder": "output must be a file, got a folder",
        tmp_path / ("n" * 300) / "w.fits": "output must be reachable, got File name too long",
    }
    for path, line in expected.items():
        with pytest.raises(FileFormatError) as caught:
            check_writable(path)
        assert one_line(caught, path) == line
        with pytest.raises(FileFormatError), atomic_write(path):
            pytest.fail("the block must not run")
    check_writable(tmp_path / "w.fits")
    check_writable(tmp_path / "file")


def test_a_read_only_folder_or_file_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "w.fits"
    path.write_text("old")
    # The tests may run as root, whom permissions do not stop: the answer of the system is replaced.
    monkeypatch.setattr(os, "access", lambda asked, mode: Path(asked) != tmp_path)
    with pytest.raises(FileFormatError) as caught:
        check_writable(path)
    assert one_line(caught, path) == f"output folder must be writable, got the read-only {tmp_path}"
    monkeypatch.setattr(os, "access", lambda asked, mode: Path(asked) != path)
    with pytest.raises(FileFormatError) as caught:
        check_writable(path)
    assert one_line(caught, path) == "output must be writable, got a read-only file"


def test_a_relative_path_is_written_in_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_writable("w.txt")
    with atomic_write("w.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "w.txt").read_text() == "new"


def test_the_digest_is_that_of_sorted_json():
    settings = {"b": (1, 2.5), "a": {"path": Path("x/y"), "n": np.int64(3), "values": np.array([0.1, 0.2])}}
    text = '{"a":{"n":3,"path":"x/y","values":[0.1,0.2]},"b":[1,2.5]}'
    assert settings_digest(settings) == hashlib.sha256(text.encode()).hexdigest()
    assert settings_digest({**settings, "b": (1, 2.6)}) != settings_digest(settings)
    with pytest.raises(TypeError, match="settings: must be made of numbers"):
        settings_digest({"a": object()})


def test_the_stamp_fits_in_a_header_and_comes_back(tmp_path):
    stamp = Provenance.collect({"pixels": 64}, seed=11, device="CPU mit 2 Kernen, größer " + "x" * 90)
    hdu = fits.PrimaryHDU(np.ones((2, 3)), header_of(stamp.cards()))
    hdu.verify("exception")
    hdu.writeto(tmp_path / "s.fits", output_verify="exception")
    header = fits.getheader(tmp_path / "s.fits")
    assert all(len(key) <= 8 for key, _, _ in stamp.cards())
    assert header["CFGHASH"] == hashlib.sha256(b'{"pixels":64}').hexdigest()
    assert header["SEED"] == 11
    assert header["DEVICE"] == "CPU mit 2 Kernen, gr??er " + "x" * 90
    assert header["NUMPYVER"] == np.__version__
    again = read_provenance(tmp_path / "s.fits")
    assert again == Provenance(**{**stamp.as_dict(), "device": header["DEVICE"]})


def test_a_stamp_without_seed_has_no_seed_keyword(tmp_path):
    stamp = Provenance.collect({}, seed=None, device="cpu")
    assert "SEED" not in {key for key, _, _ in stamp.cards()}
    assert stamp.as_dict()["seed"] is None
    fits.PrimaryHDU(header=header_of(stamp.cards())).writeto(tmp_path / "s.fits")
    assert read_provenance(tmp_path / "s.fits") == stamp
    fits.PrimaryHDU().writeto(tmp_path / "bare.fits")
    assert read_provenance(tmp_path / "bare.fits").commit == "unknown"


def test_the_commit_is_that_of_the_checkout_or_unknown():
    checkout = Path(provenance.__file__).resolve().parents[3]
    provenance._commit.cache_clear()
    commit = Provenance.collect({}, seed=None, device="cpu").commit
    head = checkout / ".git" / "HEAD"
    if shutil.which("git") is None or not head.is_file():
        pytest.skip("not a checkout with git")
    run = subprocess.run(["git", "-C", str(checkout), "rev-parse", "HEAD"], capture_output=True, text=True)
    expected = run.stdout.strip() if run.returncode == 0 else "unknown"  # git may distrust a folder's owner
    assert commit.removesuffix("-dirty") == expected


@pytest.mark.parametrize(
    "failure",
    [
        FileNotFoundError("git"),
        subprocess.TimeoutExpired("git", 5),
        subprocess.CalledProcessError(128, "git"),
    ],
)
def test_a_missing_or_broken_git_never_fails(monkeypatch, failure):
    def broken(*arguments, **options):
        raise failure

    monkeypatch.setattr(subprocess, "run", broken)
    provenance._commit.cache_clear()
    try:
        assert Provenance.collect({}, seed=None, device="cpu").commit == "unknown"
    finally:
        provenance._commit.cache_clear()
