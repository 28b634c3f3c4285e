"""What study 02 added: every method, the error on the detector's pixels, honest error bars, its figures and page."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from tests.stages.command_line import type_in
from tests.stages.test_studies import (
    CAMERA,
    GERCHBERG_SAXTON,
    NUMBERS,
    SHORT,
    SKY,
    Bench,
    pretended,
    screen,
    silent,
    small,
    stored_cases,
    written,
)

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.errors import FileFormatError
from nlcwfs.estimation.error_bars import ErrorBars
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.photon_bound import photon_bound
from nlcwfs.interop import Provenance
from nlcwfs.studies import case_run
from nlcwfs.studies.case_bound import LightInformation, bound_on_pixels, products_on_pixels, share_on_pixels
from nlcwfs.studies.method_figures import METHODS, draw_calibration, draw_cost, parts
from nlcwfs.studies.mode_calibration import ModeErrors
from nlcwfs.studies.study_cases import Capture, Case, read_study
from nlcwfs.studies.study_light import Light, Screen, make_light
from nlcwfs.studies.study_report import write_report
from nlcwfs.studies.study_run import case_digest, run_study
from nlcwfs.studies.study_table import StudyTable

# ---------------------------------------------------------------------------------- the error on the pixels


def step_m(height_nm: float) -> np.ndarray:
    """Half of the window too high, half too low: of this rms."""
    return 1e-9 * height_nm * np.broadcast_to(np.where(np.arange(16) < 8, 1.0, -1.0), (16, 16))


def answered(found_nm, pixels_nm, outcome=Outcome.CONVERGED, **numbers) -> Screen:
    """A wavefront that is flat on the grid of the light, this step on the pixels, and the step that was found."""
    return screen(found_nm, outcome, **numbers)._replace(pixels_m=step_m(pixels_nm))


def row_of(monkeypatch, screens: list[Screen], capture: Capture, pixel_weights=None) -> dict:
    pretended(monkeypatch, [])
    even = np.full((16, 16), 1 / 256)
    light = Light(screens, Grid((16, 16), 8.0 / 12), even, even if pixel_weights is None else pixel_weights)
    return case_run.run_case(Case(name="a", group="g"), small(GERCHBERG_SAXTON), capture, light, silent)


def test_what_is_wrong_is_judged_by_the_score_of_the_study(monkeypatch):
    screens = [
        answered(50, 20),  # 50 nm on the grid of the light, 30 on the pixels
        answered(-50, 20),  # 50 and 70
        answered(50, 45, Outcome.NOT_EXPLAINED),  # 50 and 5: doubted
    ]
    fine = row_of(monkeypatch, screens, Capture(45.0))
    assert (fine["captured"], fine["captured_pixels"]) == (0.0, pytest.approx(2 / 3))
    assert (fine["believed_wrong"], fine["doubted_right"]) == (pytest.approx(2 / 3), 0.0)
    pixels = row_of(monkeypatch, screens, Capture(45.0, "pixels"))
    assert (pixels["believed_wrong"], pixels["doubted_right"]) == (pytest.approx(1 / 3), pytest.approx(1 / 3))
    for row in (fine, pixels):
        assert (row["median_nm"], row["median_pixels_nm"]) == (50.0, 30.0)
        assert row["p5_pixels_nm"] == pytest.approx(5 + 0.1 * 25, abs=0.006)  # a straight line between the ranks
        assert row["p95_pixels_nm"] == pytest.approx(30 + 0.9 * 40, abs=0.006)


def test_pixels_weigh_by_their_light_and_those_without_do_not_count(monkeypatch):
    weights = np.zeros((16, 16))
    weights[:, 4], weights[:, 12] = 3 / 64, 1 / 64  # 3/4 of the light is 10 nm high, 1/4 10 nm low
    one = answered(10, 0)
    one = one._replace(pixels_m=np.where(weights > 0, one.pixels_m, np.nan))
    row = row_of(monkeypatch, [one], Capture(45.0, "pixels"), weights)
    assert row["median_pixels_nm"] == pytest.approx(math.sqrt(100 - 5**2), abs=0.006)
    assert row["median_nm"] == 10.0
    broken = one._replace(counts=np.full_like(one.counts, np.nan))
    broken.counts[1].flat[0] = Outcome.NOT_FINITE
    row = row_of(monkeypatch, [broken], Capture(45.0, "pixels"), weights)
    assert (row["median_pixels_nm"], row["captured_pixels"]) == (1e6, 0.0)


def test_error_over_predicted_is_that_of_the_believed(monkeypatch):
    screens = [
        answered(20, 0, predicted_nm=10, ffts=100),
        answered(10, 0, Outcome.BUDGET_SPENT, predicted_nm=20, ffts=200),
        answered(500, 0, Outcome.NOT_EXPLAINED, predicted_nm=1, ffts=300),
    ]
    row = row_of(monkeypatch, screens, Capture(45.0))
    assert row["error_over_predicted"] == pytest.approx(math.sqrt((2**2 + 0.5**2) / 2), abs=6e-4)
    assert math.isnan(row["error_over_predicted_low"])  # tells no modes
    assert row["ffts_p95"] == pytest.approx(290)
    assert 0 < row["ms_per_frame"] < 1e4
    doubted = row_of(monkeypatch, screens[2:], Capture(45.0))
    assert math.isnan(doubted["error_over_predicted"])


def test_the_truth_on_the_pixels_is_the_mean_over_their_light():
    config = small()
    light = make_light(Case(name="a", group="g"), config, 1, silent)
    one, cells = light.screens[0], light.grid.shape[0]
    margin = (32 - cells) // 2  # 16 pixels of two cells
    weights, truth_m = np.pad(light.weights, margin), np.pad(one.truth_m, margin).astype(float)
    blocks = weights.reshape(16, 2, 16, 2).sum(axis=(1, 3))
    means = (weights * truth_m).reshape(16, 2, 16, 2).sum(axis=(1, 3))[blocks > 1e-9] / blocks[blocks > 1e-9]
    np.testing.assert_allclose(light.pixel_weights, blocks, atol=1e-8)  # single precision
    np.testing.assert_allclose(one.pixels_m[blocks > 1e-9], means, atol=1e-13)
    assert np.isnan(one.pixels_m[blocks == 0]).all()
    assert len(light.first(0).screens) == 0


# -------------------------------------------------------------------------------------------- error bars


@pytest.fixture(scope="module")
def two_methods(tmp_path_factory):
    """A small study of the methods that no other test of studies runs."""
    folder = tmp_path_factory.mktemp("methods")
    few = ["estimation.modes=60", "estimation.linear.modes=12", "estimation.linear.training_screens=60"]
    more = ["detector.pixels_across_pupil=24", "detector.window_pixels=36"]  # twelve pixels are too few for the map
    lines = ['question = "?"', "screens = 1", 'score = "pixels"', f"set = {[*CAMERA, *SKY, *few]}"]
    for method, options in (("map", more), ("linear", [])):
        chosen = [*options, f"estimation.method={method}"]
        lines.append(f'[[case]]\nname = "{method}"\ngroup = "g"\nset = {chosen}')
    return run_study(written(folder, "\n".join(lines)), progress=silent)


def test_every_method_runs_in_a_study(two_methods):
    rows = {row["case"]: row for row in two_methods.rows}
    assert list(rows) == ["map", "linear"] == [row["method"] for row in rows.values()]
    assert [row["planes"] for row in rows.values()] == [4, 4]
    assert [row["max_iterations"] for row in rows.values()] == [3, 0]
    assert rows["linear"]["ffts"] == 13  # its account of the light alone
    # 100 nm rms in bright light: a matrix of twelve modes finds most of it, the map nearly all.
    assert 1 < rows["map"]["median_pixels_nm"] < rows["map"]["median_nm"] < 20
    assert 10 < rows["linear"]["median_pixels_nm"] < 50
    assert 0.2 < rows["map"]["error_over_predicted_low"] < 3  # three modes of ten hold nearly all
    assert math.isnan(rows["linear"]["error_over_predicted_low"])  # tells no modes
    assert [row["method"] for row in StudyTable(two_methods.path).rows] == list(rows)


@pytest.fixture(scope="module")
def solver():
    config = small("estimation.method=map", "estimation.modes=60", "estimation.map.oversampling=1")
    return case_run.build_solver(Case(name="a", group="g"), config)[0]


def test_errors_of_modes_are_found_again_over_what_was_told(solver):
    assert isinstance(solver, MaximumAPosteriori)
    geometry, modes = solver.geometry, solver.error.modes
    window = Grid(modes.shape, geometry.frame.pixel_m)
    assert window.shape != geometry.frame.shape  # the model's window is wider
    pupil = geometry.pupil.on(window)
    basis = modal_basis(pupil, window, diameter_m=8.0, count=modes.modes.shape[0])
    cycles = np.asarray(basis.cycles_per_aperture)
    low, middle = cycles < 4, (cycles >= 4) & (cycles < 12)
    rng = np.random.default_rng(5)
    coefficients, told = rng.normal(size=len(cycles)), rng.uniform(0.5, 2, len(cycles))
    phase_rad = np.einsum("k,kyx->yx", coefficients, np.asarray(basis.modes)) + 0.7  # a piston does not count
    margin = (window.shape[0] - 16) // 2
    error_m = (phase_rad * 0.65e-6 / (2 * np.pi))[margin : margin + 16, margin : margin + 16]
    error_m = np.where(pupil[margin : margin + 16, margin : margin + 16] > 0, error_m, np.nan)
    nothing = jnp.zeros(())
    bars = ErrorBars(jnp.asarray(told), jnp.eye(1), nothing, nothing, jnp.ones(1), ffts=0)
    found = ModeErrors.of(solver).squares_over_told(error_m, bars)
    # Single precision, and dim pixels of the rim (1e-4 of the light) that carry no mode.
    for name, own in (("low", low), ("middle", middle)):
        assert found[name] == pytest.approx(np.sum(coefficients[own] ** 2) / np.sum(told[own]), rel=1e-3), name
    assert math.isnan(found["high"])  # twelve pixels carry none


# -------------------------------------------------------------------------------------- bounds on the pixels


@pytest.fixture(scope="module")
def few_modes():
    grid = Grid((32, 32), 8.0 / 24)
    return modal_basis(PupilShape(8.0).on(grid), grid, diameter_m=8.0, count=30)


def test_modes_on_pixels_are_their_means(few_modes):
    weights = np.asarray(few_modes.weights, float)
    light = weights.reshape(16, 2, 16, 2).sum(axis=(1, 3))
    means = (weights * np.asarray(few_modes.modes)).reshape(-1, 16, 2, 16, 2).sum(axis=(2, 4))
    lit = light > 0
    expected = (means[:, lit] / light[lit]) @ means[:, lit].T
    found = products_on_pixels(few_modes, factor=2, window=(16, 16))
    np.testing.assert_allclose(found, expected, atol=2e-6)  # single precision
    assert np.all(np.diag(found) < 1)  # averaging takes away
    assert np.diag(found)[0] > 0.97  # little of a tilt


def test_a_bound_on_fine_pixels_is_the_bound(few_modes):
    sky = {"telescope_over_fried": 8.0, "photons": 1e4, "wavelength_m": 0.65e-6}
    information = 1e4 * np.diag(np.linspace(1, 2, 30)) / 1e-14
    whole = photon_bound(information, few_modes, **sky)
    fine = LightInformation([], few_modes, np.eye(30), 1e-6)
    assert bound_on_pixels(information, fine, **sky) == pytest.approx((whole.bayesian_m, whole.quantum_m), rel=1e-4)
    coarse = LightInformation([], few_modes, 0.5 * np.eye(30), 1e3)  # half of the modes is left, and nothing beyond
    variance = np.asarray(few_modes.kolmogorov_rad2) * 8.0 ** (5 / 3) * (0.65e-6 / (2 * np.pi)) ** 2
    posterior = np.sum(1 / (np.diag(information) + 1 / variance))
    assert bound_on_pixels(information, coarse, **sky)[0] == pytest.approx(math.sqrt(posterior / 2), rel=1e-3)


@pytest.mark.parametrize("pixel", [0.01, 0.05, 0.2])
def test_the_share_on_pixels_is_the_integral_over_the_plane(pixel):
    """A sum over frequencies on a square grid, beyond 5 cycles."""
    axis = np.arange(-400, 400) + 0.5
    fx, fy = np.meshgrid(axis, axis)
    radius = np.hypot(fx, fy)
    power = np.where((radius > 5) & (radius < 400), radius ** (-11 / 3), 0)
    passed = (np.sinc(fx * pixel) * np.sinc(fy * pixel)) ** 2
    # The rim at 5 cycles is ragged on this grid (3 %), and the same in both sums.
    assert share_on_pixels(5.0, pixel) == pytest.approx(np.sum(power * passed) / np.sum(power), rel=0.03)


# ---------------------------------------------------------------------------------------- tables and digests


def test_a_setting_at_its_default_is_not_in_the_digest(tmp_path):
    def digests(text: str, name: str) -> list[str]:
        study = read_study(written(tmp_path / name, text))
        return [case_digest(study, case, study.config_of(case), study.screens_of(case)) for case in study.case]

    plain = digests(SHORT, "plain")
    assert len(set(plain)) == 3
    assert digests(SHORT.replace('"seed=5"', '"seed=5", "estimation.map.steps=3"'), "default") == plain
    assert digests('score = "fine"\n' + SHORT, "fine") == plain
    for number, other in enumerate(
        [SHORT.replace('"seed=5"', '"seed=5", "estimation.map.steps=4"'), 'score = "pixels"\n' + SHORT]
    ):
        assert not set(digests(other, f"other{number}")) & set(plain)


STAMP = Provenance.collect({}, seed=1, device="cpu")


def test_rows_that_are_older_than_a_column_stay(tmp_path):
    path = tmp_path / "results.ecsv"
    old, new = ({"case": name, "group": "g", "commit": "c", "digest": "d"} for name in ("old", "new"))
    StudyTable(path).put(old | {"screens": 3}, STAMP)
    StudyTable(path).put(new | {"screens": 4, "ms_per_frame": 1.5, "method": "map"}, STAMP)
    rows = StudyTable(path).rows
    assert [(row["case"], row["screens"], row["method"]) for row in rows] == [("old", 3, ""), ("new", 4, "map")]
    assert math.isnan(rows[0]["ms_per_frame"])
    assert rows[1]["ms_per_frame"] == 1.5
    assert list(rows[0])[-2:] == ["commit", "digest"]


@pytest.mark.parametrize(
    "content",
    [b"", b"case group\na b\n", b"# %ECSV 1.0\n# ---\n# datatype: [\n", b"\xff\xfe\x00", b"one line"],
)
def test_a_damaged_table_is_told_in_one_line(tmp_path, content):
    written(tmp_path)
    (tmp_path / "results.ecsv").write_bytes(content)
    result = type_in("study", tmp_path)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"nlcwfs: {tmp_path / 'results.ecsv'}: must ")
    assert len(result.stderr.splitlines()) == 1
    assert (tmp_path / "results.ecsv").read_bytes() == content


def test_a_table_of_something_else_is_told_by_its_columns(tmp_path):
    path = tmp_path / "results.ecsv"
    path.write_text("# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\n# schema: astropy-2.0\na\n1\n")
    with pytest.raises(FileFormatError, match=r"must have the columns .*, got no case$"):
        StudyTable(path)


def test_words_in_any_script_survive(tmp_path):
    written(tmp_path, SHORT.replace("Does it run?", "Läuft es?"))
    assert read_study(tmp_path).question == "Läuft es?"
    row = {"case": "r\N{SUBSCRIPT ZERO}", "group": "g", "digest": "d"}
    StudyTable(tmp_path / "results.ecsv").put(row, STAMP)
    assert StudyTable(tmp_path / "results.ecsv").rows == [row]


# ------------------------------------------------------------------------------------------ page and figures


def row(case: str, group: str = "methods", **numbers) -> dict:
    empty = dict.fromkeys(("error_over_predicted", "bound_pixels_nm", "quantum_pixels_nm"), math.nan)
    return {"case": case, "group": group} | NUMBERS | empty | numbers


def method_rows() -> list[dict]:
    pixels = {"p16_pixels_nm": 15.0, "p84_pixels_nm": 20.0, "captured_pixels": 1.0, "method": "map"}
    groups = {f"error_over_predicted_{name}": value for name, value in (("low", 1.1), ("middle", 0.9), ("high", 0.8))}
    bound = {"bound_pixels_nm": 16.0, "quantum_pixels_nm": 11.0, "error_over_predicted": 0.95}
    old = {"p16_pixels_nm": 50.0, "p84_pixels_nm": 70.0, "captured_pixels": 0.25, "method": "gerchberg-saxton"}
    return [
        row("2e4-map-3-4", median_pixels_nm=17.0, ffts=1300.0, **pixels, **groups, **bound),
        row("2e4-map-1-0", median_pixels_nm=18.0, ffts=700.0, **pixels, **groups),
        row("2e4-plain-10", median_pixels_nm=60.0, ffts=173.0, **old),
        row("2e3-map-3-4", photons=2e3, median_pixels_nm=35.0, ffts=1400.0, **pixels, **groups),
        row("planes-2-map", "planes", median_pixels_nm=19.0, ffts=800.0, **pixels, **groups),
    ]


def test_a_case_says_photons_family_and_budget():
    assert parts("2e4-fast-forward-40") == ("2e4", "fast-forward", "40")
    assert parts("2e6-map-3-4") == ("2e6", "map", "3-4")


def test_cost_has_a_panel_for_each_number_of_photons():
    upper_dim, upper, lower_dim, lower = draw_cost(method_rows()).axes
    assert [axes.get_title() for axes in (upper_dim, upper)] == [
        r"$2 \times 10^3$ photons",
        r"$2 \times 10^4$ photons",
    ]
    curves = {line.get_label(): line.get_xydata().tolist() for line in upper.lines}
    assert curves[METHODS["map"][1]] == [[700, 18], [1300, 17]]  # in the order of their cost
    assert curves[METHODS["plain"][1]] == [[173, 60]]
    assert [line.get_ydata()[0] for line in upper.lines if line.get_linestyle() == "--"] == [16.0]
    assert [line.get_ydata()[0] for line in upper.lines if line.get_linestyle() == ":"] == [11.0]
    assert [line.get_xydata().tolist() for line in lower.lines] == [[[173, 25]], [[700, 100], [1300, 100]]]
    assert len(upper_dim.lines) == 1
    assert len(lower_dim.lines) == 1
    assert draw_cost([row("a", "few")]) is None


def test_calibration_shows_the_default_of_every_sky_and_no_other_budget():
    left, right = draw_calibration(method_rows()).axes
    labels = [text.get_text() for text in left.get_xticklabels()]
    assert labels == [r"$2 \times 10^4$ photons", r"$2 \times 10^3$ photons", "planes-2"]
    low = next(line for line in left.lines if line.get_label() == "below 4 cycles per aperture")
    assert list(low.get_ydata()) == [1.1, 1.1, 1.1]
    curve = next(line for line in right.lines if line.get_label() == METHODS["map"][1])
    np.testing.assert_array_equal(curve.get_xydata(), [[2e3, np.nan], [2e4, 0.95]])
    assert draw_calibration([row("a", "few")]) is None


def test_the_page_of_a_study_on_pixels_shows_the_error_there(tmp_path):
    text = 'score = "pixels"\n' + SHORT.replace("few =", "methods =")
    study = read_study(written(tmp_path, text))
    table = StudyTable(tmp_path / "results.ecsv")
    table.rows = method_rows()
    lines = write_report(tmp_path, study, table, {}).read_text(encoding="utf-8").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    first = dict(zip(cells[0], cells[2], strict=True))
    assert (first["captured"], first["median [nm]"], first["fine [nm]"]) == ("100.0%", "17.0", "25.2")
    assert (first["low / middle / high"], first["bound [nm]"]) == ("1.10 / 0.90 / 0.80", "16.0")
    third = dict(zip(cells[0], cells[4], strict=True))
    assert (third["case"], third["low / middle / high"], third["bound [nm]"]) == ("2e4-plain-10", "", "")


def test_the_command_of_a_quick_look_says_what_it_found_and_writes_no_page(tmp_path, monkeypatch):
    Bench(monkeypatch)
    result = type_in("study", written(tmp_path), "--screens", "2", "--only", "a")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-3:] == [
        "a-default: 100% of 3 captured, median 25.2 nm, 711 FFTs, nan ms",
        "a-bright: 100% of 3 captured, median 25.2 nm, 711 FFTs, nan ms",
        f"2 cases in {tmp_path / 'quick.ecsv'}; 2 screens tell little.",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["quick.ecsv", "study.toml"]
    assert stored_cases(tmp_path) == []


def test_what_is_wrong_in_all_cases_is_told_once(tmp_path):
    written(tmp_path, SHORT.replace('"seed=5"', '"seeds=5"'))
    with pytest.raises(FileFormatError) as caught:
        run_study(tmp_path, progress=silent)
    assert str(caught.value).startswith(f"{tmp_path / 'study.toml'}: set: seeds: ")
