"""Study 13: what its rows tell of colours, and its figure."""

import numpy as np
import pytest

from nlcwfs.config import Config, load_config
from nlcwfs.studies.colour_columns import colour_columns
from nlcwfs.studies.colour_figures import draw_colours_for_lenses


def test_rows_tell_the_band_the_lenses_and_the_model():
    flat = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_um=0.34", "beam.spectrum.wavelengths=7"]
    found = colour_columns(load_config(None, [*flat, "curvature_sensor.lenses=ideal", "estimation.map.wavelengths=5"]))
    assert found == {"band": 0.4, "lenses": "ideal", "light_colours": 7, "model_colours": 5}
    assert colour_columns(Config()) == {}


def row(case: str, error_nm: float, **more) -> dict:
    errors = {"median_pixels_nm": error_nm, "p16_pixels_nm": error_nm - 1, "p84_pixels_nm": error_nm + 2}
    return {"case": case, "group": "300", "ffts": 1000.0} | errors | more


def of(lenses: str, colours: int, error_nm: float, **more) -> dict:
    told = {"band": 0.4, "lenses": lenses, "model_colours": float(colours)}
    return row(f"{lenses}-300-40-{colours}", error_nm, **told, **more)


def test_errors_and_costs_are_drawn_over_those_of_one_wavelength():
    table = [
        row("one-300", 10.0),
        of("achromatic", 3, 12.0, ffts=3000.0),
        of("achromatic", 1, 20.0),
        of("ideal", 1, 11.0),
    ]
    figure = draw_colours_for_lenses(table)
    assert figure is not None
    errors, cost = figure.axes
    assert errors.get_title() == "300 nm rms: 10.0 nm in one wavelength"
    curves = {line.get_label(): np.asarray(line.get_xydata(), float) for line in errors.get_lines()}
    assert any(curve.shape == (2, 2) and np.allclose(curve, [[1, 2.0], [3, 1.2]]) for curve in curves.values())
    np.testing.assert_allclose(curves["40%, ideal lenses"], [[0.75, 1.1]])
    ratios = {line.get_label(): np.asarray(line.get_ydata(), float) for line in cost.get_lines()}
    assert ratios["FFTs"] == pytest.approx([1, 3])
    assert draw_colours_for_lenses(table[1:]) is None
