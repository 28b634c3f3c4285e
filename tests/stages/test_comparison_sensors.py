"""What the Shack-Hartmann sensor refuses, in one line each, and how its lattice lies."""

import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, cut_into_subapertures, lenslet_grid
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.estimation.spot_centroids import centre_of_gravity, weighted_centre_of_gravity
from nlcwfs.estimation.spot_model import SpotModel

LIGHT = Spectrum.monochromatic(0.85e-6)


def build(grid, pupil=None, diameter_m=8.0, **settings):
    return ShackHartmann.build(
        np.ones(grid.shape) if pupil is None else pupil,
        grid,
        diameter_m=diameter_m,
        spectrum=LIGHT,
        settings=ShackHartmannSettings(**settings),
        dtype="float64",
    )


@pytest.mark.parametrize(
    ("grid", "change", "message"),
    [
        (
            Grid((120, 120), 8 / 120),
            {"subapertures": 9},
            "shack_hartmann.subapertures: must cut 8 m into whole cells of 0.06667 m; a subaperture has 13.333, got 9",
        ),
        (
            Grid((96, 110), 8 / 108),
            {"subapertures": 9},
            "grid.shape: must exceed the lattice of 108 cells by an even number, got (96, 110)",
        ),
        (
            Grid((108, 109), 8 / 108),
            {"subapertures": 9},
            "grid.shape: must exceed the lattice of 108 cells by an even number, got (108, 109)",
        ),
        (
            Grid((90, 90), 8 / 90),
            {"subapertures": 9},
            "grid.pixel_m: must leave 1.5 times 8 cells in a subaperture, got 10 cells of 0.08889 m",
        ),
    ],
)
def test_a_lattice_that_does_not_fit_is_refused(grid, change, message):
    with pytest.raises(SamplingError) as refusal:
        build(grid, **change)
    assert str(refusal.value) == message


def test_a_pupil_without_a_bright_subaperture_is_refused():
    with pytest.raises(
        SettingsError, match=r"least_light: must leave a subaperture that serves; the brightest gets 0\.25"
    ):
        build(Grid((24, 24), 1 / 3), np.full((24, 24), 0.5), subapertures=2)


def test_a_field_too_small_for_the_seeing_is_refused():
    settings = ShackHartmannSettings(subapertures=4)
    with pytest.raises(SettingsError) as refusal:
        lenslet_grid(settings, diameter_m=8.0, fried_m=0.317)
    rule = "must be at least 12.8, twice the spot of this air behind 2.00 m, got 8.0"
    assert str(refusal.value) == f"shack_hartmann.field_lambda_over_d: {rule}"
    assert lenslet_grid(settings, diameter_m=8.0, fried_m=0.6).shape == (120, 120)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_lengths_of_the_grid_are_positive(value):
    for name in ("diameter_m", "fried_m"):
        with pytest.raises(SettingsError, match=f"lenslet_grid.{name}: must be a positive length"):
            lenslet_grid(ShackHartmannSettings(), **({"diameter_m": 8.0, "fried_m": 0.3} | {name: value}))


@pytest.mark.parametrize("subapertures", [9, 10, 18, 36, 60])
def test_the_grid_carries_the_air_and_the_field(subapertures):
    grid = lenslet_grid(ShackHartmannSettings(subapertures=subapertures), diameter_m=8.0, fried_m=0.317)
    cells = grid.shape[0] // subapertures
    assert grid.shape[0] % subapertures == 0
    assert grid.shape[0] >= 120
    assert cells >= 12
    assert 0.317 / grid.pixel_m >= 3
    assert grid.pixel_m * grid.shape[0] == pytest.approx(8.0)


@pytest.mark.parametrize(
    "change",
    [{"subapertures": 1}, {"pixels": 1}, {"least_light": 0.0}, {"field_lambda_over_d": 16.0, "pixels": 4}, {"lens": 3}],
)
def test_impossible_settings_are_refused(change):
    with pytest.raises(ValidationError):
        ShackHartmannSettings(**change)


@pytest.mark.parametrize("photons", [0.0, -3.0, float("nan")])
def test_no_photons_are_refused_where_they_are_divided_by(photons):
    sensor = build(Grid((24, 24), 1 / 3), subapertures=2)
    spots = sensor.images(jnp.zeros((24, 24)), 1.0)
    with pytest.raises(SettingsError, match="photons: must be positive"):
        sensor.fraction_outside_field(spots, photons)
    with pytest.raises(SettingsError, match="photons: must be positive"):
        SpotModel.of_sensor(sensor, photons=photons)


def test_impossible_filters_are_refused():
    model = SpotModel.of_mean(jnp.ones((1, 4, 4)), pixel_rad=1.0)
    with pytest.raises(SettingsError, match="threshold: must be at least 0 and below 1, got 1"):
        centre_of_gravity(model, threshold=1.0)
    with pytest.raises(SettingsError, match="fwhm_rad: must be a positive angle, got 0"):
        weighted_centre_of_gravity(model, fwhm_rad=0.0)


def test_subapertures_lie_where_their_rows_and_columns_say():
    values = np.arange(26.0 * 28).reshape(26, 28)
    parts = cut_into_subapertures(values, 2, 12)
    for row in (0, 1):
        for column in (0, 1):
            rows, columns = slice(1 + 12 * row, 13 + 12 * row), slice(2 + 12 * column, 14 + 12 * column)
            assert np.array_equal(parts[row, column], values[rows, columns])
    pupil = np.zeros((26, 28))
    pupil[13:25, 2:14] = 1  # row 1, column 0 alone
    sensor = build(Grid((26, 28), 1 / 3), pupil, subapertures=2)
    assert sensor.places.tolist() == [[1, 0]]
    assert sensor.active.tolist() == [[False, False], [True, False]]
    assert sensor.light_share == pytest.approx(1)
    assert np.array_equal(sensor.subaperture_maps(jnp.asarray(values))[0], values[13:25, 2:14])
