"""Wavefronts in FITS: what ds9, a script with plain astropy, and our own reader find in them."""

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from nlcwfs.errors import FileFormatError, SettingsError
from nlcwfs.interop import (
    BAD_FRAME,
    NOT_RUN,
    FramesFile,
    FrameWavefront,
    Provenance,
    WavefrontFile,
    read_provenance,
    read_wavefront,
    write_frames,
    write_wavefront,
)

pytestmark = pytest.mark.filterwarnings("error::astropy.utils.exceptions.AstropyWarning")  # bent cards
PLANES, HEIGHT, WIDTH = 3, 11, 14
NOLL = [2, 3, 4, 7]
STAMP = Provenance.collect({"method": "gs"}, seed=9, device="a fast one")


def frames(count=1, **changes):
    shape = (count, PLANES, HEIGHT, WIDTH)
    fields = {
        "electrons": np.ones(shape),
        "masked": np.zeros(shape, bool),
        "has_frame_axis": count > 1,
        "pixel_m": 0.8,
        "wavelength_m": 0.65e-6,
        "diameter_m": 8.0,
        "distances_m": (-3e6, 1e6, 3e6),
        "source": "night1.fits",
    }
    return FramesFile(**{**fields, **changes})


def result(seed, **changes):
    rng = np.random.default_rng(seed)
    opd_m = rng.normal(0, 4e-7, (HEIGHT, WIDTH))
    opd_m[:, :2] = np.nan
    fields = {
        "opd_m": opd_m,
        "rms_nm": 400.0 + seed,
        "outcome": "converged",
        "iterations": 10 + seed,
        "ffts": 90 + seed,
        "predicted_error_nm": 30.0 + seed,
        "runtime_s": 0.5 + seed,
        "coefficient_m": rng.normal(0, 1e-7, len(NOLL)),
        "sigma_m": rng.uniform(1e-9, 2e-9, len(NOLL)),
        "error_nm": 33.0 + seed,
        "residual": rng.normal(0, 3.0, (PLANES, HEIGHT, WIDTH)),
        "sentence": "the fit is as good as the noise allows",
    }
    return FrameWavefront(**{**fields, **changes})


def build(done, source):
    return WavefrontFile.from_frames(done, source, method="gerchberg-saxton", noll=NOLL)


def assert_same_frame(found, expected):
    for item in dataclasses.fields(FrameWavefront):
        new, old = getattr(found, item.name), getattr(expected, item.name)
        if item.name == "residual" and old is not None:
            np.testing.assert_allclose(new, old, rtol=1e-7)  # single precision rounds to 6e-8
        elif isinstance(old, np.ndarray):
            np.testing.assert_array_equal(new, old, err_msg=item.name)
        else:
            assert new == old, item.name


def test_the_file_of_one_frame_holds_the_contract(tmp_path):
    one = result(1)
    write_wavefront(tmp_path / "w.fits", build({0: one}, frames()), STAMP)
    with fits.open(tmp_path / "w.fits") as hdus:
        hdus.verify("exception")
        header = hdus[0].header
        expected = {
            "BUNIT": "m",
            "RMS_NM": 401.0,
            "METHOD": "gerchberg-saxton",
            "OUTCOME": "converged",
            "OUTNOTE": "the fit is as good as the noise allows",
            "NITER": 11,
            "NFFT": 91,
            "PREDERR": 31.0,
            "RUNTIME": 1.5,
            "ERR_NM": 34.0,
            "WAVELEN": 0.65e-6,
            "PIXSCALE": 0.8,
            "TELDIAM": 8.0,
            "INPUT": "night1.fits",
            "SEED": 9,
            "DEVICE": "a fast one",
            "NLCWFSV": STAMP.version,
        }
        assert {key: header[key] for key in expected} == expected
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "MODES", "RESIDUAL"]
        np.testing.assert_array_equal(hdus[0].data, one.opd_m)  # row 0 stays row 0, NaN stays NaN
        assert hdus["MODES"].columns.names == ["noll", "coefficient_m", "sigma_m"]
        np.testing.assert_array_equal(hdus["MODES"].data["noll"], NOLL)
        np.testing.assert_array_equal(hdus["MODES"].data["coefficient_m"], one.coefficient_m)
        np.testing.assert_array_equal(hdus["MODES"].data["sigma_m"], one.sigma_m)
        np.testing.assert_array_equal(hdus["RESIDUAL"].data, one.residual.astype("f4"))


def test_ds9_places_the_pixels_at_the_scale_of_the_telescope(tmp_path):
    write_wavefront(tmp_path / "w.fits", build({0: result(1)}, frames()), STAMP)
    x_m, y_m = WCS(fits.getheader(tmp_path / "w.fits")).pixel_to_world_values(0, 10)  # first column, last row
    assert (float(x_m), float(y_m)) == pytest.approx((-6.5 * 0.8, 5.0 * 0.8))


def test_one_frame_is_read_back(tmp_path):
    write_wavefront(tmp_path / "w.fits", build({0: result(4)}, frames()), STAMP)
    again = read_wavefront(tmp_path / "w.fits")
    assert_same_frame(again.finished()[0], result(4))
    assert not again.has_frame_axis
    assert (again.pixel_m, again.wavelength_m, again.diameter_m) == (0.8, 0.65e-6, 8.0)
    assert again.method == "gerchberg-saxton"
    assert again.source == "night1.fits"
    np.testing.assert_array_equal(again.noll, NOLL)
    assert read_provenance(tmp_path / "w.fits") == STAMP


def test_several_frames_have_a_table_and_the_header_its_medians(tmp_path):
    done = {2: result(2), 0: result(0, outcome="stalled", sentence="it stopped early"), 1: result(7)}
    write_wavefront(tmp_path / "w.fits", build(done, frames(3)), STAMP)
    with fits.open(tmp_path / "w.fits") as hdus:
        hdus.verify("exception")
        header, table, modes = hdus[0].header, hdus["FRAMES"].data, hdus["MODES"].data
        assert hdus[0].data.shape == (3, HEIGHT, WIDTH)
        np.testing.assert_array_equal(hdus[0].data[1], result(7).opd_m)
        np.testing.assert_array_equal(hdus["RESIDUAL"].data[2], result(2).residual.astype("f4"))
        assert table["frame"].tolist() == [0, 1, 2]
        assert table["rms_nm"].tolist() == [400.0, 407.0, 402.0]
        assert list(table["outcome"]) == ["stalled", "converged", "converged"]
        assert table["iterations"].tolist() == [10, 17, 12]
        assert table["ffts"].tolist() == [90, 97, 92]
        assert table["error_nm"].tolist() == [33.0, 40.0, 35.0]
        assert modes["frame"].tolist() == [0] * 4 + [1] * 4 + [2] * 4
        np.testing.assert_array_equal(modes["coefficient_m"][4:8], result(7).coefficient_m)
        numbers = ("RMS_NM", "NITER", "NFFT", "PREDERR", "RUNTIME", "ERR_NM", "NFRAMES", "NDONE")
        assert [header[key] for key in numbers] == [402.0, 12, 92, 32.0, 2.5, 35.0, 3, 3]
        assert header["OUTCOME"] == "mixed: 2 converged, 1 stalled"
    again = read_wavefront(tmp_path / "w.fits").finished()
    assert list(again) == [0, 1, 2]
    for number, frame in done.items():
        assert_same_frame(again[number], frame)


def test_an_interrupted_run_keeps_what_is_done_and_resumes(tmp_path):
    path, source, done = tmp_path / "w.fits", frames(5, frame_problems={1: "must hold light, got none"}), {}

    def run():
        try:
            for number in (0, 2, 3, 4):
                if number == 3:
                    raise KeyboardInterrupt
                done[number] = result(number)
        finally:
            write_wavefront(path, build(done, source), STAMP)

    with pytest.raises(KeyboardInterrupt):
        run()
    with fits.open(path) as hdus:
        hdus.verify("exception")
        assert list(hdus["FRAMES"].data["outcome"]) == ["converged", BAD_FRAME, "converged", NOT_RUN, NOT_RUN]
        assert list(hdus["FRAMES"].data["sentence"])[1] == "must hold light, got none"
        assert np.isnan(hdus[0].data[[1, 3, 4]]).all()
        assert (hdus[0].header["NFRAMES"], hdus[0].header["NDONE"]) == (5, 2)
        assert hdus[0].header["RMS_NM"] == 401.0  # of the two that ran
    resumed = read_wavefront(path).finished()
    assert list(resumed) == [0, 2]
    resumed |= {3: result(3), 4: result(4)}
    write_wavefront(path, build(resumed, source), STAMP)
    assert list(fits.getdata(path, "FRAMES")["outcome"]) == ["converged", BAD_FRAME, *["converged"] * 3]
    assert_same_frame(read_wavefront(path).finished()[0], result(0))


def test_interrupted_before_the_first_frame_is_a_valid_file(tmp_path):
    write_wavefront(tmp_path / "w.fits", build({}, frames(2)), STAMP)
    with fits.open(tmp_path / "w.fits") as hdus:
        hdus.verify("exception")
        assert hdus[0].header["OUTCOME"] == NOT_RUN
        assert hdus[0].header["RMS_NM"] is None  # a keyword without a value
    assert read_wavefront(tmp_path / "w.fits").finished() == {}


def test_unknown_numbers_are_keywords_without_value(tmp_path):
    bare = result(1, predicted_error_nm=float("nan"), error_nm=None, residual=None, sentence="")
    write_wavefront(tmp_path / "w.fits", build({0: bare}, frames()), STAMP)
    with fits.open(tmp_path / "w.fits") as hdus:
        hdus.verify("exception")
        assert hdus[0].header["PREDERR"] is None
        assert not {"ERR_NM", "OUTNOTE"} & set(hdus[0].header)
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "MODES"]
    (again,) = read_wavefront(tmp_path / "w.fits").finished().values()
    assert np.isnan(again.predicted_error_nm)
    assert again.error_nm is None
    assert again.residual is None


def test_a_method_without_modes_has_an_empty_table(tmp_path):
    none = np.empty(0)
    wavefront = WavefrontFile.from_frames(
        {1: result(1, coefficient_m=none, sigma_m=none)}, frames(2), method="linear", noll=[]
    )
    write_wavefront(tmp_path / "w.fits", wavefront, STAMP)
    assert len(fits.getdata(tmp_path / "w.fits", "MODES")) == 0
    assert read_wavefront(tmp_path / "w.fits").coefficient_m.shape == (2, 0)


def test_long_and_foreign_sentences_survive_as_plain_text(tmp_path):
    sentence = "the model misses 3 µm\nof the light, " + "and again " * 12
    write_wavefront(tmp_path / "w.fits", build({0: result(1, sentence=sentence)}, frames()), STAMP)
    expected = ("the model misses 3 ?m of the light, " + "and again " * 12).strip()
    with fits.open(tmp_path / "w.fits") as hdus:
        hdus.verify("exception")
        assert hdus[0].header["OUTNOTE"] == expected


@pytest.mark.parametrize(
    ("done", "rule"),
    [
        ({5: result(1)}, r"wavefront.frames\[5\]: must be one of the 2 frames"),
        ({0: result(1, opd_m=np.ones((4, 4)), residual=None)}, r"frames\[0\].opd_m: must have the pixels"),
        ({0: result(1, residual=np.ones((2, HEIGHT, WIDTH)))}, r"frames\[0\].residual: must have the planes"),
        (
            {0: result(1, coefficient_m=np.ones(3), sigma_m=np.ones(3))},
            r"frames\[0\].coefficient_m: must be one per mode, 4, got \(3,\)",
        ),
    ],
)
def test_results_that_do_not_fit_the_frames_are_refused(done, rule):
    with pytest.raises(SettingsError, match=rule):
        build(done, frames(2))


def damage(path, change):
    with fits.open(path) as hdus:
        change(hdus)
        hdus.writeto(path, overwrite=True)


DAMAGES = {
    "modes gone": (lambda hdus: hdus.__delitem__("MODES"), "MODES: must be a table, got none"),
    "frames gone": (lambda hdus: hdus.__delitem__("FRAMES"), "FRAMES: must be a table, got none"),
    "method gone": (lambda hdus: hdus[0].header.remove("METHOD"), "METHOD: is required"),
    "scale gone": (lambda hdus: hdus[0].header.remove("PIXSCALE"), "PIXSCALE: is required"),
    "rows lost": (
        lambda hdus: setattr(hdus["FRAMES"], "data", hdus["FRAMES"].data[:1]),
        "FRAMES: must have a row per frame, 2, got 1",
    ),
    "modes lost": (
        lambda hdus: setattr(hdus["MODES"], "data", hdus["MODES"].data[:3]),
        "MODES: must have as many rows for each of 2 frames, got 3",
    ),
    "column lost": (
        lambda hdus: hdus["MODES"].columns.del_col("sigma_m"),
        "MODES: must have the columns noll, coefficient_m, sigma_m, got no sigma_m",
    ),
    "no image": (
        lambda hdus: setattr(hdus[0], "data", None),
        "PRIMARY: must hold an image (y, x) or (frame, y",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_wavefront_is_one_line(tmp_path, name):
    change, line = DAMAGES[name]
    path = tmp_path / "w.fits"
    write_wavefront(path, build({0: result(1)}, frames(2)), STAMP)
    damage(path, change)
    with pytest.raises(FileFormatError) as caught:
        read_wavefront(path)
    assert str(caught.value).startswith(f"{path}: {line}")
    assert "\n" not in str(caught.value)


def test_frames_are_not_taken_for_a_wavefront(tmp_path):
    write_frames(tmp_path / "f.fits", frames(), STAMP)
    with pytest.raises(FileFormatError, match=r"METHOD: is required and .*is this a wavefront"):
        read_wavefront(tmp_path / "f.fits")
