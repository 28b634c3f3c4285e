"""From settings to the colours of a sensor, and from there into the file of frames; bad settings in a line."""

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import type_in

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.config import Config, digest, load_config
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.colours import band_of, bandwidth_m, colour_account, colours_of
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key

AIR = Turbulence.from_rms(opd_rms_m=200e-9, diameter_m=8.0)
FLAT = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.4"]
SMALL = [
    "curvature_sensor.distances_km=[-4000, 4000]",
    "detector.pixels_across_pupil=24",
    "detector.window_pixels=32",
    "simulation.light_oversampling=2",
    "atmosphere.opd_rms_nm=200",
]
MAS = np.pi / 180 / 3600e3


def colours(*settings: str):
    return colours_of(load_config(None, list(settings)), AIR)


def test_by_default_the_light_has_one_colour_and_nothing_changes():
    found = colours()
    assert found.spectrum == Spectrum.monochromatic(0.85 * 1e-6)
    assert (found.error, found.star.size_rad, found.star.is_bent) == (0.0, 0.0, False)
    np.testing.assert_array_equal(found.distances_m, [[-3.5e6, -2.5e6, 2.5e6, 3.5e6]])
    unused = [
        "beam.spectrum.bandwidth_um=0.1",
        "atmosphere.dispersion.zenith_deg=0",
        "beam.spectrum.temperature_k=4000",
    ]
    assert digest(load_config(None, unused)) == digest(Config())
    assert digest(load_config(None, FLAT)) != digest(Config())


def test_each_colour_has_its_planes_and_its_direction():
    ideal = colours(*FLAT, "curvature_sensor.lenses=ideal", "beam.spectrum.wavelengths=3")
    wavelengths_m = np.array(ideal.spectrum.wavelengths_m)
    np.testing.assert_allclose(ideal.distances_m[:, 0] * wavelengths_m, -3.5e6 * 0.85e-6, rtol=1e-12)
    bent = colours(*FLAT, "atmosphere.dispersion.zenith_deg=45", "atmosphere.dispersion.direction_deg=30")
    angles = np.array(bent.star.directions_rad)
    length = np.hypot(*angles.T) * np.sign(angles[:, 1])
    np.testing.assert_allclose(np.degrees(np.arctan2(angles[:, 0], angles[:, 1]))[0], 30, atol=1e-9)
    assert np.all(np.diff(length) < 0)  # bluer light goes further towards +30 degrees
    # 163 mas from 0.68 and -88 mas from 1.02 um (test_refraction); the outermost nodes lie inside the band.
    assert 130 * MAS < length[0] < 163 * MAS
    assert -88 * MAS < length[-1] < -70 * MAS


def test_more_wavelengths_are_taken_where_more_are_needed():
    counts = [
        len(colours(*FLAT, *more).spectrum.shares)
        for more in ((), ("curvature_sensor.lenses=ideal",), ("atmosphere.dispersion.zenith_deg=60",))
    ]
    assert counts[1] < counts[0] < counts[2]
    said = colours(*FLAT, "beam.spectrum.wavelengths=2")
    assert (len(said.spectrum.shares), said.error > 0.03) == (2, True)


def test_a_static_aberration_counts_too():
    ideal = (*FLAT, "curvature_sensor.lenses=ideal")
    assert colours(*ideal, "curvature_sensor.static_rms_nm=1500").error != colours(*ideal).error
    with_it = colours(*ideal, "curvature_sensor.static_rms_nm=1500", "beam.spectrum.wavelengths=2")
    assert with_it.error > 10 * colours(*ideal, "beam.spectrum.wavelengths=2").error


def test_the_frames_of_many_colours_are_the_sum_of_frames_of_one():
    """Two of Gauss and Legendre's nodes, half the light each; the static aberration is that of every colour."""
    same = [*SMALL, "curvature_sensor.static_rms_nm=100"]
    both = ExposureSimulator.build(load_config(None, [*same, *FLAT, "beam.spectrum.wavelengths=2"]))
    opd_m = both.levelled(both.on_light(both.screens.draw(frame_key(seed=0, frame=0))))
    images = np.asarray(both.sensor.images(opd_m, 1e4).photons)
    expected = np.zeros_like(images)
    for node_um in 0.85 + 0.17 * np.array([-1, 1]) / np.sqrt(3):
        one = ExposureSimulator.build(load_config(None, [*same, f"beam.wavelength_um={node_um}"]))
        expected += np.asarray(one.sensor.images(opd_m, 1e4).photons) / 2
    np.testing.assert_allclose(images, expected, atol=2e-5 * expected.max())  # single precision


def test_a_table_and_a_black_body_reach_the_sensor(tmp_path):
    (tmp_path / "t.csv").write_text("um,photons\n0.7,1\n0.9,3\n")
    table = ["beam.spectrum.shape=table", f"beam.spectrum.table={tmp_path / 't.csv'}"]
    assert band_of(load_config(None, table)).ends_m == pytest.approx((0.7e-6, 0.9e-6))
    assert bandwidth_m(load_config(None, table)) == pytest.approx(0.2e-6)
    hot = colours("beam.spectrum.shape=black-body", "beam.spectrum.bandwidth_um=0.4", "beam.spectrum.wavelengths=4")
    assert np.dot(hot.spectrum.wavelengths_m, hot.spectrum.shares) < 0.85e-6  # 5800 K: bluer than flat
    lines = colour_account(load_config(None, [*table, "atmosphere.star.size_mas=2"]), AIR)
    assert lines[0].startswith("Colours: table, 0.7 to 0.9 um, as ")
    assert lines[-1] == "Star: disc of 2 mas."


def test_simulate_writes_the_band_and_the_lenses(tmp_path):
    out = tmp_path / "frames.fits"
    settings = [f"--set={one}" for one in (*SMALL, *FLAT, "curvature_sensor.lenses=doublet")]
    result = type_in("simulate", "--out", out, *settings)
    assert result.exit_code == 0
    header = fits.getheader(out)
    assert header["BANDWID"] == pytest.approx(0.34e-6)
    assert header["WAVELEN"] == pytest.approx(0.85e-6)
    assert header["CHROMLEN"] is True
    assert "Colours: flat, 0.68 to 1.02 um, as " in result.output
    assert "Lenses: powers +21.1 of N-FK51A and -20.1 of N-SF66" in result.output


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            [*FLAT, "curvature_sensor.lenses=doublet", 'curvature_sensor.glasses=["N-BK7","BK8"]'],
            "curvature_sensor.glasses: must be two of N-BK7, N-FK51A, ",
        ),
        (
            [*FLAT, "curvature_sensor.lenses=doublet", "beam.wavelength_um=0.48"],
            "curvature_sensor.glasses: must have data at every wavelength of the light; those of N-SF66 are for 0.39",
        ),
        (
            [*FLAT, "curvature_sensor.lenses=doublet", "beam.spectrum.bandwidth_ratio=0.6"],
            "curvature_sensor.glasses: must keep wavelength times distance within 10 % over the band, got ",
        ),
        (
            [*FLAT, "atmosphere.dispersion.zenith_deg=80"],
            "atmosphere.dispersion.zenith_deg: must be a number from 0 to",
        ),
        (
            [*FLAT, "atmosphere.dispersion.zenith_deg=40", "beam.wavelength_um=3.4"],
            "atmosphere.dispersion.zenith_deg: must be 0 for light beyond 0.3 to 2.5 um",
        ),
        (
            ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_um=0.9"],
            "beam.spectrum.bandwidth_um: must be narrower than beam.wavelength_um, 0.85 um, got 0.4 to 1.3 um",
        ),
        (["beam.spectrum.shape=table", "beam.spectrum.table=none.csv"], "none.csv: no such file"),
        (["beam.spectrum.shape=flat"], "beam.spectrum.bandwidth_um: must be given for light of shape flat"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, settings, message):
    out = tmp_path / "x.fits"
    result = type_in("simulate", "--out", out, *(f"--set={one}" for one in (*SMALL, *settings)))
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not out.exists()


def test_light_on_one_side_of_the_reference_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("um,photons\n0.5,1\n0.7,1\n")
    table = ["beam.spectrum.shape=table", f"beam.spectrum.table={tmp_path / 't.csv'}"]
    with pytest.raises(SettingsError) as refusal:
        colours(*table)
    rule = "must have light on both sides of beam.wavelength_um, 0.85 um"
    assert str(refusal.value) == f"beam.spectrum.table: {rule}, got 0.5 to 0.7 um"
