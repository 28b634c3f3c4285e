"""Planes told as waves of defocus: phase diversity near the focus is the same optics (docs/design.md)."""

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import small_frames, type_in

from nlcwfs.config import digest, load_config, to_toml
from nlcwfs.errors import SettingsError


def set_to(*words):
    return load_config(None, [f"curvature_sensor.{word}" for word in words])


def test_the_papers_farthest_plane_is_2_7_waves_of_defocus():
    # PV = D^2 / (8 lambda z) = 64 / (8 * 0.85e-6 * 3.5e6) = 2.689; the paper prints 2.3 (docs/paper-slips.md).
    distances_km = set_to(f"defocus_waves=[{-64 / 23.8}, {64 / 23.8}]").curvature_sensor.distances_km
    np.testing.assert_allclose(distances_km, [-3500, 3500], rtol=1e-12)  # rounding


def test_diameter_and_wavelength_count_wherever_they_are_told():
    config = load_config(
        None, ["curvature_sensor.defocus_waves=[-3, 2]", "beam.diameter_m=2", "beam.wavelength_um=0.5"]
    )
    np.testing.assert_allclose(config.curvature_sensor.distances_km, [-1000 / 3, 500], rtol=1e-12)  # rounding


def test_what_is_written_is_in_distances_and_reads_back_the_same(tmp_path):
    config = set_to("defocus_waves=[-2, 3]", "flux_fractions=[0.25, 0.75]", "static_rms_nm=50")
    (tmp_path / "c.toml").write_text(to_toml(config))
    assert "defocus" not in to_toml(config)
    assert load_config(tmp_path / "c.toml") == config
    assert config.curvature_sensor.flux_fractions == (0.25, 0.75)
    assert config.curvature_sensor.static_rms_nm == 50


def test_a_key_that_is_not_set_leaves_the_fingerprint_of_before():
    # Digest of the defaults in version 0.1, before there was the key: tables of studies hold such digests.
    assert "defocus_waves" not in load_config().model_dump(mode="json")["curvature_sensor"]
    assert digest(load_config()) == digest(set_to("defocus_waves="))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["defocus_waves=[1, 2]", "distances_km=[3, 4]"],
            "curvature_sensor.defocus_waves: must be left out with distances_km: they say the same in other words, "
            "got [1, 2]",
        ),
        (
            ["defocus_waves=[0, 2]"],
            "curvature_sensor.defocus_waves: must not be 0: an image in focus is at no distance, got [0, 2]",
        ),
        (["defocus_waves=[2, 2]"], "curvature_sensor.defocus_waves: must differ from each other, got [2, 2]"),
        (
            ["defocus_waves=[0.001, 2]"],
            "curvature_sensor.defocus_waves: must be at least 0.0094 to either side, a plane at 1e+06 km, "
            "got [0.001, 2.0]",
        ),
        (
            ["defocus_waves=[2, 3]", "flux_fractions=[1.0]"],
            "curvature_sensor.flux_fractions: must be one per plane, got [1.0]",
        ),
    ],
)
def test_bad_waves_are_told_in_a_line(words, line):
    with pytest.raises(SettingsError) as told:
        set_to(*words)
    assert str(told.value) == line


def test_phase_diversity_is_simulated_and_reconstructed(tmp_path):
    small_frames(tmp_path / "f.fits", "--seed", 4, curvature_sensor__defocus_waves="[-4, -2, 2, 4]")
    header = fits.getheader(tmp_path / "f.fits")
    expected_m = [8.0**2 / (8 * 0.65e-6 * waves) for waves in (-4, -2, 2, 4)]
    np.testing.assert_allclose([header[f"ZPLANE{n}"] for n in (1, 2, 3, 4)], expected_m, rtol=1e-6)  # six digits
    done = type_in("reconstruct", tmp_path / "f.fits", "--out", tmp_path / "w.fits", "--set", "estimation.modes=100")
    assert done.exit_code == 0, done.output
    # The quantum limit of 100 modes is 0.65e-6 / 2 pi * sqrt(100 / 8e4) = 3.7 nm; the turbulence is of 150 nm.
    assert 3.7 < fits.getheader(tmp_path / "w.fits")["ERR_NM"] < 30
