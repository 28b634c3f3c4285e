"""The pyramid: where its light goes, what it does not see, how many photons a ripple needs, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.pyramid import Pyramid
from nlcwfs.comparison_sensors.settings import PyramidSettings
from nlcwfs.errors import SamplingError, SettingsError

WAVELENGTH_M = 0.85e-6
RADIAN_M = WAVELENGTH_M / (2 * np.pi)


def sensor_on(grid: Grid, *, ratio=0.0, spectrum=None, **settings) -> Pyramid:
    given = {"pixels": 20, "margin_pixels": 2, "modulation_lambda_over_d": 0.0} | settings
    return Pyramid.build(
        PupilShape(8.0, obstruction_ratio=ratio).on(grid),
        grid,
        diameter_m=8.0,
        spectrum=spectrum or Spectrum.monochromatic(WAVELENGTH_M),
        settings=PyramidSettings(**given),
        dtype="float64",
    )


def rough(grid: Grid, rms_m=1e-7, seed=0) -> jnp.ndarray:
    return jnp.asarray(rms_m * np.random.default_rng(seed).normal(size=grid.shape))


NARROW, ODD = Grid((44, 40), 0.2), Grid((41, 53), 0.2)


@pytest.mark.parametrize("modulation", [0.0, 3.0])
@pytest.mark.parametrize("grid", [NARROW, ODD], ids=["even", "odd"])
def test_no_light_is_lost_where_all_is_read(grid, modulation):
    sensor = sensor_on(grid, separation=10, margin_pixels=90, modulation_lambda_over_d=modulation)
    total = float(sensor.images(rough(grid), 1e4).photons.sum())
    # A roof spreads a wave as 1 / distance: beyond 4.5 diameters around an image half a percent is left.
    assert 0.985e4 < total < 1e4


def test_the_share_that_is_missed_is_told():
    """A flat wavefront, 44 pixels and 8 around: a tenth, and a hundredth, as the docstring says."""
    grid = Grid((88, 88), 8 / 88)
    for modulation, low, high in ((0.0, 0.09, 0.12), (3.0, 0.008, 0.015)):
        sensor = sensor_on(grid, pixels=44, margin_pixels=8, modulation_lambda_over_d=modulation)
        images = sensor.images(jnp.zeros(grid.shape), 1e4)
        missed = float(sensor.fraction_missed(images, 1e4))
        assert low < missed < high
        assert missed == pytest.approx(1 - float(images.photons.sum()) / 1e4)
        with pytest.raises(SettingsError, match="photons: must be positive, got 0"):
            sensor.fraction_missed(images, 0.0)


@pytest.mark.parametrize("modulation", [0.0, 2.0])
def test_piston_changes_nothing(modulation):
    sensor, opd_m = sensor_on(ODD, modulation_lambda_over_d=modulation), rough(ODD)
    images = [np.asarray(sensor.images(opd_m + piston, 1.0).photons) for piston in (0.0, 3.3e-7)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-12 * images[0].max())  # rounding


@pytest.mark.parametrize("modulation", [0.0, 2.0])
def test_light_of_a_tilt_goes_to_the_images_on_its_side(modulation):
    sensor = sensor_on(NARROW, modulation_lambda_over_d=modulation)
    grid_y, grid_x = np.broadcast_arrays(NARROW.y_m, NARROW.x_m)
    tilt = 0.3 * WAVELENGTH_M / 8.0
    x_up = np.asarray(sensor.images(jnp.asarray(tilt * grid_x), 1.0).photons).sum((1, 2))
    y_up = np.asarray(sensor.images(jnp.asarray(tilt * grid_y), 1.0).photons).sum((1, 2))
    assert x_up[[1, 3]].min() > 1.1 * x_up[[0, 2]].max()
    assert y_up[[2, 3]].min() > 1.1 * y_up[[0, 1]].max()


def test_a_bump_brightens_its_own_slopes():
    """Geometry of a wide circle: where the path grows along x, image 1 and 3 are brighter; and nothing is mirrored."""
    sensor = sensor_on(NARROW, modulation_lambda_over_d=6.0, modulation_points=48)
    y, x = np.broadcast_arrays(NARROW.y_m, NARROW.x_m)
    bump_m = 1e-7 * np.exp(-((y - 1.6) ** 2 + (x + 1.2) ** 2) / 0.8)  # at +y, -x
    change = np.asarray(
        sensor.images(jnp.asarray(bump_m), 1.0).photons - sensor.images(jnp.zeros(y.shape), 1.0).photons
    )
    along_x = change[1] + change[3] - change[0] - change[2]
    place = (np.arange(24) - 11.5) * 0.4
    brightest = np.unravel_index(np.argmax(along_x), along_x.shape)
    darkest = np.unravel_index(np.argmin(along_x), along_x.shape)
    # Slopes are steepest 0.63 m from the summit; half a pixel is 0.2 m.
    assert place[brightest[0]] == pytest.approx(1.6, abs=0.45)
    assert place[brightest[1]] == pytest.approx(-1.2 - 0.63, abs=0.45)
    assert place[darkest[1]] == pytest.approx(-1.2 + 0.63, abs=0.45)


def test_a_wide_circle_measures_slopes_by_geometry():
    """A tilt t moves the share 4 t / (2 pi r) of the light from one side of the circle to the other, for small t."""
    radius, tilt = 6.0, 0.2  # lambda / D
    sensor = sensor_on(NARROW, modulation_lambda_over_d=radius, modulation_points=64, margin_pixels=10, separation=2)
    opd_m = jnp.asarray(tilt * WAVELENGTH_M / 8 * NARROW.x_m * np.ones((44, 1)))
    light = np.asarray(sensor.images(opd_m, 1.0).photons).sum((1, 2))
    share = (light[[1, 3]].sum() - light[[0, 2]].sum()) / light.sum()
    assert share == pytest.approx(2 * tilt / (np.pi * radius), rel=0.03)  # 3 %: diffraction of 1 / r^2


@pytest.mark.parametrize("cycles", [1, 2, 4, 8, 16])
def test_a_ripple_needs_twice_the_photons_of_the_quantum_limit(cycles):
    """Fixed, flat wavefront, fine pixels and all light: one quadrature of fully mixed light."""
    grid = Grid((96, 96), 8 / 96)
    sensor = sensor_on(grid, pixels=96, margin_pixels=48, separation=2)
    weights = np.asarray(sensor.amplitude) ** 2
    y, x = np.broadcast_arrays(grid.y_m / 8, grid.x_m / 8)
    factors = []
    for angle in (0.0, 0.6):  # along an edge of the prism, and not
        phase = 2 * np.pi * cycles * (x * np.cos(angle) + y * np.sin(angle))
        for mode in (np.cos(phase), np.sin(phase)):
            mode = mode - np.sum(weights * mode)
            seen = jax.jvp(
                lambda opd_m: sensor.images(opd_m, 1.0).photons,
                (jnp.zeros(grid.shape),),
                (RADIAN_M * jnp.asarray(mode),),
            )
            information = np.sum(np.asarray(seen[1]) ** 2 / np.asarray(seen[0]))
            factors.append(4 * np.sum(weights * mode**2) / information)
    assert np.min(factors) > 1.98  # never below 2: rounding of pixels
    assert 2.0 <= np.mean(factors) <= 2.15  # light that is diffracted beyond 0.5 diameter from an image is missed


@pytest.mark.parametrize("modulation", [0.0, 3.0])
def test_the_derivative_is_that_of_finite_differences(modulation):
    sensor, at_m, along_m = sensor_on(ODD, modulation_lambda_over_d=modulation), rough(ODD), rough(ODD, 1.0, seed=1)

    def photons(opd_m):
        return sensor.images(opd_m, 100.0).photons

    exact = np.asarray(jax.jvp(photons, (at_m,), (along_m,))[1])
    step_m = 1e-12
    differences = np.asarray(photons(at_m + step_m * along_m) - photons(at_m - step_m * along_m)) / (2 * step_m)
    np.testing.assert_allclose(exact, differences, atol=1e-5 * abs(exact).max())  # step / wavelength, rounding / step


def test_colours_add_up_and_modulation_is_an_angle():
    colours, shares = (0.7e-6, 1.0e-6), (0.4, 0.6)
    mean_m = 0.4 * 0.7e-6 + 0.6 * 1.0e-6
    both = sensor_on(ODD, spectrum=Spectrum(colours, shares), modulation_lambda_over_d=2.0)
    opd_m, total = rough(ODD), 0
    for colour_m, share in zip(colours, shares, strict=True):
        alone = sensor_on(
            ODD, spectrum=Spectrum.monochromatic(colour_m), modulation_lambda_over_d=2 * mean_m / colour_m
        )
        total = total + share * np.asarray(alone.images(opd_m, 1.0).photons)
    np.testing.assert_allclose(both.images(opd_m, 1.0).photons, total, atol=1e-12)  # rounding


def test_single_precision_is_enough():
    grid = NARROW
    fine = sensor_on(grid, modulation_lambda_over_d=3.0)
    coarse = Pyramid.build(
        PupilShape(8.0).on(grid),
        grid,
        diameter_m=8.0,
        spectrum=fine.spectrum,
        settings=PyramidSettings(pixels=20, margin_pixels=2, modulation_lambda_over_d=3.0),
    )
    opd_m = rough(grid)
    ours = coarse.images(opd_m.astype(jnp.float32), 1.0).photons
    assert ours.dtype == jnp.float32
    wanted = np.asarray(fine.images(opd_m, 1.0).photons)
    np.testing.assert_allclose(ours, wanted, atol=1e-5 * wanted.max())  # 24 bits, sums of a thousand cells


def test_cells_that_are_too_coarse_are_refused():
    with pytest.raises(SamplingError) as refusal:
        sensor_on(Grid((16, 16), 0.5), pixels=32)
    rule = "must be at most that of a detector pixel, 0.25 m, got 0.5"
    assert str(refusal.value) == f"pyramid.grid.pixel_m: {rule}"
    with pytest.raises(SamplingError) as refusal:
        sensor_on(Grid((16, 16), 0.5), pixels=8, modulation_lambda_over_d=5.0, modulation_points=40)
    rule = "must be at most 4 on cells of 0.5 m, got 5.0"
    assert str(refusal.value) == f"pyramid.modulation_lambda_over_d: {rule}"


@pytest.mark.parametrize(
    "change",
    [
        {"modulation_lambda_over_d": -1.0},
        {"modulation_points": 6},
        {"modulation_points": 0},
        {"pixels": 1},
        {"separation": 0.9},
        {"pixels": 20, "margin_pixels": 6},
        {"facets": 3},
    ],
)
def test_impossible_settings_are_refused(change):
    with pytest.raises(ValidationError):
        PyramidSettings(**change)
