"""`nlcwfs design`: the files that it writes, and designs that cannot be."""

import numpy as np
import pytest
from astropy.table import Table
from tests.stages.command_line import type_in

from nlcwfs.config import load_config

SMALL = {
    "atmosphere.photons_per_s": 3e5,
    "beam.diameter_m": 1,
    "mirror.cutoff_cpa": 4,
    "curvature_sensor.distances_km": "[-55, -39, 39, 55]",
}


def designed(out, *words, **changes):
    settings = SMALL | {key.replace("__", "."): value for key, value in changes.items()}
    sets = [word for key, value in settings.items() if value for word in ("--set", f"{key}={value}")]
    return type_in("design", "--out", out, *sets, *words)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("design")
    result = designed(folder / "d", "--rate", 400, "--pixels", 12)
    assert result.exit_code == 0, result.output
    return folder / "d", result.output


def test_the_settings_are_ready_for_the_loop(made):
    folder, output = made
    config = load_config(folder / "design.toml")
    distances_km = np.array(config.curvature_sensor.distances_km)
    np.testing.assert_allclose(distances_km, -distances_km[::-1])
    assert len(distances_km) == 4
    assert config.loop.rate_hz == 400
    assert config.atmosphere.photons_per_s == 3e5
    # A window of 1.45 telescopes, even; the grid of the light holds whole pixels.
    assert (config.detector.pixels_across_pupil, config.detector.window_pixels) == (12, 18)
    assert config.simulation.light_oversampling % config.estimation.map.oversampling == 0
    assert f"next: nlcwfs loop {folder / 'design.toml'}" in output


def test_the_table_tells_all_that_was_looked_at_and_who_made_it(made):
    folder, output = made
    table = Table.read(folder / "design.ecsv", format="ascii.ecsv")
    assert set(table["kind"]) == {"design", "as set", "rate", "one pair", "pixels", "window"}
    assert table["expected_nm"].unit == "nm"
    assert table.meta["provenance"]["settings_digest"]
    squares = table["fitting_nm"] ** 2 + table["lag_nm"] ** 2 + table["photon_nm"] ** 2
    np.testing.assert_allclose(table["expected_nm"] ** 2, squares, rtol=1e-4)  # three digits behind the point
    design, as_set = (table[table["kind"] == kind][0] for kind in ("design", "as set"))
    assert design["expected_nm"] <= as_set["expected_nm"]
    assert as_set["distances_km"] == "39 55"
    assert f"Expected {design['expected_nm']:.1f} nm rms" in output
    assert (folder / "design.png").stat().st_size > 20000


def test_the_planes_that_are_set_may_be_kept(tmp_path, made):
    assert designed(tmp_path, "--keep-planes", "--rate", 400, "--pixels", 12, "--quiet").exit_code == 0
    kept = Table.read(tmp_path / "design.ecsv", format="ascii.ecsv")
    searched = Table.read(made[0] / "design.ecsv", format="ascii.ecsv")
    assert load_config(tmp_path / "design.toml").curvature_sensor.distances_km == (-55, -39, 39, 55)
    assert kept["expected_nm"][0] == pytest.approx(searched["expected_nm"][searched["kind"] == "as set"][0], abs=2e-3)


@pytest.mark.parametrize(
    ("words", "changes", "line"),
    [
        (["--rms-nm", 20], {}, "--rms-nm: must be at least 3"),  # 38 nm are left by the mirror alone
        (["--pixels", 3], {}, "--pixels: must be from 4 to 1000 across the pupil, got 3"),
        (["--pixels", 4], {"mirror__cutoff_cpa": 6}, "--pixels: must be at least 6 for the"),
        (["--planes", 3], {}, "--planes: must be 2 or 4, in symmetric pairs, got 3"),
        (["--window", 0.9], {}, "--window: must be from 1 to 16 telescope diameters, got 0.9"),
        (["--rate", 0], {}, "--rate: must be greater than 0 and at most 100000 Hz, got 0"),
        (["--rms-nm", "nan"], {}, "--rms-nm: must be a positive length, got nan"),
        ([], {"atmosphere__photons_per_s": 30}, "atmosphere.photons_per_s: must be at least "),
        ([], {"mirror__cutoff_cpa": 1, "beam__diameter_m": 8}, "mirror.cutoff_cpa: mirror and rate must leave less"),
        (
            [],
            {"atmosphere__photons_per_s": None},
            "atmosphere.star.magnitude: must be given, or atmosphere.photons_per_s",
        ),
        (
            ["--keep-planes"],
            {"curvature_sensor__distances_km": "[-39, 55]"},
            "curvature_sensor.distances_km: must be symmetric pairs to be kept (--keep-planes), got [-39.0, 55.0]",
        ),
    ],
)
def test_a_design_that_cannot_be_is_told_in_a_line(tmp_path, words, changes, line):
    result = designed(tmp_path / "d", *words, **changes)
    assert result.exit_code == 2
    told = result.stderr.splitlines()
    assert len(told) == 1, told
    assert told[0].startswith(f"nlcwfs: {line}"), told[0]
    assert not list((tmp_path / "d").glob("*"))


def test_a_requirement_that_only_more_light_could_meet_tells_what_is_left(tmp_path):
    # The mirror alone leaves less; lag and the quantum limit do not.
    result = designed(tmp_path, "--rms-nm", 45, "--rate", 400, atmosphere__photons_per_s=6e4)
    assert result.exit_code == 2
    assert "what any sensor of 6e+04 photons a second leaves at 400 Hz (mirror " in result.stderr
