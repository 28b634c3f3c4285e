"""`nlcwfs config`, `demo`, `figure` and the help."""

import re
import struct
import subprocess
import sys
import time

import pytest
from astropy.io import fits
from tests.stages.command_line import SMALL, small_frames, type_in

from nlcwfs.config import Config, load_config


def size_of_png(path):
    """Width and height, from the bytes of the file (PNG specification, sec. 11.2.2)."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", data[16:24])


def test_the_printed_settings_are_the_defaults_and_read_back(tmp_path):
    result = type_in("config")
    assert result.exit_code == 0
    (tmp_path / "c.toml").write_text(result.stdout)
    assert load_config(tmp_path / "c.toml") == Config()
    assert type_in("config", "--check", tmp_path / "c.toml").stdout == f"{tmp_path / 'c.toml'}: ok\n"
    assert type_in("config", "--out", tmp_path / "d.toml").exit_code == 0
    assert (tmp_path / "d.toml").read_text().strip() == result.stdout.strip()


def test_a_file_that_may_have_been_edited_is_not_overwritten(tmp_path):
    (tmp_path / "c.toml").write_text("seed = 7")
    result = type_in("config", "--out", tmp_path / "c.toml")
    assert result.exit_code == 2
    assert (tmp_path / "c.toml").read_text() == "seed = 7"


def test_every_problem_of_a_file_is_listed(tmp_path):
    (tmp_path / "c.toml").write_text('[beam]\ndiameter_m = "8"\n[beamz]\nx = 1\n')
    result = type_in("config", "--check", tmp_path / "c.toml")
    assert result.exit_code == 2
    assert [line.split(": ")[2] for line in result.stderr.splitlines()] == ["beam.diameter_m", "beamz"]


def test_the_help_does_not_wait_for_jax():
    code = "import sys, nlcwfs.cli; sys.exit(any(name in sys.modules for name in ('jax', 'astropy', 'matplotlib')))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
    started = time.perf_counter()
    told = subprocess.run([sys.executable, "-m", "nlcwfs.cli", "--help"], capture_output=True, text=True, timeout=60)
    assert time.perf_counter() - started < 10  # 0.4 s on an idle machine; with JAX it would be 2 s
    assert all(name in told.stdout for name in ("demo", "simulate", "reconstruct", "config", "figure"))


def test_the_demo_leaves_files_a_picture_and_the_error(tmp_path):
    result = type_in("demo", "--out", tmp_path / "demo")
    assert result.exit_code == 0, result.output
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"config.toml", "frames.fits", "wavefront.fits", "single-frame.png"}
    error_nm = fits.getheader(tmp_path / "demo" / "wavefront.fits")["ERR_NM"]
    assert error_nm < 60
    told = float(re.findall(r"Error of the wavefront: ([0-9.]+) nm rms", result.stdout)[0])
    # On the grid of the light, what lies between the pixels counts too: some 13 nm at D/r0 = 8.2, in quadrature.
    assert 8 < (told**2 - error_nm**2) ** 0.5 < 25
    width, height = size_of_png(tmp_path / "demo" / "single-frame.png")
    assert width > 1.5 * height > 1000  # two rows of four panels, at the size of a page


def test_the_figure_says_its_numbers(tmp_path):
    sets = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
    result = type_in("figure", "single-frame", "--out", tmp_path / "f.svg", "--seed", 2, *sets)
    assert result.exit_code == 0, result.output
    residual_nm = float(result.stdout.split("Residual ")[1].split(" nm")[0])
    pixels_nm = float(result.stdout.split("grid of the light, ")[1].split(" nm")[0])
    # The finer grid sees what pixels of 0.33 m leave: 0.29 N^(-0.87) (D/r0)^(5/3) rad^2 (Noll), 20 nm and less.
    assert pixels_nm < residual_nm < pixels_nm + 20
    assert (tmp_path / "f.svg").read_text().count("<svg") == 1


@pytest.mark.parametrize("truth", [True, False])
def test_the_picture_of_a_reconstruction_is_drawn(tmp_path, truth):
    small_frames(tmp_path / "f.fits", "--seed", 2)
    with fits.open(tmp_path / "f.fits") as hdus:
        kept = [hdu.copy() for hdu in hdus if truth or hdu.name != "TRUTH"]
        fits.HDUList(kept).writeto(tmp_path / "g.fits")
    result = type_in("reconstruct", tmp_path / "g.fits", "--out", tmp_path / "w.fits", "--plot", tmp_path / "p.png")
    assert result.exit_code == 0, result.output
    assert ("ERR_NM" in fits.getheader(tmp_path / "w.fits")) == truth
    width, height = size_of_png(tmp_path / "p.png")
    assert width > height > 1000  # three rows of four panels
