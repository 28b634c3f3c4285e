"""`nlcwfs contrast`: its table, its page, and what it says of bad input."""

import numpy as np
import pytest
from astropy.table import Table
from command_line import type_in

from nlcwfs.config import load_config
from nlcwfs.errors import FileFormatError
from nlcwfs.interop.sensitivity_table import read_flux_factors
from nlcwfs.studies.contrast_table import ContrastStudy

PAPER = (
    "atmosphere.photons_per_s=7.8e7",
    "beam.wavelength_um=0.7",
    "contrast.imaging_wavelength_um=1.6",
    "contrast.angles_mas=[41, 83, 165, 330, 660]",
    "contrast.curve_points=7",
    "shack_hartmann.subapertures=50",
)


def typed(out, *settings, words=()):
    sets = [word for setting in (*PAPER, *settings) for word in ("--set", setting)]
    return type_in("contrast", "--out", out, *sets, *words)


def table_of(path, rows):
    Table(rows=rows, names=("sensor", "cycles_per_aperture", "flux_factor")).write(path, format="ascii.ecsv")
    return path


def test_the_folder_holds_table_figure_and_page(tmp_path):
    result = typed(tmp_path / "out")
    assert result.exit_code == 0, result.output
    table = Table.read(tmp_path / "out" / "results.ecsv")
    assert len(table) == 2 * 6 * 10  # sensors, five rates and the best, five angles told and five between them
    assert len(table.meta["provenance"]["settings_digest"]) == 64
    assert np.allclose(table["contrast"], table["lag"] + table["photon_noise"], rtol=2e-6)  # six digits
    one = table[(table["sensor"] == "shack-hartmann-50") & (table["rate_hz"] == 1000) & (table["angle_mas"] == 330)]
    assert float(one["contrast"][0]) == pytest.approx(9.8e-6, rel=0.05)
    best = table[(table["sensor"] == "curvature") & (table["rate"] == "best") & (table["angle_mas"] == 83)]
    assert float(best["photon_noise"][0] / best["lag"][0]) == pytest.approx(2, rel=0.01)  # d(aT^2 + b/T) = 0
    assert (tmp_path / "out" / "contrast.png").stat().st_size > 20_000
    page = (tmp_path / "out" / "README.md").read_text()
    assert page.startswith("# At 41, 83, 165, 330, 660 mas the halo behind the curvature sensor is 5")
    assert "gain over shack-hartmann-50" in result.output


def test_a_measured_sensitivity_takes_the_place_of_the_closed_form(tmp_path):
    path = table_of(tmp_path / "s.ecsv", [("curvature", 0.9, 3.0), ("curvature", 20.0, 3.0), ("pyramid", 0.5, 7.0)])
    config = load_config(None, [*PAPER, f"contrast.sensitivity_table={path}"])
    study = ContrastStudy.of(config)
    assert study.sensors[1].at(np.array([5.0])) == pytest.approx(3.0)
    plain = ContrastStudy.of(load_config(None, PAPER))
    ratio = study.halo.photon_noise(1.0, study.factor(study.sensors[1], np.array([83.0])))
    assert ratio / plain.halo.photon_noise(1.0, np.array([2.1])) == pytest.approx(3.0 / 2.1)


def test_a_blind_sensor_is_told_in_words(tmp_path):
    result = typed(tmp_path, "shack_hartmann.subapertures=12")
    assert result.exit_code == 0
    assert "shack-hartmann-12 is blind to the waves at 330, 660 mas: no contrast there" in result.output
    table = Table.read(tmp_path / "results.ecsv")
    assert np.isfinite(table["contrast"]).all()
    assert max(table["angle_mas"][table["sensor"] == "shack-hartmann-12"]) < 6 * 41.3
    page = (tmp_path / "README.md").read_text()
    lines = [line for line in page.splitlines() if line.startswith("| shack-hartmann-12")]
    assert len(lines) == 8  # flux factor, five rates, the best, and its rate
    assert all(line.endswith("| blind | blind |") for line in lines)
    assert "nan" not in page + result.output


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        (
            ["contrast.angles_mas=[41, 800]"],
            "contrast.angles_mas: must be at most 660 mas, the 16 cycles per aperture that the mirror makes, "
            "got 800 (19.4 cycles per aperture)",
        ),
        (
            ["mirror.kind=actuators", "mirror.actuators_across=9"],
            "contrast.angles_mas: must be at most 165 mas, the 4 cycles per aperture",
        ),
        (
            ['contrast.sensors=["pyramid"]'],
            "contrast.sensors: must be of ideal, curvature, shack-hartmann (contrast.sensitivity_table adds its own), "
            "got pyramid",
        ),
        (
            ["contrast.angles_mas=[165, 330]", "shack_hartmann.subapertures=6"],
            "contrast.sensors: must see the waves of an angle, got shack-hartmann-6, blind to all",
        ),
        (["atmosphere.photons_per_s="], "atmosphere.photons_per_s: must be given, or atmosphere.star.magnitude"),
        (["contrast.rates_hz=[0]"], "contrast.rates_hz[0]: must be"),
        (['contrast.sensors=["ideal", "ideal"]'], "contrast.sensors: must differ from each other"),
        (
            ["contrast.sensitivity_table=none.ecsv"],
            "none.ecsv: must be a table of nlcwfs sensitivity, got No",
        ),
    ],
)
def test_bad_settings_are_one_line(tmp_path, settings, line):
    result = typed(tmp_path / "out", *settings)
    assert result.exit_code == 2
    assert f"nlcwfs: {line}" in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        ([("curvature", 1.0, 2.0), ("curvature", 1.0, 3.0)], "got two of curvature at 1"),
        (
            [("curvature", 1.0, 2.0), ("curvature", 8.0, 2.0)],
            "from 1 to 8 cycles per aperture, where curvature is known",
        ),
        (
            [("curvature", 1.0, 2.0), ("curvature", 16.0, np.nan)],
            "row 2: flux_factor: must be a positive number, got nan",
        ),
    ],
)
def test_a_table_that_does_not_serve_is_one_line(tmp_path, rows, line):
    path = table_of(tmp_path / "s.ecsv", rows)
    result = typed(tmp_path / "out", f"contrast.sensitivity_table={path}")
    assert result.exit_code == 2
    assert line in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_of_several_wavefront_errors_one_is_read(tmp_path):
    rows = [("curvature", waves, 2.0 + rms, rms) for rms in (0.0, 4.0) for waves in (0.9, 20.0)]
    names = ("sensor", "cycles_per_aperture", "flux_factor", "rms_rad")
    Table(rows=rows, names=names).write(tmp_path / "s.ecsv", format="ascii.ecsv")
    assert read_flux_factors(tmp_path / "s.ecsv")["curvature"].factor.tolist() == [2.0, 2.0]
    assert read_flux_factors(tmp_path / "s.ecsv", rms_rad=4.0)["curvature"].factor.tolist() == [6.0, 6.0]
    with pytest.raises(FileFormatError, match="must hold rows with rms_rad = 8, got none"):
        read_flux_factors(tmp_path / "s.ecsv", rms_rad=8.0)


def test_an_infinite_factor_in_a_table_is_blind(tmp_path):
    rows = [("curvature", 0.9, 2.0), ("curvature", 4.0, 2.0), ("curvature", 8.0, np.inf), ("curvature", 20.0, 2.0)]
    result = typed(tmp_path / "out", f"contrast.sensitivity_table={table_of(tmp_path / 's.ecsv', rows)}")
    assert result.exit_code == 0
    assert "curvature is blind to the waves at 330, 660 mas" in result.output


def test_a_loop_that_cannot_be_measured_is_one_line(tmp_path):
    result = typed(tmp_path / "out", "loop.sensor=shack-hartmann", words=["--loop"])
    assert result.exit_code == 2
    assert "loop.sensor: must be curvature or ideal for the halo of a loop, got shack-hartmann" in result.output
