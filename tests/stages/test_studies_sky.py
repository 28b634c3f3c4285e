"""Study 14: light that twinkles in a study, what its rows tell of the sky, its budgets and its figure."""

import math

import numpy as np
import pytest

from nlcwfs.config import Config, load_config
from nlcwfs.errors import FileFormatError
from nlcwfs.studies.sky_columns import sky_columns
from nlcwfs.studies.sky_figures import budget, curve, draw_sky_budgets
from nlcwfs.studies.study_cases import read_study
from nlcwfs.studies.study_light import light_kind, make_light

STUDY = """
question = "q"
score = "pixels"
set = [
    "seed=3", "atmosphere.opd_rms_nm=100", "atmosphere.photons=1e9", "detector.pixels_across_pupil=16",
    "detector.window_pixels=24", "simulation.light_oversampling=2",
]
[[case]]
name = "steady"
group = "g"
[[case]]
name = "twinkling"
group = "g"
twinkling = [
    "atmosphere.layer_fractions=[1]", "atmosphere.layer_heights_km=[10]", "atmosphere.wind_speeds_m_per_s=[10]",
    "atmosphere.wind_directions_deg=[0]", "atmosphere.opd_rms_nm=1500",
]
"""


def numbers(config: Config, air: Config | None) -> dict[str, float]:
    return {name: float(value) for name, value in sky_columns(config, air).items()}


def test_light_twinkles_with_the_same_wavefront(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    study = read_study(tmp_path)
    steady, twinkling = study.case
    configs = study.configs(tmp_path / "study.toml")
    light = [make_light(case, configs[case.name], 2, lambda *_: None, air=study.air_of(case)) for case in study.case]
    for one, other in zip(light[0].screens, light[1].screens, strict=True):
        # The longest waves of the air, hundreds of micrometres, are rounded apart: single precision, compiled or not.
        np.testing.assert_allclose(other.truth_m, one.truth_m, atol=1e-8)
        assert np.std(one.truth_m) > 2e-8
        ratio = other.counts.sum() / one.counts.sum()
        assert 0.9 < ratio < 1.1  # right on the mean over many skies
        # Pixels of half a metre leave 2 % of the twinkling; photons vary by 0.1 %.
        assert np.std(other.counts / ratio - one.counts) > 0.01 * np.std(one.counts)
    assert light_kind(steady, configs["steady"]) != light_kind(twinkling, configs["twinkling"])
    told = numbers(configs["twinkling"], study.air_of(twinkling))
    # 19.12 lambda^(-7/6) Cn2 h^(5/6) with r0^(-5/3) = 0.423 k^2 Cn2, r0 that of 1500 nm rms over 8 m.
    wave_m = 0.85e-6
    fried_m = 8 * (1.0299 / (2 * math.pi * 1500e-9 / wave_m) ** 2) ** 0.6
    cn2_h = fried_m ** (-5 / 3) / (0.423 * (2 * math.pi / wave_m) ** 2)
    assert told["index"] == pytest.approx(19.12 * wave_m ** (-7 / 6) * cn2_h * 1e4 ** (5 / 6), rel=0.01)
    assert told["added_nm"] > 0
    assert sky_columns(configs["steady"], study.air_of(steady)) == {}


def test_an_impossible_air_is_a_line_with_its_case(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY.replace("heights_km=[10]", "heights_km=[10, 3]"))
    with pytest.raises(FileFormatError, match=r"study\.toml: case twinkling: atmosphere\.layer_heights_km: must "):
        read_study(tmp_path).configs(path)


def test_a_model_that_is_told_is_promised_less_error():
    star = ["atmosphere.opd_rms_nm=609", "atmosphere.photons=2e6", "atmosphere.star.size_mas=20"]
    rows = [numbers(load_config(None, [*star, f"estimation.map.star={one}"]), None) for one in ("point", "told")]
    assert 0 < rows[1]["added_nm"] < 0.7 * rows[0]["added_nm"]


def row(name: str, group: str, error_nm: float, **more: float) -> dict:
    errors = {"median_pixels_nm": error_nm, "p16_pixels_nm": error_nm - 1, "p84_pixels_nm": error_nm + 1}
    return {"case": name, "group": group, "added_nm": 0.0} | errors | more


TABLE = [
    row("star-100-2e6-0", "star", 10.0),
    row("star-100-2e6-20", "star", 20.0, star_mas=20.0, added_nm=10.0),
    row("star-100-2e6-10", "star", 10.5, star_mas=10.0),
    row("star-told-100-2e6-20", "star-told", 12.0, star_mas=20.0),
    row("dispersion-told-100-2e6-0", "dispersion-told", 8.0),
    row("dispersion-told-100-2e6-0.1", "dispersion-told", 12.0, dispersion_mas=4.0),
    row("scintillation-100-2e6-0.6", "scintillation", 11.0, index=0.07),
]


def test_curves_are_over_the_case_without_the_effect():
    found = curve(TABLE, "star", rms="100", photons="2e6")
    assert found is not None
    np.testing.assert_allclose(found.strength, [0, 10, 20])
    np.testing.assert_allclose(found.measured, [1, 1.05, 2])
    np.testing.assert_allclose(found.expected, [1, 1, math.sqrt(2)])
    told = curve(TABLE, "star", rms="100", photons="2e6", told=True)
    of_colours = curve(TABLE, "dispersion", rms="100", photons="2e6", told=True)
    twinkling = curve(TABLE, "scintillation", rms="100", photons="2e6")
    assert told is not None
    assert of_colours is not None
    assert twinkling is not None
    assert [one.measured[1] for one in (told, of_colours, twinkling)] == pytest.approx([1.2, 1.5, 1.1])
    assert curve(TABLE, "star", rms="609", photons="2e6") is None


def test_a_budget_ends_where_a_tenth_is_added():
    strength = np.array([0.0, 1.0, 2.0, 4.0])
    added = 0.25 * strength
    assert budget(strength, np.hypot(1, added)) == pytest.approx(math.sqrt(0.21) / 0.25, rel=1e-9)
    assert budget(strength, np.ones(4)) == math.inf


def test_the_figure_has_a_panel_for_each_effect():
    figure = draw_sky_budgets(TABLE)
    assert figure is not None
    assert [axes.get_xlabel()[:12] for axes in figure.axes] == ["diameter of ", "residual dis", "scintillatio"]
    drawn = figure.axes[0].get_lines()
    assert any(np.allclose(np.asarray(line.get_ydata(), float)[-1], 2.0) for line in drawn)
    assert draw_sky_budgets(TABLE[:2]) is None
