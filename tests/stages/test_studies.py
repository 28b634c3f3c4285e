"""A study: its file, its table that resumes, its numbers, its page and figures, and the command that runs it."""

import math
from datetime import UTC, datetime, timedelta

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from astropy.table import Table
from tests.stages.command_line import type_in

from nlcwfs.beam.grid import Grid
from nlcwfs.config import load_config
from nlcwfs.errors import FileFormatError
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.reconstructor import GerchbergSaxton
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.studies import case_run, study_run
from nlcwfs.studies.accelerator_figures import draw_convergence, draw_light_and_turbulence, family
from nlcwfs.studies.case_bound import LightInformation
from nlcwfs.studies.study_cases import Capture, Case, read_study
from nlcwfs.studies.study_figures import FIGURES, draw_figures
from nlcwfs.studies.study_light import Light, Screen
from nlcwfs.studies.study_report import write_report
from nlcwfs.studies.study_run import BOUND_COLUMNS, run_study
from nlcwfs.studies.study_table import StudyTable

CAMERA = ["beam.wavelength_um=0.65", "detector.pixels_across_pupil=12", "detector.window_pixels=16"]
SKY = ["atmosphere.opd_rms_nm=100", "atmosphere.photons=1e5", "simulation.light_oversampling=2"]
GERCHBERG_SAXTON = "estimation.method=gerchberg-saxton"
FEW = ["coarse_cutoffs_cpa=[]", "iterations=12", "fast_forward=0", "gain=1", "tolerance_rad=0"]
PLAIN = [
    GERCHBERG_SAXTON,
    *(f"estimation.gerchberg_saxton.{one}" for one in (*FEW, "filter=none", "scheme=serial", "amplitude=replace")),
]
SLOPES = ["estimation.unwrapping=slopes", "estimation.modes=20"]

SHORT = """question = "Does it run?"
answer = "It runs"
screens = 3
set = ["seed=5", "atmosphere.photons=3e4"]

[groups]
few = "A few cases"

[[case]]
name = "a-default"
group = "few"

[[case]]
name = "b-known"
group = "few"
strength = "known"
set = ["estimation.gerchberg_saxton.gain=1"]

[[case]]
name = "a-bright"
group = "few"
screens = 2
set = ["atmosphere.photons=1e6"]
"""


def written(folder, text: str = SHORT):
    """The folder, with the text as its study."""
    folder.mkdir(exist_ok=True)
    (folder / "study.toml").write_text(text, encoding="utf-8")
    return folder


def silent(case: str, done: int, total: int) -> None:
    """Nobody looks."""


# ------------------------------------------------------------------------------------------ study.toml


def test_a_study_says_what_it_asks(tmp_path):
    study = read_study(written(tmp_path))
    assert (study.question, study.answer, study.screens, study.captured_nm) == ("Does it run?", "It runs", 3, 60.0)
    assert [case.name for case in study.case] == ["a-default", "b-known", "a-bright"]
    assert [study.screens_of(case) for case in study.case] == [3, 3, 2]
    configs = [study.config_of(case) for case in study.case]
    assert {config.seed for config in configs} == {5}
    assert [config.atmosphere.photons for config in configs] == [3e4, 3e4, 1e6]  # a case overrules the study
    assert [config.estimation.gerchberg_saxton.gain for config in configs] == [1.5, 1.0, 1.5]


FIRST_CASE = 'question = "?"\n[[case]]\nname = "a"\ngroup = "g"\n'


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("question", "must be TOML, got Expected '=' after a key in a key/value pair (at end of document)"),
        ('question = "?"', "case: Field required, got nothing"),
        (FIRST_CASE[15:], "question: Field required, got nothing"),
        (FIRST_CASE + "captured = 3", "case.0.captured: Extra inputs are not permitted, got 3"),
        ("colour = 3\n" + FIRST_CASE, "colour: Extra inputs are not permitted, got 3"),
        (FIRST_CASE + 'light = "coarse"', "case.0.light: Input should be 'finer' or 'matched', got 'coarse'"),
        (FIRST_CASE + "screens = 0", "case.0.screens: Input should be greater than or equal to 1, got 0"),
        ("captured_nm = -1.5\n" + FIRST_CASE, "captured_nm: Input should be greater than 0, got -1.5"),
        (FIRST_CASE + '[[case]]\nname = "a"\ngroup = "h"', "case.name: must be unique, got twice ['a']"),
    ],
)
def test_a_wrong_file_is_told_in_one_line(tmp_path, text, complaint):
    written(tmp_path, text)
    with pytest.raises(FileFormatError) as caught:
        read_study(tmp_path)
    assert str(caught.value) == f"{tmp_path / 'study.toml'}: {complaint}"


def test_a_study_that_is_not_there_or_not_text_is_told_in_one_line(tmp_path):
    with pytest.raises(FileFormatError) as caught:
        read_study(tmp_path / "none")
    assert str(caught.value) == f"{tmp_path / 'none' / 'study.toml'}: must exist, got no such file"
    (tmp_path / "study.toml").write_bytes(b'question = "\xff"')
    with pytest.raises(FileFormatError) as caught:
        read_study(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'study.toml'}: must be TOML, got 'utf-8' codec can't decode")
    assert "\n" not in str(caught.value)


def test_an_impossible_setting_is_told_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(study_run, "make_light", None)
    written(tmp_path, SHORT.replace('"atmosphere.photons=1e6"', '"atmosphere.photon=1e6"'))
    with pytest.raises(FileFormatError) as caught:
        run_study(tmp_path, progress=silent)
    assert str(caught.value).startswith(f"{tmp_path / 'study.toml'}: case a-bright: atmosphere.photon: ")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "results.ecsv").exists()


@pytest.mark.parametrize("over_fried", [0.9, 8.2, 25.0])
def test_the_strength_of_a_case_is_that_of_its_air(tmp_path, over_fried):
    text = SHORT.replace('name = "b-known"', f'name = "b-known"\ntelescope_over_fried = {over_fried}')
    study = read_study(written(tmp_path, text.replace("seed=5", "beam.wavelength_um=0.65")))
    air = ExposureSimulator.build(study.config_of(study.case[1]).model_copy(update={"detector": small().detector})).air
    assert 8.0 / air.fried_at(0.65e-6) == pytest.approx(over_fried, rel=1e-3)  # 1.0299 has five digits
    assert study.config_of(study.case[0]).atmosphere.opd_rms_nm is None


def small(*options: str):
    return load_config(None, [*CAMERA, *SKY, *options])


# --------------------------------------------------------------------------------------------- one real study


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Two small cases, the light of each, and the error of each screen."""
    folder = tmp_path_factory.mktemp("real")
    lines = [
        'question = "?"',
        "screens = 3",
        "captured_nm = 40.0",
        f"set = {[*CAMERA, *SKY, *PLAIN]}",
        '[[case]]\nname = "matched"\ngroup = "g"\nlight = "matched"',
        'set = ["estimation.gerchberg_saxton.scheme=averaged"]',
        f'[[case]]\nname = "slopes"\ngroup = "g"\nscreens = 2\nset = {SLOPES}',
    ]
    written(folder, "\n".join(lines))
    lights, errors_m, progress = [], [], []

    def light(*arguments, **air):
        lights.append(make_light(*arguments, **air))
        return lights[-1]

    def error_m(*arguments):
        errors_m.append(score(*arguments))
        return errors_m[-1]

    make_light, score = study_run.make_light, case_run.wavefront_error_m
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_run, "make_light", light)
        patch.setattr(case_run, "wavefront_error_m", error_m)
        table = run_study(folder, progress=lambda *call: progress.append(call))
    return folder, table, lights, 1e9 * np.array(errors_m), progress


def test_a_study_runs_from_its_file_to_its_table(real):
    folder, table, _, errors_nm, progress = real
    stored = Table.read(folder / "results.ecsv", format="ascii.ecsv")
    assert list(stored["case"]) == ["matched", "slopes"] == [row["case"] for row in table.rows]
    assert list(stored["screens"]) == [3, 2]
    assert list(stored["light"]) == ["matched", "finer"]
    assert list(stored["light_oversampling"]) == [1, 2]
    assert list(stored["pixels"]) == [12, 12]
    assert list(stored["iterations"]) == [12, 12]
    assert list(stored["ffts"]) == [12 * 10 + 13, 12 * 16 + 13]  # averaged and serial; and 13 for the verdict
    assert str(stored["median_nm"].unit) == "nm"
    # 100 nm rms of turbulence in bright light: found, but for what twelve pixels cannot show.
    assert np.all((errors_nm > 1) & (errors_nm < 40))
    assert [call for call in progress if call[0] == "slopes"] == [("slopes", 1, 2), ("slopes", 2, 2)]
    assert ("matched: light", 3, 3) in progress


def test_the_statistics_are_those_of_the_screens(real):
    """By hand: sorted, and straight lines between the ranks."""
    _, table, _, errors_nm, _ = real
    for row, errors in zip(table.rows, (errors_nm[:3], errors_nm[3:]), strict=True):
        ranked = sorted(errors)
        last = len(ranked) - 1
        for name, part in (("p5_nm", 0.05), ("p16_nm", 0.16), ("median_nm", 0.5), ("p84_nm", 0.84), ("p95_nm", 0.95)):
            below = math.floor(part * last)
            between = ranked[below] + (part * last - below) * (ranked[below + 1] - ranked[below])
            assert row[name] == pytest.approx(between, abs=0.006), name  # two digits are kept
        assert row["captured"] == 1.0
        assert row["median_captured_nm"] == row["median_nm"]


def chi_squared(counts, mean) -> float:
    """The chance of counts at least so far from their mean, if it is their mean."""
    seen = mean > 5
    value = np.sum((counts - mean)[seen] ** 2 / mean[seen])
    return float(scipy.stats.chi2.sf(value, np.sum(seen)))


def fresnel(pupil, opd_m, pixel_m: float) -> np.ndarray:
    """Shares of the photons of each plane, in NumPy, on the default's four planes."""
    frequency = np.fft.fftfreq(pupil.shape[0], pixel_m)
    squared = frequency[:, None] ** 2 + frequency**2
    near = np.fft.fft2(pupil * np.exp(2j * np.pi / 0.65e-6 * opd_m) / np.sqrt(np.sum(pupil**2)))
    distances_m = [1e3 * one for one in small().curvature_sensor.distances_km]
    far = [np.fft.ifft2(near * np.exp(-1j * np.pi * 0.65e-6 * z * squared)) for z in distances_m]
    return abs(np.array(far)) ** 2 / len(distances_m)


def test_matched_light_is_made_on_the_pixels_and_finer_light_is_not(real):
    matched, finer = real[2]
    simulator = ExposureSimulator.build(small())
    pixels = simulator.frame
    pupil = simulator.shape.on(pixels)
    assert matched.grid == pixels
    np.testing.assert_allclose(matched.weights, pupil**2 / np.sum(pupil**2), atol=1e-7)  # single precision
    assert finer.grid.pixel_m == pytest.approx(8.0 / 24)
    assert np.sum(finer.weights) == pytest.approx(1, abs=1e-5)
    assert len(matched.screens) == 3
    assert len(finer.screens) == 2
    wide = simulator.light
    margin = (wide.shape[0] - finer.grid.shape[0]) // 2
    for one in matched.screens:
        assert chi_squared(one.counts, 1e5 * fresnel(pupil, one.truth_m, pixels.pixel_m)) > 1e-6
        assert chi_squared(one.counts, 1e5 * fresnel(pupil, one.truth_m[::-1], pixels.pixel_m)) < 1e-6
    for one in finer.screens:
        fine = fresnel(simulator.shape.on(wide), np.pad(one.truth_m, margin), wide.pixel_m)
        binned = fine.reshape(4, wide.shape[0] // 2, 2, -1, 2).sum(axis=(2, 4))
        edge = (binned.shape[1] - 16) // 2
        inside = binned[:, edge : edge + 16, edge : edge + 16]
        assert chi_squared(one.counts, 1e5 * inside) > 1e-6
        own = simulator.on_pixels(jnp.asarray(np.pad(one.truth_m, margin)))
        assert chi_squared(one.counts, 1e5 * fresnel(pupil, np.nan_to_num(own), pixels.pixel_m)) < 1e-6
    # The same skies, whatever the light.
    again = np.asarray(simulator.expose(frame_key(seed=0, frame=1)).opd_m)[margin:-margin, margin:-margin]
    np.testing.assert_allclose(finer.screens[1].truth_m, again, atol=1e-12)


def test_a_second_run_finds_all_done(real, monkeypatch):
    folder, table, *_ = real
    before = (folder / "results.ecsv").read_bytes()
    monkeypatch.setattr(study_run, "make_light", None)
    monkeypatch.setattr(study_run, "run_case", None)
    again = run_study(folder, progress=lambda *call: pytest.fail(f"ran {call}"))
    assert [row["median_nm"] for row in again.rows] == [row["median_nm"] for row in table.rows]
    assert (folder / "results.ecsv").read_bytes() == before


# ------------------------------------------------------------------------------- one case, its outcomes by hand


def pretended(monkeypatch, seen: list) -> None:
    """A reconstructor whose answer is in the counts: the wavefront, then the outcome and other numbers."""

    def estimate(self, counts, usable, *, read_variance=0.0):
        seen.append(read_variance)
        number = counts[1].reshape(-1)
        return WavefrontEstimate(
            opd_m=counts[0],
            predicted_error_m=number[1],
            unexplained=number[0],
            residual=counts,
            iterations=number[2].astype(int),
            ffts=number[3].astype(int),
            outcome_code=number[0].astype(int),
            strength=number[4],
        )

    monkeypatch.setattr(GerchbergSaxton, "estimate", estimate)


def screen(error_nm: float, outcome: Outcome, *, predicted_nm=0.0, iterations=0, ffts=0, strength=1.0) -> Screen:
    """On 16 x 16 pixels: half the window too high by the error, half too low."""
    counts = np.zeros((4, 16, 16))
    counts[0] = 1e-9 * error_nm * np.where(np.arange(16) < 8, 1.0, -1.0)
    counts[1].flat[:5] = outcome, 1e-9 * predicted_nm, iterations, ffts, strength
    return Screen(np.zeros((16, 16)), counts, np.zeros((16, 16)))


def summed_up(monkeypatch, screens: list[Screen], *options: str, **case) -> tuple[dict, list]:
    seen = []
    pretended(monkeypatch, seen)
    even = np.full((16, 16), 1 / 256)
    light = Light(screens, Grid((16, 16), 8.0 / 12), even, even)
    one = Case(name="a", group="g", **case)
    config = small(GERCHBERG_SAXTON, *options)
    return case_run.run_case(one, config, Capture(60.0), light, silent), seen


def test_outcomes_and_medians_are_counted_as_they_are(monkeypatch):
    right, spent, wrong = Outcome.CONVERGED, Outcome.BUDGET_SPENT, Outcome.NOT_EXPLAINED
    row, _ = summed_up(
        monkeypatch,
        [
            screen(10, right, predicted_nm=9, iterations=30, ffts=100, strength=2.0),
            screen(59.9, spent, predicted_nm=20, iterations=10, ffts=400, strength=1.0),
            screen(60.1, right, predicted_nm=11, iterations=20, ffts=300, strength=4.0),  # believed, and wrong
            screen(300, wrong, predicted_nm=12, iterations=40, ffts=200, strength=3.0),
            screen(20, wrong, predicted_nm=10, iterations=50, ffts=500, strength=2.5),  # doubted, and right
        ],
    )
    assert row["screens"] == 5
    assert row["captured"] == pytest.approx(3 / 5)
    assert row["median_nm"] == pytest.approx(59.9, abs=0.006)
    assert row["median_captured_nm"] == pytest.approx(20, abs=0.006)
    assert row["p95_nm"] == pytest.approx(60.1 + 0.8 * (300 - 60.1), abs=0.006)
    assert row["believed"] == pytest.approx(3 / 5)
    assert row["believed_wrong"] == pytest.approx(1 / 5)
    assert row["doubted_right"] == pytest.approx(1 / 5)
    assert (row["predicted_nm"], row["iterations"], row["ffts"]) == (pytest.approx(11), 30, 300)


def test_an_estimate_that_is_not_finite_is_lost_and_not_forgotten(monkeypatch):
    lost, broken = screen(math.nan, Outcome.NOT_FINITE), screen(math.nan, Outcome.CONVERGED)
    row, _ = summed_up(monkeypatch, [screen(10, Outcome.CONVERGED), lost, broken, lost])
    assert (row["captured"], row["believed_wrong"], row["doubted_right"]) == (0.25, 0.25, 0.0)
    assert row["median_nm"] == 1e6
    row, _ = summed_up(monkeypatch, [lost, lost])
    assert row["captured"] == 0.0
    assert math.isnan(row["median_captured_nm"])


def test_the_reconstructor_knows_the_noise_of_a_pixel_without_star(monkeypatch):
    """Read noise divided by the gain, dark electrons, and the sky: what was subtracted leaves its noise."""
    camera = {"read_noise_electrons": 6.0, "em_gain": 2.0, "dark_electrons": 0.25}
    camera |= {"background_photons": 3.0, "quantum_efficiency": 0.5}
    options = [f"detector.{name}={value}" for name, value in camera.items()]
    _, seen = summed_up(monkeypatch, [screen(10, Outcome.CONVERGED)], *options)
    assert seen == [pytest.approx(9 + 0.25 + 1.5)]


def test_the_sky_of_a_case_is_in_its_row(monkeypatch):
    radian_nm = 650 / (2 * np.pi)
    over_fried = (100 / radian_nm) ** (6 / 5) / 1.0299 ** (3 / 5)
    fried_m = 8.0 / over_fried * (0.5 / 0.65) ** (6 / 5)  # at 500 nm
    seeing_arcsec = np.degrees(0.976 * 0.5e-6 / fried_m) * 3600
    twice = screen(10, Outcome.CONVERGED, strength=2.0)
    row, _ = summed_up(monkeypatch, [twice])
    assert row["telescope_over_fried"] == pytest.approx(over_fried, abs=2e-3)
    # Strength 1 is 0.6" for who measures, the truth for who knows.
    assert row["strength_ratio"] == pytest.approx(2 * (0.6 / seeing_arcsec) ** (5 / 3), rel=3e-3)
    row, _ = summed_up(monkeypatch, [twice], strength="known")
    assert row["strength_ratio"] == 2.0
    solver, _ = case_run.build_solver(Case(name="a", group="g", strength="known"), small(GERCHBERG_SAXTON))
    assert not solver.measures_strength
    assert solver.settings.seeing_arcsec == pytest.approx(seeing_arcsec, rel=2e-3)
    assert case_run.build_solver(Case(name="a", group="g"), small(GERCHBERG_SAXTON))[0].measures_strength


# ------------------------------------------------------------------------------------------------- resuming

NUMBERS = {
    "screens": 3, "captured": 1.0, "p5_nm": 20.0, "p16_nm": 21.0, "median_nm": 25.25, "p84_nm": 29.0, "p95_nm": 31.0,
    "median_captured_nm": 25.25, "ffts": 711.0, "iterations": 68.0, "predicted_nm": 24.0, "believed": 1.0,
    "believed_wrong": 0.0, "doubted_right": 0.005, "telescope_over_fried": 8.2, "photons": 2e4, "pixels": 45,
    "window": 64, "light": "finer", "light_oversampling": 4, "max_iterations": 20, "strength_ratio": 1.0,
}  # fmt: skip
BOUND = {"bound_nm": 22.0, "quantum_nm": 19.0, "sensor_loss": 3.0}


class Bench:
    """Light and cases that take no time, and what was asked of them."""

    def __init__(self, monkeypatch):
        self.lights, self.cases, self.interrupt_at = [], [], None
        monkeypatch.setattr(study_run, "make_light", self.make_light)
        monkeypatch.setattr(study_run, "run_case", self.run_case)

    def make_light(self, case, config, count, progress, *, air=None):
        self.lights.append((case.name, count))
        return Light([], Grid((2, 2), 1.0), np.ones((2, 2)), np.ones((2, 2)))

    def run_case(self, case, config, capture, light, progress):
        if case.name == self.interrupt_at:
            raise KeyboardInterrupt
        self.cases.append(case.name)
        progress(case.name, 3, 3)
        return dict(NUMBERS) | {"photons": config.atmosphere.photons}

    def ran(self, folder, **options) -> list[str]:
        """The cases that a run had to compute."""
        self.lights, self.cases = [], []
        run_study(folder, progress=silent, **options)
        return self.cases


@pytest.fixture
def bench(monkeypatch):
    return Bench(monkeypatch)


def stored_cases(folder) -> list[str]:
    return [str(row["case"]) for row in StudyTable(folder / "results.ecsv").rows]


def test_cases_of_the_same_light_share_it(tmp_path, bench):
    assert bench.ran(written(tmp_path)) == ["a-default", "b-known", "a-bright"]
    assert bench.lights == [("a-default", 3), ("a-bright", 2)]
    more = SHORT.replace('strength = "known"', 'strength = "known"\nscreens = 4')
    bench.ran(written(tmp_path / "more", more))
    assert bench.lights == [("a-default", 3), ("b-known", 4), ("a-bright", 2)]
    fewer = SHORT.replace('strength = "known"', 'strength = "known"\nscreens = 2')
    bench.ran(written(tmp_path / "fewer", fewer))
    assert bench.lights == [("a-default", 3), ("a-bright", 2)]  # the first two of the three
    matched = SHORT.replace('strength = "known"', 'light = "matched"')
    bench.ran(written(tmp_path / "matched", matched))
    assert bench.lights == [("a-default", 3), ("b-known", 3), ("a-bright", 2)]


def test_an_interrupted_study_keeps_what_is_done_and_goes_on(tmp_path, bench):
    bench.interrupt_at = "b-known"
    with pytest.raises(KeyboardInterrupt):
        bench.ran(written(tmp_path))
    assert stored_cases(tmp_path) == ["a-default"]
    bench.interrupt_at = None
    assert bench.ran(tmp_path) == ["b-known", "a-bright"]
    assert stored_cases(tmp_path) == ["a-default", "b-known", "a-bright"]
    assert bench.ran(tmp_path) == []
    assert bench.lights == []


@pytest.mark.parametrize(
    ("old", "new", "again"),
    [
        ("gain=1", "gain=2", ["b-known"]),
        ('strength = "known"', "", ["b-known"]),
        ("screens = 2", "screens = 4", ["a-bright"]),
        ("screens = 3", "screens = 4", ["a-default", "b-known"]),
        ("seed=5", "seed=6", ["a-default", "b-known", "a-bright"]),
        ("[groups]", "[groups]\nmore = 'More'", []),
        ("It runs", "It still runs", []),
        ("screens = 3", "screens = 3\ncaptured_nm = 50.0", ["a-default", "b-known", "a-bright"]),
        ('name = "b-known"', 'name = "c-known"', ["c-known"]),
    ],
)
def test_what_changes_runs_again_and_nothing_else(tmp_path, bench, old, new, again):
    bench.ran(written(tmp_path))
    assert bench.ran(written(tmp_path, SHORT.replace(old, new))) == again
    names = ["a-default", "c-known" if "c-known" in new else "b-known", "a-bright"]
    assert stored_cases(tmp_path) == names  # in the order of the study, without what is gone


def test_only_some_cases_run(tmp_path, bench):
    written(tmp_path)
    assert bench.ran(tmp_path, only=("a-b", "b")) == ["b-known", "a-bright"]
    assert bench.ran(tmp_path) == ["a-default"]
    assert stored_cases(tmp_path) == ["a-default", "b-known", "a-bright"]


def test_a_quick_look_leaves_the_rows_of_the_study_alone(tmp_path, bench):
    bench.ran(written(tmp_path))
    before = (tmp_path / "results.ecsv").read_bytes()
    assert bench.ran(tmp_path, screens=3) == ["a-default", "b-known", "a-bright"]
    assert bench.ran(tmp_path, screens=3) == []  # it resumes, too
    assert bench.ran(tmp_path, screens=2, only=("a-d",)) == ["a-default"]
    assert (tmp_path / "results.ecsv").read_bytes() == before
    assert bench.ran(tmp_path) == []
    assert len(StudyTable(tmp_path / "quick.ecsv").rows) == 3


def test_cases_that_differ_in_photons_alone_share_the_information(tmp_path, bench, monkeypatch):
    asked, nothing = [], LightInformation([], None, np.zeros((0, 0)), 0.1)
    monkeypatch.setattr(study_run, "light_information", lambda config: asked.append(config) or nothing)
    monkeypatch.setattr(study_run, "case_bound", lambda config, light: BOUND | {"bound_nm": config.atmosphere.photons})
    bench.ran(written(tmp_path, SHORT.replace('group = "few"', 'group = "few"\nbound = true')))
    assert [row["bound_nm"] for row in StudyTable(tmp_path / "results.ecsv").rows] == [3e4, 3e4, 1e6]
    assert len(asked) == 1
    other_seed = SHORT.replace('"atmosphere.photons=1e6"', '"seed=6"')
    bench.ran(written(tmp_path / "other", other_seed.replace('group = "few"', 'group = "few"\nbound = true')))
    assert len(asked) == 3
    bench.ran(written(tmp_path / "none"))
    assert len(asked) == 3
    rows = StudyTable(tmp_path / "none" / "results.ecsv").rows
    assert np.isnan([row[name] for row in rows for name in BOUND_COLUMNS]).all()


def stamp(folder) -> dict:
    return Table.read(folder / "results.ecsv", format="ascii.ecsv").meta["provenance"]


def test_the_table_says_who_made_it(tmp_path, bench):
    bench.ran(written(tmp_path))
    first = stamp(tmp_path)
    assert first["seed"] == 5
    assert datetime.now(UTC) - datetime.fromisoformat(first["date_utc"] + "+00:00") < timedelta(minutes=10)
    bench.ran(written(tmp_path, SHORT.replace('"atmosphere.photons=1e6"', '"seed=6"')))
    second = stamp(tmp_path)
    assert second["seed"] is None  # the cases have two
    assert second["settings_digest"] != first["settings_digest"]


# ----------------------------------------------------------------------------------------- page and figures


def row(name: str, group: str, **numbers) -> dict:
    empty = dict.fromkeys(BOUND, math.nan)
    return {"case": name, "group": group} | NUMBERS | empty | numbers | {"digest": "0"}


def table_of(folder, rows: list[dict]) -> StudyTable:
    table = StudyTable(folder / "results.ecsv")
    table.rows = rows
    return table


def test_the_page_begins_with_the_answer_and_shows_the_rows(tmp_path):
    study = read_study(written(tmp_path, "notes = '''\nA note.\n'''\n" + SHORT))
    rows = [row("a-default", "few", **BOUND), row("a-bright", "few", photons=1e6, captured=0.995, median_nm=30.04)]
    rows.append(row("other", "group that has no heading"))
    path = write_report(tmp_path, study, table_of(tmp_path, rows), {"curve.png": "What it shows."})
    assert path == tmp_path / "README.md"
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[:5] == ["# It runs", "", "Does it run?", "", "![What it shows.](curve.png)"]
    assert "## A few cases" in lines
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert cells[0][:6] == ["case", "D/r0", "photons", "pixels", "light", "screens"]
    assert set(cells[1]) == {"---"}
    first, second = (dict(zip(cells[0], each, strict=True)) for each in cells[2:])
    assert (first["case"], first["photons"], first["captured"], first["median [nm]"]) == (
        "a-default", "2e+04", "100.0%", "25.2",
    )  # fmt: skip
    assert (first["5 to 95 % [nm]"], first["bound [nm]"], first["quantum limit [nm]"]) == (
        "20.0 to 31.0",
        "22.0",
        "19.0",
    )
    assert (second["case"], second["photons"], second["captured"], second["median [nm]"]) == (
        "a-bright", "1e+06", "99.5%", "30.0",
    )  # fmt: skip
    assert (second["bound [nm]"], second["doubted right"]) == ("", "0.5%")
    assert lines[-1] == "A note."
    assert "nan" not in path.read_text(encoding="utf-8").lower()


def test_a_column_without_a_number_is_left_out(tmp_path):
    study = read_study(written(tmp_path))
    rows = [row("a-default", "few", median_captured_nm=math.nan, captured=0.0)]
    text = write_report(tmp_path, study, table_of(tmp_path, rows), {}).read_text(encoding="utf-8")
    assert "nan" not in text.lower()
    assert "bound" not in text
    assert "median of captured" not in text
    assert "| median [nm] |" in text


def test_a_page_from_the_stored_table_is_that_from_the_rows(tmp_path):
    """Numbers that went through the file are NumPy's, and NaN must still be seen."""
    study = read_study(written(tmp_path))
    rows = [row("a-default", "few", **BOUND), row("b-known", "few")]
    before = write_report(tmp_path, study, table_of(tmp_path, rows), {}).read_text(encoding="utf-8")
    columns = {name: [one[name] for one in rows] for name in rows[0]}
    Table(columns).write(tmp_path / "results.ecsv", format="ascii.ecsv", overwrite=True)
    again = write_report(tmp_path, study, StudyTable(tmp_path / "results.ecsv"), {}).read_text(encoding="utf-8")
    assert again == before


def test_a_case_belongs_to_the_curve_before_its_number():
    assert family("tilt-serial-8") == ("tilt-serial", 8)
    assert family("ladder-0") == ("ladder", 0)


def convergence_rows() -> list[dict]:
    return [
        row("ladder-20", "convergence", ffts=700.0, captured=1.0, median_nm=25.0),
        row("flat-serial-40", "convergence", ffts=640.0, captured=0.5, median_nm=80.0),
        row("ladder-5", "convergence", ffts=550.0, captured=0.75, median_nm=35.0),
        row("paper-8.2", "paper", **BOUND),
    ]


def test_the_curves_of_convergence_are_the_rows_in_the_order_of_their_cost():
    figure = draw_convergence(convergence_rows())
    left, right = figure.axes
    curves = {line.get_label(): line for line in left.lines}
    assert set(curves) == {"plain, from flat", "default: coarse to fine, filtered"}
    ladder = curves["default: coarse to fine, filtered"]
    np.testing.assert_array_equal(ladder.get_xdata(), [550, 700])
    np.testing.assert_array_equal(ladder.get_ydata(), [75, 100])
    errors = {line.get_label(): list(line.get_ydata()) for line in right.lines}
    assert errors["plain, from flat"] == [80]
    assert [22.0, 22.0] in list(errors.values())  # the bound of the paper's case
    assert {text.get_text() for text in right.texts} == {"photon bound"}


def test_the_points_against_photons_and_rms_carry_their_bars_and_bounds():
    rows = [
        row("photons-2e3-45px", "photons", photons=2e3, median_nm=50.0, p5_nm=45.0, p95_nm=57.0, **BOUND),
        row("photons-2e4-45px", "photons", photons=2e4),
        row("photons-2e4-45px-plain", "photons", photons=2e4, median_nm=90.0, p95_nm=99.0),
        row("rms-100", "rms", median_nm=12.0, p5_nm=11.0, p95_nm=14.0),
        row("rms-100-plain", "rms", median_nm=15.0, p5_nm=11.0, p95_nm=19.0),
    ]
    left, right = draw_light_and_turbulence(rows).axes
    points = {bars.get_label(): bars for bars in left.containers}
    assert set(points) == {"default, 45 pixels", "plain GS, 45 pixels"}
    line, _, (bars,) = points["default, 45 pixels"]
    np.testing.assert_array_equal(line.get_xydata(), [[2e3, 50], [2e4, 25.25]])
    np.testing.assert_allclose(bars.get_segments()[0], [[2e3, 45], [2e3, 57]])
    dashed = [each for each in left.lines if each.get_linestyle() == "--"]
    assert [each.get_xydata().tolist() for each in dashed] == [[[2e3, 22.0]]]
    assert {bars.get_label(): bars[0].get_xydata().tolist() for bars in right.containers} == {
        "default, 45 pixels": [[100, 12]],
        "plain GS, 45 pixels": [[100, 15]],
    }


def drawn(folder, study, rows):
    return draw_figures(folder, study.figures, rows, FIGURES)


def test_figures_are_drawn_when_their_rows_are_there(tmp_path):
    study = read_study(written(tmp_path, 'figures = ["convergence", "photons-and-turbulence"]\n' + SHORT))
    assert drawn(tmp_path, study, [row("a", "few")]) == {}
    captions = drawn(tmp_path, study, convergence_rows())
    assert list(captions) == ["convergence.png"]
    assert (tmp_path / "convergence.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["convergence.png", "study.toml"]
    assert drawn(tmp_path, read_study(written(tmp_path)), convergence_rows()) == {}


# ----------------------------------------------------------------------------------------------- the command


def test_the_command_runs_resumes_and_writes_the_page(tmp_path, bench):
    result = type_in("study", written(tmp_path), "--only", "a")
    assert result.exit_code == 0, result.output
    assert bench.cases == ["a-default", "a-bright"]
    page = tmp_path / "README.md"
    assert result.stdout.splitlines() == [
        "a-default: 3 screens",
        "a-bright: 3 screens",
        f"2 cases in {tmp_path / 'results.ecsv'}; wrote {page} and no picture.",
    ]
    assert page.read_text(encoding="utf-8").startswith("# It runs\n")
    bench.cases.clear()
    result = type_in("study", tmp_path, "--quiet")
    assert (result.exit_code, result.output, bench.cases) == (0, "", ["b-known"])
    assert "b-known" in page.read_text(encoding="utf-8")


def test_the_command_ends_with_130_when_it_is_interrupted(tmp_path, bench):
    bench.interrupt_at = "a-bright"
    result = type_in("study", written(tmp_path))
    assert result.exit_code == 130
    assert result.stderr == "nlcwfs: interrupted\n"
    assert stored_cases(tmp_path) == ["a-default", "b-known"]


def test_the_command_ends_with_2_and_one_line_when_the_user_can_mend(tmp_path):
    result = type_in("study", tmp_path / "none")
    assert result.exit_code == 2
    assert result.stderr == f"nlcwfs: {tmp_path / 'none' / 'study.toml'}: must exist, got no such file\n"
    assert result.stdout == ""
    result = type_in("study", written(tmp_path, SHORT.replace("seed=5", "seed=-5")))
    assert result.exit_code == 2
    assert result.stderr.startswith(f"nlcwfs: {tmp_path / 'study.toml'}: set: seed: ")
    assert len(result.stderr.splitlines()) == 1
    assert type_in("study", tmp_path, "--screens", "0").exit_code == 2
