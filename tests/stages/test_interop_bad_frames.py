"""Every bad frames file gives one line: the file, the keyword or HDU, the rule and the value."""

import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits

from nlcwfs.errors import FileFormatError
from nlcwfs.interop import read_frames

PLANES, HEIGHT, WIDTH = 3, 11, 14
GOOD = {
    "BUNIT": "electron",
    "WAVELEN": 0.65e-6,
    "PIXSCALE": 0.8,
    "TELDIAM": 8.0,
    "ZPLANE1": -3.5e6,
    "ZPLANE2": 2.5e6,
    "ZPLANE3": 3.5e6,
}


def light(*shape):
    return np.random.default_rng(3).poisson(40.0, shape or (PLANES, HEIGHT, WIDTH)).astype(float)


def write(path, image, *extra, **changes):
    """Write with plain astropy; a change to None takes the keyword away."""
    values = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    hdus = [fits.ImageHDU(np.asarray(data), name=name) for name, data in extra]
    fits.HDUList([fits.PrimaryHDU(image, fits.Header(values)), *hdus]).writeto(path)


def refusal(path):
    with pytest.raises(FileFormatError) as caught:
        read_frames(path)
    error = caught.value
    assert error.__cause__ is None
    assert error.__suppress_context__ or error.__context__ is None  # no second traceback
    line = str(error)
    assert "\n" not in line
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


HEADERS = {
    "no wavelength": ({"WAVELEN": None}, "WAVELEN: is required and must be in metres", "got no such keyword"),
    "wavelength in um": ({"WAVELEN": 0.65}, "WAVELEN: must be in metres between 1e-7 and 3e-5", "got 0.65"),
    "wavelength below zero": ({"WAVELEN": -6.5e-7}, "WAVELEN: must be in metres", "got -6.5e-07"),
    "wavelength as text": ({"WAVELEN": "0.65um"}, "WAVELEN: must be a number", "got '0.65um'"),
    "wavelength as flag": ({"WAVELEN": True}, "WAVELEN: must be a number", "got True"),
    "no pixel scale": ({"PIXSCALE": None}, "PIXSCALE: is required", "got no such keyword"),
    "pixel scale zero": ({"PIXSCALE": 0.0}, "PIXSCALE: must be a positive number", "got 0"),
    "pixels too wide": (
        {"PIXSCALE": 2.5},
        "PIXSCALE: must give at least 4 pixels across TELDIAM",
        "3.2 pixels",
    ),
    "window too narrow": (
        {"PIXSCALE": 0.3},
        "PIXSCALE: must give a window of at least half",
        "3.3 m across 11",
    ),
    "no diameter": ({"TELDIAM": None}, "TELDIAM: is required", "got no such keyword"),
    "diameter below zero": ({"TELDIAM": -8}, "TELDIAM: must be a positive number of metres", "got -8"),
    "no unit": ({"BUNIT": None}, "BUNIT: is required and must be 'electron' or 'adu'", "got no such keyword"),
    "unknown unit": ({"BUNIT": "Jy"}, "BUNIT: must be 'electron' or 'adu'", "got 'Jy'"),
    "unit as number": ({"BUNIT": 3}, "BUNIT: must be 'electron' or 'adu'", "got 3"),
    "adu without gain": ({"BUNIT": "adu", "RDNOISE": 1.0}, "GAIN: is required", "got no such keyword"),
    "adu without noise": ({"BUNIT": "adu", "GAIN": 1.0}, "RDNOISE: is required", "got no such keyword"),
    "gain zero": ({"GAIN": 0}, "GAIN: must be positive", "got 0"),
    "noise below zero": ({"RDNOISE": -1.0}, "RDNOISE: must be at least 0", "got -1"),
    "dark below zero": ({"DARK": -0.5}, "DARK: must be at least 0", "got -0.5"),
    "saturation zero": ({"SATURATE": 0}, "SATURATE: must be positive", "got 0"),
    "no distance": (
        {"ZPLANE1": None, "ZPLANE2": None, "ZPLANE3": None},
        "ZPLANE1: is required, a signed distance in metres",
        "got no such keyword",
    ),
    "too few distances": ({"ZPLANE2": None}, "ZPLANE1..3: must be one per plane", "got 2 (ZPLANE1, ZPLANE3)"),
    "too many distances": (
        {"ZPLANE4": 4e6},
        "ZPLANE1..3: must be one per plane of the image, 3",
        "got 4 (ZPLANE1",
    ),
    "distance as text": ({"ZPLANE2": "far"}, "ZPLANE2: must be a number", "got 'far'"),
    "distance repeated": ({"ZPLANE3": -3.5e6}, "ZPLANE3: must differ from ZPLANE1", "got -3.5e+06 in both"),
    "distances all zero": (
        {"ZPLANE1": 0.0, "ZPLANE2": 0.0, "ZPLANE3": 0.0},
        "ZPLANE1..3: must hold a plane out of the pupil",
        "got 0 for every plane",
    ),
    "shares incomplete": (
        {"FLUXFR1": 0.5, "FLUXFR2": 0.5},
        "FLUXFR1..3: must be one per plane",
        "got FLUXFR1, FL",
    ),
    "shares above one": (
        {"FLUXFR1": 0.5, "FLUXFR2": 0.5, "FLUXFR3": 0.5},
        "FLUXFR1..3: must sum to 1",
        "got 1.5",
    ),
    "share below zero": (
        {"FLUXFR1": -0.5, "FLUXFR2": 1, "FLUXFR3": 0.5},
        "FLUXFR1: must be a positive",
        "got -0.5",
    ),
    "obstruction of one": ({"CENOBS": 1.0}, "CENOBS: must be a ratio of at least 0 and below 1", "got 1"),
    "obstruction below zero": ({"CENOBS": -0.1}, "CENOBS: must be a ratio", "got -0.1"),
    "band too wide": (
        {"BANDWID": 1e-6},
        "BANDWID: must be in metres, at least 0 and below WAVELEN",
        "got 1e-06",
    ),
    "lenses as text": ({"CHROMLEN": "yes"}, "CHROMLEN: must be T or F", "got 'yes'"),
    "exposure zero": ({"EXPTIME": 0.0}, "EXPTIME: must be a positive number of seconds", "got 0"),
    "seeing below zero": ({"SEEING": -1.0}, "SEEING: must be a positive number of arcsec", "got -1"),
    "rate zero": ({"RATE": 0}, "RATE: must be a positive number of hertz", "got 0"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_a_bad_header_is_one_line(tmp_path, name):
    changes, rule, value = HEADERS[name]
    write(tmp_path / "f.fits", light(), **changes)
    line = refusal(tmp_path / "f.fits")
    assert line.startswith(rule)
    assert value in line


def test_planes_of_the_image_and_of_the_header_disagree(tmp_path):
    for planes in (2, 4):
        write(tmp_path / f"{planes}.fits", light(planes, HEIGHT, WIDTH))
        line = refusal(tmp_path / f"{planes}.fits")
        expected = f"ZPLANE1..{planes}: must be one per plane of the image, {planes}"
        assert line == f"{expected}, got 3 (ZPLANE1, ZPLANE2, ZPLANE3)"


def pixels(change):
    image = light()
    change(image)
    return image


def flatten(image):
    image[:] = 0


def lose(image):
    image[:, :2] = np.nan


def lose_infinity(image):
    image[:, :, :2] = np.inf


def fill(image):
    image[:, :3] = 5000


def reverse(image):
    image *= -1


def offset(image):
    image -= 60


def kill(image):
    image[1] = 0


IMAGES = {
    "zero": (pixels(flatten), {}, "PRIMARY: must hold light", "got zero everywhere"),
    "NaN": (
        pixels(lose),
        {},
        "PRIMARY: must have at most 10 % of its pixels without",
        "got 18.2 % NaN or infinite",
    ),
    "infinite": (pixels(lose_infinity), {}, "PRIMARY: must have at most 10 %", "got 14.3 % NaN or infinite"),
    "saturated": (
        pixels(fill),
        {"SATURATE": 4000},
        "PRIMARY: must have at most 10 %",
        "got 27.3 % saturated",
    ),
    "negative": (
        pixels(reverse),
        {"RDNOISE": 2.0},
        "PRIMARY: must not be negative beyond the noise",
        "got 100 %",
    ),
    "bias": (
        pixels(offset),
        {"RDNOISE": 2.0},
        "PRIMARY: must not be negative beyond the noise",
        "of the pixels",
    ),
    "no light": (
        np.random.default_rng(0).normal(0, 2.0, (PLANES, HEIGHT, WIDTH)),
        {"RDNOISE": 2.0},
        "PRIMARY: must hold light above its noise",
        "electrons after background and dark, noise 43",
    ),
    "dead plane": (
        pixels(kill),
        {"RDNOISE": 2.0},
        "PRIMARY: plane 2 (ZPLANE2 = 2.5e+06 m) must hold light",
        "got 0 of the ",
    ),
    "two axes": (
        light(HEIGHT, WIDTH),
        {},
        "PRIMARY: must hold an image (plane, y, x) or (frame,",
        "got 2 axes (11, 14)",
    ),
    "five axes": (
        light(1, 1, PLANES, HEIGHT, WIDTH),
        {},
        "PRIMARY: must hold an image",
        "got 5 axes (1, 1, 3, 11, 14)",
    ),
    "nothing": (None, {}, "PRIMARY: must hold an image", "got no image"),
}


@pytest.mark.parametrize("name", IMAGES)
def test_a_bad_image_is_one_line(tmp_path, name):
    image, changes, rule, value = IMAGES[name]
    write(tmp_path / "f.fits", image, **changes)
    line = refusal(tmp_path / "f.fits")
    assert line.startswith(rule)
    assert value in line


def test_a_file_without_one_usable_frame_names_the_first(tmp_path):
    write(tmp_path / "f.fits", np.zeros((5, PLANES, HEIGHT, WIDTH)))
    line = refusal(tmp_path / "f.fits")
    assert line == "PRIMARY: none of 5 frames can be used; frame 0 must hold light, got zero everywhere"


def test_a_background_that_is_already_subtracted_shows_as_negative_light(tmp_path):
    dim = np.random.default_rng(4).normal(0, 1.0, (PLANES, HEIGHT, WIDTH))
    write(tmp_path / "f.fits", dim, ("BACKGROUND", np.full((HEIGHT, WIDTH), 400.0)), RDNOISE=1.0)
    assert refusal(tmp_path / "f.fits").startswith("PRIMARY: must not be negative beyond the noise of RDNOISE, DARK")


def with_nan(value):
    image = np.full((HEIGHT, WIDTH), value)
    image[3, 3] = np.nan
    return image


MAPS = {
    "pupil shape": ("PUPIL", np.ones((WIDTH, HEIGHT)), "must be an image of 11 x 14 pixels", "got 14 x 11"),
    "pupil NaN": ("PUPIL", with_nan(1.0), "must be finite", "got 1 NaN or infinite pixels"),
    "pupil above one": (
        "PUPIL",
        np.full((HEIGHT, WIDTH), 1.5),
        "must be an amplitude between 0 and 1",
        "got 1.5 to",
    ),
    "pupil below zero": (
        "PUPIL",
        np.full((HEIGHT, WIDTH), -0.5),
        "must be an amplitude between",
        "got -0.5 to -0.5",
    ),
    "pupil dark": ("PUPIL", np.zeros((HEIGHT, WIDTH)), "must let light through", "got 0 at most"),
    "badpix shape": (
        "BADPIX",
        np.zeros((2, HEIGHT, WIDTH)),
        "must be an image of 11 x 14 or 3 x 11 x 14",
        "got 2 x 11",
    ),
    "badpix all": (
        "BADPIX",
        np.ones((HEIGHT, WIDTH)),
        "must leave pixels in every plane",
        "got all of a plane",
    ),
    "background shape": (
        "BACKGROUND",
        np.zeros((WIDTH,)),
        "must be an image of 11 x 14 or 3 x 11 x 14",
        "got 14",
    ),
    "background NaN": ("BACKGROUND", with_nan(2.0), "must be finite", "got 1 NaN"),
    "truth shape": (
        "TRUTH",
        np.zeros((HEIGHT, 9)),
        "must be an image of 11 x 14 or 1 x 11 x 14",
        "got 11 x 9",
    ),
    "truth in nm": ("TRUTH", np.full((HEIGHT, WIDTH), 350.0), "must be in metres, within 0.001", "got 350"),
    "truth NaN": (
        "TRUTH",
        np.full((HEIGHT, WIDTH), np.nan),
        "must be finite in the pupil",
        "got no finite pixel",
    ),
}


@pytest.mark.parametrize("name", MAPS)
def test_a_bad_map_is_one_line(tmp_path, name):
    hdu, data, rule, value = MAPS[name]
    write(tmp_path / "f.fits", light(), (hdu, data))
    line = refusal(tmp_path / "f.fits")
    assert line.startswith(f"{hdu}: {rule}")
    assert value in line


def test_maps_in_another_unit_are_refused(tmp_path):
    for name, unit, rule in (("TRUTH", "nm", "BUNIT 'm'"), ("BACKGROUND", "adu", "the BUNIT of the frames")):
        hdu = fits.ImageHDU(np.zeros((HEIGHT, WIDTH)), fits.Header({"BUNIT": unit}), name=name)
        path = tmp_path / f"{name}.fits"
        fits.HDUList([fits.PrimaryHDU(light(), fits.Header(GOOD)), hdu]).writeto(path)
        line = refusal(path)
        assert line.startswith(f"{name}: must have {rule}")
        assert line.endswith(f"got '{unit}'")


def test_a_table_in_place_of_a_map_is_refused(tmp_path):
    table = fits.BinTableHDU.from_columns([fits.Column("a", "D", array=np.ones(4))], name="PUPIL")
    fits.HDUList([fits.PrimaryHDU(light(), fits.Header(GOOD)), table]).writeto(tmp_path / "f.fits")
    assert refusal(tmp_path / "f.fits") == "PUPIL: must be an image of 11 x 14 pixels, as the frames, got no image"


def test_no_file_a_folder_and_files_that_are_not_fits(tmp_path):
    assert refusal(tmp_path / "none.fits") == "file: must be readable as FITS, got no such file"
    assert refusal(tmp_path) == "file: must be readable as FITS, got a folder"
    for name, content in {
        "empty": b"",
        "text": b"plane y x\n1 2 3\n" * 400,
        "noise": bytes(range(256)) * 40,
    }.items():
        (tmp_path / name).write_bytes(content)
        assert refusal(tmp_path / name).startswith("file: must be readable as FITS, got ")


@pytest.mark.parametrize("kept", [300, 2880, 2881, 4000, 5800])
def test_a_file_that_ends_too_early_is_refused(tmp_path, kept):
    write(tmp_path / "f.fits", light())
    content = (tmp_path / "f.fits").read_bytes()
    assert len(content) > 6000
    (tmp_path / "f.fits").write_bytes(content[:kept])
    assert refusal(tmp_path / "f.fits").startswith("file: must be readable as FITS, got ")


def test_a_card_that_astropy_cannot_read_is_named(tmp_path):
    write(tmp_path / "f.fits", light())
    content = (tmp_path / "f.fits").read_bytes()
    at = content.index(b"TELDIAM =")
    comma = b"TELDIAM =                  8,0".ljust(80)
    (tmp_path / "f.fits").write_bytes(content[:at] + comma + content[at + 80 :])
    assert refusal(tmp_path / "f.fits").startswith("TELDIAM: must be a ")


def test_reading_needs_no_accelerator_library():
    code = "import sys, nlcwfs.interop; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
