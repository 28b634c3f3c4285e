"""Frames in FITS, both ways: expected files are written and read with plain astropy, never with our code."""

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from nlcwfs.errors import SettingsError
from nlcwfs.interop import FramesFile, Provenance, read_frames, write_frames

pytestmark = pytest.mark.filterwarnings("error::astropy.utils.exceptions.AstropyWarning")  # bent cards
PLANES, HEIGHT, WIDTH = 3, 11, 14
STAMP = Provenance.collect({"pixels": 11}, seed=5, device="cpu")
OPTICS = {
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
    header = fits.Header({"BUNIT": "electron", **OPTICS, **changes})
    hdus = [fits.ImageHDU(np.asarray(data), name=name) for name, data in extra]
    fits.HDUList([fits.PrimaryHDU(image, header), *hdus]).writeto(path)
    return path


def full_record():
    rng = np.random.default_rng(8)
    shape = (2, PLANES, HEIGHT, WIDTH)
    bad = np.zeros((HEIGHT, WIDTH), bool)
    bad[2, 9] = True
    masked = np.broadcast_to(bad, shape).copy()
    masked[1, 2, 4, 7] = True
    electrons = np.where(masked & ~bad, 0.0, rng.gamma(5.0, 9.0, shape))
    masked[0, 1, 5, 5], electrons[0, 1, 5, 5] = True, 3000.0  # full
    return FramesFile(
        electrons=electrons,
        masked=masked,
        has_frame_axis=True,
        pixel_m=0.8,
        wavelength_m=0.85e-6,
        diameter_m=8.0,
        distances_m=(-2.0e6, 1.0e6, 3.0e6),
        obstruction_ratio=0.25,
        bandwidth_m=0.1e-6,
        chromatic_lenses=True,
        gain_electrons_per_adu=1.7,
        read_noise_electrons=1.5,
        dark_electrons=0.5,
        saturation_electrons=3000.0,
        flux_fractions=(0.25, 0.35, 0.4),
        exposure_s=1e-3,
        seeing_arcsec=0.8,
        rate_hz=500.0,
        photons=16000.0,
        times_s=np.array([4.25, 4.254]),
        pupil=rng.uniform(0.5, 1.0, (HEIGHT, WIDTH)) * (np.abs(np.arange(WIDTH) - 6.5) < 5),
        background=rng.uniform(0.0, 2.0, (PLANES, HEIGHT, WIDTH)),
        bad_pixels=bad,
        truth_m=rng.normal(0.0, 5e-7, (2, HEIGHT, WIDTH)),
        segments=np.broadcast_to(np.arange(WIDTH) > 6, (HEIGHT, WIDTH)).astype(int),
    )


def test_a_hand_written_file_is_read_the_right_way_up(tmp_path):
    image = light()
    image[1, 0, 2] = 500.0  # smallest y, third column
    frames = read_frames(write(tmp_path / "f.fits", image.astype(">f4")))
    np.testing.assert_array_equal(frames.electrons, image[None])
    assert frames.electrons.dtype == np.dtype("=f8")
    assert not frames.has_frame_axis
    assert not frames.masked.any()
    assert frames.warnings == ()
    assert frames.distances_m == (-3.5e6, 2.5e6, 3.5e6)
    assert (frames.wavelength_m, frames.pixel_m, frames.diameter_m) == (0.65e-6, 0.8, 8.0)
    assert frames.flux_fractions is None
    assert frames.source == "f.fits"


def test_adu_become_electrons_and_so_does_their_background(tmp_path):
    image = light(2, PLANES, HEIGHT, WIDTH).astype(np.uint16)
    background = np.full((HEIGHT, WIDTH), 1.5)
    path = write(tmp_path / "f.fits", image, ("BACKGROUND", background), BUNIT="ADU", GAIN=2.5, RDNOISE=1.5, DARK=0.25)
    frames = read_frames(path)
    np.testing.assert_array_equal(frames.electrons, image * 2.5)
    np.testing.assert_array_equal(frames.background, background * 2.5)
    np.testing.assert_allclose(frames.photo_electrons(), image * 2.5 - 3.75 - 0.25, rtol=1e-13)  # rounding
    assert frames.has_frame_axis
    assert frames.read_noise_electrons == 1.5  # already electrons, not scaled


def test_a_compressed_file_is_read_and_written(tmp_path):
    write(tmp_path / "f.fits.gz", light())
    np.testing.assert_array_equal(read_frames(tmp_path / "f.fits.gz").electrons, light()[None])
    write_frames(tmp_path / "g.fits.gz", full_record(), STAMP)
    assert (tmp_path / "g.fits.gz").read_bytes()[:2] == b"\x1f\x8b"  # the mark of gzip
    np.testing.assert_array_equal(fits.getdata(tmp_path / "g.fits.gz")[1, 0], full_record().electrons[1, 0])


@pytest.mark.parametrize("unit", ["electron", "Electrons", "e-", " electron "])
def test_electrons_have_several_spellings(tmp_path, unit):
    frames = read_frames(write(tmp_path / "f.fits", light(), BUNIT=unit))
    np.testing.assert_array_equal(frames.electrons, light()[None])


@pytest.mark.parametrize("unit", ["electron", "adu"])
def test_what_is_written_is_read_back(tmp_path, unit):
    record = full_record()
    write_frames(tmp_path / "f.fits", record, STAMP, unit=unit)
    again = read_frames(tmp_path / "f.fits")
    for item in dataclasses.fields(FramesFile):
        if item.name in ("warnings", "source", "source_digest"):
            continue
        old, new = getattr(record, item.name), getattr(again, item.name)
        if isinstance(old, np.ndarray) and old.dtype != bool:
            np.testing.assert_allclose(new, old, rtol=1e-14, err_msg=item.name)  # times and over the gain
        elif isinstance(old, np.ndarray):
            np.testing.assert_array_equal(new, old, err_msg=item.name)
        else:
            assert new == (old if isinstance(old, str) else pytest.approx(old, rel=1e-14)), item.name
    assert again.warnings == (
        "PRIMARY: 1 NaN or infinite pixels are masked in 1 of 2 frames",
        "PRIMARY: 1 saturated pixels (SATURATE) are masked in 1 of 2 frames",
    )


def test_the_written_file_holds_the_contract(tmp_path):
    record = full_record()
    write_frames(tmp_path / "f.fits", record, STAMP)
    with fits.open(tmp_path / "f.fits") as hdus:
        hdus.verify("exception")
        header = hdus[0].header
        expected = {
            "BUNIT": "electron",
            "WAVELEN": 0.85e-6,
            "PIXSCALE": 0.8,
            "TELDIAM": 8.0,
            "ZPLANE1": -2.0e6,
            "ZPLANE3": 3.0e6,
            "CENOBS": 0.25,
            "BANDWID": 0.1e-6,
            "CHROMLEN": True,
            "GAIN": 1.7,
            "RDNOISE": 1.5,
            "DARK": 0.5,
            "SATURATE": 3000.0,
            "FLUXFR2": 0.35,
            "EXPTIME": 1e-3,
            "SEEING": 0.8,
            "RATE": 500.0,
            "PHOTONS": 16000.0,
            "SEED": 5,
            "DEVICE": "cpu",
            "CFGHASH": STAMP.settings_digest,
        }
        assert {key: header[key] for key in expected} == expected
        assert hdus[0].data.shape == (2, PLANES, HEIGHT, WIDTH)
        assert np.isnan(hdus[0].data[1, 2, 4, 7])
        np.testing.assert_array_equal(hdus[0].data[0, 1, 0], record.electrons[0, 1, 0])  # row 0 stays row 0
        np.testing.assert_array_equal(hdus["PUPIL"].data, record.pupil)
        np.testing.assert_array_equal(hdus["BACKGROUND"].data, record.background)
        np.testing.assert_array_equal(hdus["BADPIX"].data, record.bad_pixels.astype(int))
        np.testing.assert_array_equal(hdus["TRUTH"].data, record.truth_m)
        assert hdus["TRUTH"].header["BUNIT"] == "m"
        np.testing.assert_array_equal(hdus["TIME"].data, record.times_s)


def test_ds9_places_the_pixels_at_the_scale_of_the_telescope(tmp_path):
    write_frames(tmp_path / "f.fits", full_record(), STAMP)
    world = WCS(fits.getheader(tmp_path / "f.fits", "PUPIL"))
    x_m, y_m = world.pixel_to_world_values(13, 0)  # last column, first row
    assert (float(x_m), float(y_m)) == pytest.approx((6.5 * 0.8, -5.0 * 0.8))
    in_frames = WCS(fits.getheader(tmp_path / "f.fits"), naxis=2).pixel_to_world_values(13, 0)
    assert [float(value) for value in in_frames] == pytest.approx([6.5 * 0.8, -5.0 * 0.8])


def test_counts_are_stored_in_half_the_space_without_loss(tmp_path):
    record = dataclasses.replace(full_record(), electrons=np.round(full_record().electrons))
    write_frames(tmp_path / "f.fits", record, STAMP)
    assert fits.getheader(tmp_path / "f.fits")["BITPIX"] == -32
    np.testing.assert_array_equal(read_frames(tmp_path / "f.fits").electrons, record.electrons)


def test_light_alone_has_no_background_no_dark_and_no_masked_pixels():
    record = full_record()
    expected = record.electrons - 0.5 - record.background
    expected[:, :, 2, 9] = 0.0
    expected[1, 2, 4, 7] = expected[0, 1, 5, 5] = 0.0
    np.testing.assert_allclose(record.photo_electrons(), expected, rtol=1e-13)  # order of the subtractions


def test_shares_with_two_digits_are_scaled_to_sum_one(tmp_path):
    frames = read_frames(write(tmp_path / "f.fits", light(), FLUXFR1=0.33, FLUXFR2=0.33, FLUXFR3=0.33))
    assert frames.flux_fractions == pytest.approx((1 / 3, 1 / 3, 1 / 3), rel=1e-15)


def test_missing_values_are_masked_zero_and_reported(tmp_path):
    image = light()
    image[0, 3, 4], image[2, 10, 13] = np.nan, -np.inf
    frames = read_frames(write(tmp_path / "f.fits", image))
    assert np.argwhere(frames.masked).tolist() == [[0, 0, 3, 4], [0, 2, 10, 13]]
    assert frames.electrons[0, 0, 3, 4] == frames.electrons[0, 2, 10, 13] == 0
    assert np.isfinite(frames.electrons).all()
    assert frames.warnings == ("PRIMARY: 2 NaN or infinite pixels are masked",)


def test_ignored_pixels_are_masked_and_not_counted_as_missing(tmp_path):
    image, bad = light(), np.zeros((HEIGHT, WIDTH))
    bad[:, :5] = 1
    image[:, :, :5] = np.nan  # a third of the frame
    frames = read_frames(write(tmp_path / "f.fits", image, ("BADPIX", bad)))
    np.testing.assert_array_equal(frames.masked, np.broadcast_to(bad != 0, (1, PLANES, HEIGHT, WIDTH)))
    assert frames.warnings == ()


def test_ignored_pixels_may_differ_between_planes(tmp_path):
    bad = np.zeros((PLANES, HEIGHT, WIDTH), np.uint8)
    bad[1, 4, 5] = 1
    frames = read_frames(write(tmp_path / "f.fits", light(), ("badpix", bad)))
    assert np.argwhere(frames.masked).tolist() == [[0, 1, 4, 5]]


def test_saturated_pixels_are_masked_and_reported_in_the_unit_of_the_file(tmp_path):
    image = light()
    image[1, 5, 6], image[1, 5, 7] = 200, 199
    path = write(tmp_path / "f.fits", image, BUNIT="adu", GAIN=3.0, RDNOISE=1.0, SATURATE=200)
    frames = read_frames(path)
    assert np.argwhere(frames.masked).tolist() == [[0, 1, 5, 6]]
    assert frames.saturation_electrons == 600
    assert frames.warnings == ("PRIMARY: 1 saturated pixels (SATURATE) are masked",)


def test_a_flat_top_without_saturate_is_told(tmp_path):
    image = np.minimum(light() * np.linspace(0.2, 2.0, WIDTH), 70.0)
    warning = read_frames(write(tmp_path / "f.fits", image)).warnings
    count = np.count_nonzero(image == 70.0)
    assert warning == (f"PRIMARY: {count} pixels share the largest value of their frame: saturated? Give SATURATE",)


def test_read_noise_may_make_dark_pixels_negative(tmp_path):
    noise = np.random.default_rng(1).normal(0, 3.0, (PLANES, HEIGHT, WIDTH))
    image = noise + np.where(np.arange(WIDTH) < 5, 60.0, 0.0)
    frames = read_frames(write(tmp_path / "f.fits", image, RDNOISE=3.0))
    assert (frames.electrons < 0).mean() > 0.2
    assert frames.warnings == ()


def test_a_few_impossible_negative_pixels_are_told(tmp_path):
    image = light()
    image[0, 0, :4] = -30
    warning = read_frames(write(tmp_path / "f.fits", image, RDNOISE=2.0)).warnings
    assert warning == ("PRIMARY: 4 pixels are further below zero than their noise explains (5 sigma)",)


def test_one_dead_frame_among_many_is_named_and_the_others_are_kept(tmp_path):
    image = light(4, PLANES, HEIGHT, WIDTH)
    image[1] = 0
    image[3, 1] = 0
    frames = read_frames(write(tmp_path / "f.fits", image))
    assert list(frames.frame_problems) == [1, 3]
    assert frames.frame_problems[1] == "must hold light, got zero everywhere"
    assert frames.frame_problems[3].startswith("plane 2 (ZPLANE2 = 2.5e+06 m) must hold light, got 0 of the ")
    np.testing.assert_array_equal(frames.electrons, image)


def test_a_faint_star_is_not_called_dead(tmp_path):
    rng = np.random.default_rng(6)
    image = rng.poisson(1.5, (20, PLANES, HEIGHT, WIDTH)) + rng.normal(0, 3.0, (20, PLANES, HEIGHT, WIDTH))
    frames = read_frames(write(tmp_path / "f.fits", image, RDNOISE=3.0))
    assert frames.frame_problems == {}


def test_doubtful_optics_are_told(tmp_path):
    narrow = read_frames(write(tmp_path / "a.fits", light(), PIXSCALE=0.5)).warnings
    assert narrow == ("PIXSCALE: the window of 5.5 m is narrower than TELDIAM = 8 m",)
    km = read_frames(write(tmp_path / "b.fits", light(), ZPLANE1=-3500, ZPLANE2=2500, ZPLANE3=3500)).warnings
    assert len(km) == 1
    assert km[0].startswith("ZPLANE: light hardly changes on the way, sqrt(WAVELEN ZPLANE) = 0.048 m")
    small = np.zeros((HEIGHT, WIDTH))
    small[4:7, 4:7] = 1
    pupil = read_frames(write(tmp_path / "c.fits", light(), ("PUPIL", small))).warnings
    assert pupil == ("PUPIL: is 2.4 m wide, but TELDIAM is 8 m; is PIXSCALE right?",)
    other = read_frames(write(tmp_path / "d.fits", light(), ("PUPILLE", small))).warnings
    assert other == ("PUPILLE: is not one of PUPIL, SEGMENTS, BACKGROUND, BADPIX, TRUTH, TIME, ignored",)
    uneven = light() * np.array([0.1, 1, 1])[:, None, None]
    shares = read_frames(write(tmp_path / "e.fits", uneven)).warnings
    assert len(shares) == 1
    assert shares[0].startswith("FLUXFR1: plane 1 has 4.")


def test_truth_may_be_missing_outside_the_pupil(tmp_path):
    truth = np.random.default_rng(2).normal(0, 4e-7, (HEIGHT, WIDTH))
    truth[0] = np.nan
    frames = read_frames(write(tmp_path / "f.fits", light(), ("TRUTH", truth)))
    np.testing.assert_array_equal(frames.truth_m, truth)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"distances_m": (1.0, 2.0)}, "frames.distances_m"),
        ({"has_frame_axis": False}, "frames.has_frame_axis"),
        ({"background": np.ones((2, HEIGHT, WIDTH))}, "frames.background"),
        ({"bad_pixels": np.ones((WIDTH, HEIGHT), bool)}, "frames.bad_pixels"),
        ({"truth_m": np.ones((3, HEIGHT, WIDTH))}, "frames.truth_m"),
    ],
)
def test_a_record_does_not_contradict_itself(change, where):
    with pytest.raises(SettingsError, match=where):
        dataclasses.replace(full_record(), **change)


def test_adu_are_not_written_without_a_gain(tmp_path):
    record = dataclasses.replace(full_record(), gain_electrons_per_adu=None)
    with pytest.raises(SettingsError, match="gain_electrons_per_adu"):
        write_frames(tmp_path / "f.fits", record, STAMP, unit="adu")
    assert not (tmp_path / "f.fits").exists()
