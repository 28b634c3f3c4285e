"""`nlcwfs reconstruct` with each method: what the header says of errors, and what is doubtful or no light at all."""

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import small_frames, type_in

from nlcwfs.beam.grid import Grid
from nlcwfs.interop.mirror_twin import twin_opd_m

FEW = ("--set", "estimation.modes=100")
ARCSEC_RAD = np.pi / 180 / 3600
RADIAN_M = 0.65e-6 / (2 * np.pi)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Frames of the small sensor and what the default makes of them."""
    folder = tmp_path_factory.mktemp("methods")
    small_frames(folder / "f.fits", "--frames", 8, "--seed", 2)
    assert type_in("reconstruct", folder / "f.fits", "--out", folder / "w.fits", *FEW).exit_code == 0
    return folder


def test_the_default_tells_the_quantum_limit_and_what_the_sensor_loses(folder):
    header, rows = fits.getheader(folder / "w.fits"), fits.getdata(folder / "w.fits", "FRAMES")
    assert header["METHOD"] == "map"
    electrons = fits.getdata(folder / "f.fits").sum(axis=(1, 2, 3))
    # Ten modes at the quantum limit of Haffert et al. (2023) are less than all of them; no sensor is better than it.
    ten_nm = np.sqrt(10 / (4 * electrons)) * RADIAN_M * 1e9
    assert np.all((rows["quantum_limit_nm"] > ten_nm) & (rows["quantum_limit_nm"] < rows["predicted_error_nm"]))
    assert np.all((rows["photon_loss"] > 1) & (rows["photon_loss"] < 15)), rows["photon_loss"]
    assert header["QLIMIT"] == pytest.approx(np.median(rows["quantum_limit_nm"]))
    assert header["PHOTLOSS"] == pytest.approx(np.median(rows["photon_loss"]))


def test_the_sigmas_of_the_zernikes_are_honest(folder):
    truth_m, found_m = fits.getdata(folder / "f.fits", "TRUTH"), fits.getdata(folder / "w.fits")
    table = fits.getdata(folder / "w.fits", "MODES")
    sigma_m = table["sigma_m"].reshape(8, -1)[:, 1:15]
    # Noll 2 to 15 by a least-squares fit of our own, lit pixels alike, to found - true.
    y, x = (np.indices((36, 36)) - 17.5) / 12
    lit = np.isfinite(found_m[0])
    r, angle = np.hypot(y, x)[lit], np.arctan2(y, x)[lit]
    shapes = [np.ones_like(r)]
    for n, radial in {
        (1, 1): 2 * r,
        (2, 0): np.sqrt(3) * (2 * r**2 - 1),
        (2, 2): np.sqrt(6) * r**2,
        (3, 1): np.sqrt(8) * (3 * r**3 - 2 * r),
        (3, 3): np.sqrt(8) * r**3,
        (4, 0): np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
        (4, 2): np.sqrt(10) * (4 * r**4 - 3 * r**2),
        (4, 4): np.sqrt(10) * r**4,
    }.items():
        shapes += [radial] if n[1] == 0 else [radial * np.cos(n[1] * angle), radial * np.sin(n[1] * angle)]
    error_m = (found_m - truth_m)[:, lit]
    own_m = np.linalg.lstsq(np.array(shapes).T, error_m.T, rcond=None)[0][1:].T
    # 14 coefficients of 8 frames as one number: photon noise alone would scatter by 7 %; the order of a pair does not
    # matter, and what light and air are too coarse for on 24 pixels adds some.
    ratio = np.sqrt(np.mean(own_m**2) / np.mean(sigma_m**2))
    assert 0.4 < ratio < 1.6, ratio


def test_the_linear_method_is_typed_and_named(tmp_path, folder):
    sets = [f"estimation.linear.{key}" for key in ("training_screens=300", "modes=40")]
    words = [word for key in sets for word in ("--set", key)]
    result = type_in("reconstruct", folder / "f.fits", "--out", tmp_path / "w.fits", "--method", "linear", *words)
    assert result.exit_code == 0, result.output
    header = fits.getheader(tmp_path / "w.fits")
    assert header["METHOD"] == "linear"
    assert "PHOTLOSS" not in header
    true_nm = np.nanstd(fits.getdata(folder / "f.fits", "TRUTH"), axis=(1, 2)) * 1e9
    assert header["ERR_NM"] < 0.5 * np.median(true_nm)  # 300 wavefronts teach little, but more than nothing


def test_noise_alone_is_not_believed_and_leaves_the_prior(tmp_path, folder):
    with fits.open(folder / "f.fits") as hdus:
        hdus[0].data[:] = np.random.default_rng(5).poisson(4.0, hdus[0].data.shape)
        hdus[0].data = hdus[0].data[:1]
        fits.HDUList([hdus[0].copy()]).writeto(tmp_path / "n.fits")
    result = type_in("reconstruct", tmp_path / "n.fits", "--out", tmp_path / "w.fits", *FEW)
    assert result.exit_code == 1, result.output
    assert "not believed" in result.stdout
    header = fits.getheader(tmp_path / "w.fits")
    assert header["OUTCOME"] == "not explained"
    assert "QLIMIT" not in header
    # 0.6 arcsec at 0.5 um is usual; Noll (1976): 1.0299 (D/r0)^(5/3) rad^2 in all, 0.449 of it in each tilt.
    fried_m = 0.976 * 0.5e-6 / (0.6 * ARCSEC_RAD) * (0.65 / 0.5) ** 1.2
    noll_rad = np.sqrt((8 / fried_m) ** (5 / 3))
    usual_nm = np.sqrt(1.0299) * noll_rad * RADIAN_M * 1e9
    assert 0.99 * usual_nm < header["PREDERR"] < 1.5 * usual_nm  # or what noise looks like, where that is more
    tilt_nm = fits.getdata(tmp_path / "w.fits", "MODES")["sigma_m"][1] * 1e9
    assert tilt_nm / header["PREDERR"] == pytest.approx(np.sqrt(0.449 / 1.0299), rel=0.05)  # pixels cut the rim


def test_a_single_plane_is_reconstructed_with_a_word_about_its_twin(tmp_path):
    small_frames(tmp_path / "f.fits", "--seed", 2, curvature_sensor__distances_km="[-3500]")
    result = type_in("reconstruct", tmp_path / "f.fits", "--out", tmp_path / "w.fits", *FEW)
    assert result.exit_code in (0, 1)
    told = [line for line in result.stderr.splitlines() if "ZPLANE1" in line]
    assert len(told) == 1
    assert "cannot tell the wavefront W(x) from -W(-x) - x^2/z, so the sign is ambiguous" in told[0]
    assert "defocus of 1320 nm rms" in told[0]  # 4^2 / 3.5e6 / sqrt(12)
    assert np.isfinite(fits.getdata(tmp_path / "w.fits")).any()


@pytest.mark.parametrize("distance_m", [-3.5e6, 2e6])
def test_the_twin_makes_the_same_image(distance_m):
    # Fresnel's integral as a plain sum, axis by axis: no Fourier transform, no code of ours.
    rng, pixel_m, wavelength_m = np.random.default_rng(1), 1 / 3, 0.65e-6
    x_m, far_m = (np.arange(24) - 11.5) * pixel_m, (np.arange(31) - 15) * 0.4
    pupil = x_m[:, None] ** 2 + x_m[None] ** 2 < 16
    opd_m = 2e-7 * rng.normal(size=(24, 24))
    kernel = np.exp(1j * np.pi * (far_m[:, None] - x_m[None]) ** 2 / (wavelength_m * distance_m))

    def image(wavefront_m):
        return np.abs(kernel @ (pupil * np.exp(2j * np.pi * wavefront_m / wavelength_m)) @ kernel.T) ** 2

    twin_m = twin_opd_m(opd_m, Grid((24, 24), pixel_m), distance_m=distance_m)
    expected = image(opd_m)
    np.testing.assert_allclose(image(twin_m), expected, atol=1e-9 * expected.max())  # rounding
    assert np.abs(image(-opd_m[::-1, ::-1]) - expected).max() > 0.1 * expected.max()  # without the defocus: not
