"""Every bad input is told in one line that names the place, the rule and the value; exit code 2, nothing written."""

import os
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import small_frames, type_in

GOOD = {
    "BUNIT": "electron",
    "WAVELEN": 0.65e-6,
    "PIXSCALE": 8 / 24,
    "TELDIAM": 8.0,
    "ZPLANE1": -3.5e6,
    "ZPLANE2": 3.5e6,
}


def light():
    return np.random.default_rng(3).poisson(9.0, (2, 36, 36)).astype(float)


def written(path, image=None, *extra, **changes):
    header = {key: value for key, value in (GOOD | changes).items() if value is not None}
    parts = [fits.PrimaryHDU(light() if image is None else image, fits.Header(header))]
    parts += [fits.ImageHDU(data, name=name) for name, data in extra]
    fits.HDUList(parts).writeto(path)


def with_pixels(value, *, rows):
    image = light()
    image[:, :rows] = value
    return image


def dead_plane():
    image = light()
    image[1] = 0
    return image


BAD_FRAMES = {
    "not FITS": (lambda path: path.write_text("not an image"), "must be readable as FITS"),
    "no image": (lambda path: fits.HDUList([fits.PrimaryHDU()]).writeto(path), "must hold an image (plane, y, x)"),
    "two axes": (lambda path: written(path, light()[0]), "got 2 axes (36, 36)"),
    "no wavelength": (lambda path: written(path, WAVELEN=None), "WAVELEN: is required"),
    "distance repeated": (lambda path: written(path, ZPLANE2=-3.5e6), "ZPLANE2: must differ from ZPLANE1"),
    "distances zero": (lambda path: written(path, ZPLANE1=0.0, ZPLANE2=0.0), "must hold a plane out of the pupil"),
    "one distance missing": (lambda path: written(path, ZPLANE2=None), "ZPLANE1..2: must be one per plane"),
    "NaN": (lambda path: written(path, with_pixels(np.nan, rows=9)), "at most 10 % of its pixels without a value"),
    "infinite": (lambda path: written(path, with_pixels(np.inf, rows=9)), "got 25.0 % NaN or infinite"),
    "negative": (lambda path: written(path, light() - 50), "must not be negative"),
    "dead plane": (lambda path: written(path, dead_plane()), "plane 2 (ZPLANE2 = 3.5e+06 m) must hold light"),
    "plane ignored": (
        lambda path: written(path, None, ("BADPIX", np.stack([np.ones((36, 36)), np.zeros((36, 36))]))),
        "BADPIX: must leave pixels in every plane",
    ),
    "photons": (
        lambda path: written(path, PHOTONS=5e4),
        "must hold the 50000 photo-electrons of PHOTONS within a factor 2 (up to half may miss the window), got 23",
    ),
    "too many photons": (lambda path: written(path, PHOTONS=1e4), "10000 photo-electrons of PHOTONS within a factor 2"),
    "no photons": (lambda path: written(path, PHOTONS=0.0), "PHOTONS: must be a positive number of photo-electrons"),
    "saturated": (lambda path: written(path, SATURATE=8.0), "saturated (SATURATE)"),
    "all zero": (lambda path: written(path, 0 * light()), "must hold light, got zero everywhere"),
    "pupil of another shape": (
        lambda path: written(path, None, ("PUPIL", np.ones((30, 36)))),
        "PUPIL: must be an image of 36 x 36 pixels, as the frames, got 30 x 36",
    ),
    "pixels of 8 m": (lambda path: written(path, PIXSCALE=8.0), "PIXSCALE: must give at least 4 pixels"),
    "pixels of 1 cm": (lambda path: written(path, PIXSCALE=0.01), "PIXSCALE: must give a window"),
}


def refused(result, *words):
    """One line on stderr, exit code 2."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("nlcwfs: ")
    for word in words:
        assert str(word) in lines[0], lines[0]


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_frames_that_cannot_be_used_are_refused(tmp_path, name):
    write, rule = BAD_FRAMES[name]
    path = tmp_path / "bad.fits"
    write(path)
    refused(type_in("reconstruct", path, "--out", tmp_path / "w.fits"), path, rule)
    assert [each.name for each in tmp_path.iterdir()] == ["bad.fits"]


def test_frames_that_are_not_there_are_refused(tmp_path):
    refused(type_in("reconstruct", tmp_path / "no.fits", "--out", tmp_path / "w.fits"), "no.fits", "no such file")


OPTIONS = {
    "unknown key": (("--set", "estimation.iterations=3"), "estimation.iterations: unknown key, got 3; did you mean"),
    "key of the frames": (("--set", "beam.diameter_m=3"), "--set: must be a key of estimation"),
    "wrong type": (
        ("--set", "estimation.modes=many"),
        'estimation.modes: must be a whole number from 1 to 20000, got "many"',
    ),
    "no equals sign": (("--set", "estimation.modes"), "--set: must be section.key=value"),
    "method": (("--method", "magic"), "--method: must be map, gerchberg-saxton or linear, got magic"),
    "no Fried parameter": (
        ("--set", "estimation.prior.fried_m=-0.1"),
        "estimation.prior.fried_m: must be a number greater than 0 [m], got -0.1",
    ),
    "no seeing": (
        ("--set", "estimation.seeing_arcsec=0"),
        "estimation.seeing_arcsec: must be a number greater than 0 and at most 10 [arcsec], got 0",
    ),
    "outer scale": (
        ("--set", "estimation.prior.outer_scale_m=2"),
        "estimation.prior.outer_scale_m: must be at least the telescope's diameter (8 m), got 2",
    ),
    "one frame as a sequence": (("--sequence",), "frames.fits: PRIMARY: must hold at least 2 frames for --sequence"),
    "no folder": (("--out", "nowhere/w.fits"), "nowhere/w.fits: output folder must exist"),
    "the frames themselves": (("--out", "frames.fits"), "--out: must not overwrite the frames, got frames.fits"),
    "kind of picture": (("--plot", "p.gif"), "--plot: must end in .png, .pdf, .svg, .jpg, got p.gif"),
    "picture as wavefront": (("--out", "p.png", "--plot", "p.png"), "--plot: must be another file than --out"),
    "settings missing": (("--config", "no.toml"), "no.toml: no such file"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_that_cannot_be_used_are_refused_before_anything_is_computed(tmp_path, monkeypatch, name):
    options, rule = OPTIONS[name]
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "frames.fits")
    before = (tmp_path / "frames.fits").read_bytes()
    refused(type_in("reconstruct", "frames.fits", *options), rule)
    assert [each.name for each in tmp_path.iterdir()] == ["frames.fits"]
    assert (tmp_path / "frames.fits").read_bytes() == before


SETTINGS = {
    "unknown key": ("[beam]\ndiametre_m = 8", "beam.diametre_m: unknown key, got 8; did you mean diameter_m?"),
    "wrong type": ('[beam]\ndiameter_m = "8"', 'beam.diameter_m: must be a number from 0.01 to 100 [m], got "8"'),
    "wrong unit": ("[beam]\nwavelength_nm = 850", "beam.wavelength_nm: unknown key, got 850; the unit is in the name"),
    "value in another unit": ("[beam]\nwavelength_um = 850", "beam.wavelength_um: must be a number from 0.2 to 30"),
    "not TOML": ("[beam", "not valid TOML"),
    "pixels too wide": ("[detector]\npixels_across_pupil = 8", "detector.pixels_across_pupil: must suit the light"),
    "no map": ('[beam]\npupil_map = "no.fits"', "no.fits: file: must be readable as FITS, got no such file"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_that_cannot_be_used_are_refused(tmp_path, monkeypatch, name):
    text, rule = SETTINGS[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text(text)
    refused(type_in("simulate", "c.toml"), rule)
    assert [each.name for each in tmp_path.iterdir()] == ["c.toml"]


def test_each_bad_setting_has_its_own_line(tmp_path):
    result = type_in("simulate", "--out", tmp_path / "f.fits", "--set", "beam={diameter_m=-1, wavelength_um=0}")
    assert result.exit_code == 2
    assert [line.split(":")[1].strip() for line in result.stderr.splitlines()] == [
        "beam.diameter_m",
        "beam.wavelength_um",
    ]


BAD_MAPS = {
    "cube": (np.ones((2, 9, 9)), {}, "must hold an image (y, x) of the pupil, got 3 axes"),
    "above one": (2 * np.ones((9, 9)), {}, "must be an amplitude between 0 and 1, got 2 to 2"),
    "dark": (np.zeros((9, 9)), {}, "must let light through"),
    "NaN": (np.full((9, 9), np.nan), {}, "must be finite, got 81 NaN"),
    "of another telescope": (
        np.ones((9, 9)),
        {"PIXSCALE": 3.0},
        "must be as wide as the telescope, 8 m; is PIXSCALE right",
    ),
    "pixels below zero": (np.ones((9, 9)), {"PIXSCALE": -1.0}, "PIXSCALE: must be a positive number of metres"),
}


@pytest.mark.parametrize("name", BAD_MAPS)
def test_maps_of_the_pupil_that_cannot_be_used_are_refused(tmp_path, name):
    image, header, rule = BAD_MAPS[name]
    fits.writeto(tmp_path / "p.fits", image, fits.Header(header))
    result = type_in("simulate", "--out", tmp_path / "f.fits", "--set", f"beam.pupil_map={tmp_path / 'p.fits'}")
    refused(result, tmp_path / "p.fits", rule)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is read-only to root")
def test_a_read_only_folder_is_refused(tmp_path):
    written(tmp_path / "f.fits")
    (tmp_path / "shut").mkdir(mode=0o500)
    refused(type_in("reconstruct", tmp_path / "f.fits", "--out", tmp_path / "shut" / "w.fits"), "must be writable")


def test_a_folder_of_the_demo_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    refused(type_in("demo", "--out", tmp_path / "file" / "demo"), "must be a folder that can be made")


def test_an_unknown_figure_is_refused(tmp_path):
    refused(type_in("figure", "nine", "--out", tmp_path / "f.png"), "NAME: must be single-frame, got nine")


def test_a_few_missing_pixels_are_masked_told_and_leave_the_wavefront_alone(tmp_path):
    small_frames(tmp_path / "f.fits", "--seed", 2)
    with fits.open(tmp_path / "f.fits") as hdus:
        hdus[0].data[0, 5, 3:20] = np.nan
        hdus[0].data[2, 20, 7] = np.inf
        hdus.writeto(tmp_path / "g.fits")
    result = type_in("reconstruct", tmp_path / "g.fits", "--out", tmp_path / "w.fits")
    assert result.exit_code == 0
    assert "18 NaN or infinite pixels are masked" in result.stderr
    with fits.open(tmp_path / "w.fits") as hdus:
        assert np.isnan(hdus["RESIDUAL"].data[0, 5, 3:20]).all()
        assert hdus[0].header["ERR_NM"] < 45  # as the same frames without the gaps


def test_the_shell_sees_one_line_and_no_traceback(tmp_path):
    command = [sys.executable, "-m", "nlcwfs.cli", "reconstruct", str(tmp_path / "no.fits")]
    finished = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert finished.returncode == 2
    assert finished.stdout == ""
    assert len(finished.stderr.splitlines()) == 1
