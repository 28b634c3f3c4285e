"""Spots of a Shack-Hartmann sensor against closed forms and direct sums, and the noise of every centroid."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann
from nlcwfs.detector.sparse_photons import room_for_photons, sample_sparse_photons
from nlcwfs.estimation.spot_centroids import centre_of_gravity, matched_filter, weighted_centre_of_gravity
from nlcwfs.estimation.spot_model import MeanSpot, SpotModel

WAVELENGTH_M = 0.85e-6


def sensor_with(*, pixels=64, field=8.0, cells=16, subapertures=4, ratio=0.0, spectrum=None) -> ShackHartmann:
    across = cells * subapertures
    grid = Grid((across + 2, across + 4), 8.0 / across)  # wider than the lattice, not square
    return ShackHartmann.build(
        PupilShape(8.0, obstruction_ratio=ratio).on(grid),
        grid,
        diameter_m=8.0,
        spectrum=spectrum or Spectrum.monochromatic(WAVELENGTH_M),
        settings=ShackHartmannSettings(subapertures=subapertures, pixels=pixels, field_lambda_over_d=field),
        dtype="float64",
    )


def wavefront(sensor: ShackHartmann, *, y=0.0, x=0.0, rough_m=0.0, seed=0) -> jnp.ndarray:
    across = sensor.subapertures * sensor.amplitude.shape[1]
    grid = Grid((across + 2, across + 4), sensor.cell_m)
    noise = np.random.default_rng(seed).normal(size=grid.shape)
    return jnp.asarray(y * grid.y_m + x * grid.x_m + rough_m * noise)


def full(sensor: ShackHartmann) -> int:
    """A subaperture without rim."""
    return int(np.argmax(np.asarray(sensor.amplitude).min(axis=(1, 2))))


def angles(sensor: ShackHartmann, pixels: int) -> np.ndarray:
    """Of the pixels, in lambda / d."""
    return (np.arange(pixels) - (pixels - 1) / 2) * sensor.pixel_rad / (WAVELENGTH_M / sensor.subaperture_m)


def test_an_unaberrated_spot_is_the_sinc_squared_of_its_lenslet():
    sensor = sensor_with()
    photons = 1e4
    spot = np.asarray(sensor.images(wavefront(sensor), photons).photons)[full(sensor)]
    u = angles(sensor, 64)
    on_it = photons * float((sensor.amplitude[full(sensor)] ** 2).sum())
    exact = on_it * (8 / 64) ** 2 * np.sinc(u)[:, None] ** 2 * np.sinc(u)[None, :] ** 2
    np.testing.assert_allclose(spot, exact, atol=1e-10 * exact.max())  # cells carry their own sinc: rounding only


@pytest.mark.parametrize("pixels", [6, 16])
def test_wide_pixels_collect_the_light_over_their_area(pixels):
    sensor = sensor_with(pixels=pixels)
    spot = np.asarray(sensor.images(wavefront(sensor), 1.0).photons)[full(sensor)]
    edges = np.linspace(-4, 4, pixels + 1)
    line = np.array([quad(lambda a: np.sinc(a) ** 2, *pair)[0] for pair in pairwise(edges)])
    exact = np.outer(line, line) * float((sensor.amplitude[full(sensor)] ** 2).sum())
    # Eight samples per lambda / d: each stands for its area to 2 (1/8)^2 / 24 times the curvature, 0.9 % of the peak.
    np.testing.assert_allclose(spot, exact, atol=0.012 * exact.max())


def test_an_image_is_the_direct_sum_over_the_cells():
    """Amplitude, sign and order of the axes, for a wavefront without symmetry and light on the rim."""
    sensor = sensor_with(pixels=40, field=5.0, cells=9, ratio=0.3)
    opd_m = wavefront(sensor, y=2e-8, x=-5e-8, rough_m=7e-8)
    spots = np.asarray(sensor.images(opd_m, 100.0).photons)
    pupil = PupilShape(8.0, obstruction_ratio=0.3).on(Grid((38, 40), 8.0 / 36))
    theta = (np.arange(40) - 19.5) * sensor.pixel_rad
    for number, (row, column) in enumerate(np.asarray(sensor.places)):
        part = slice(1 + 9 * row, 10 + 9 * row), slice(2 + 9 * column, 11 + 9 * column)
        field = pupil[part] * np.exp(2j * np.pi / WAVELENGTH_M * np.asarray(opd_m)[part])
        place = (np.arange(9) - 4) * sensor.cell_m
        kernel = (
            np.exp(-2j * np.pi / WAVELENGTH_M * theta[:, None] * place)
            * np.sinc(sensor.cell_m * theta / WAVELENGTH_M)[:, None]
        )
        far = np.einsum("vy,yx,ux->vu", kernel, field, kernel) * sensor.cell_m * sensor.pixel_rad / WAVELENGTH_M
        exact = 100 * abs(far) ** 2 / (pupil**2).sum()
        np.testing.assert_allclose(spots[number], exact, atol=1e-12 * exact.max() + 1e-15)


def test_photons_that_are_not_outside_the_field_are_on_the_pixels():
    photons = 3e4
    for field in (8.0, 16.0):
        sensor = sensor_with(field=field, pixels=int(8 * field), cells=int(2 * field))
        spots = sensor.images(wavefront(sensor), photons)
        seen = quad(lambda a: np.sinc(a) ** 2, -field / 2, field / 2, limit=200)[0] ** 2
        outside = np.asarray(sensor.fraction_outside_field(spots, photons))
        # 1e-4: the sum over samples of lambda / 8d against the integral, at the edges of the window.
        assert outside[full(sensor)] == pytest.approx(1 - seen, abs=1e-4)
        assert float(spots.photons.sum()) == pytest.approx(
            photons * sensor.light_share * (1 - outside.mean()), rel=0.01
        )
        pupil = PupilShape(8.0).on(Grid((sensor.subapertures * int(2 * field),) * 2, sensor.cell_m)) ** 2
        lattice = pupil.reshape(4, int(2 * field), 4, int(2 * field)).sum(axis=(1, 3)) / pupil.sum()
        assert sensor.light_share == pytest.approx(lattice[sensor.active].sum(), rel=1e-12)


def test_a_rough_wavefront_loses_no_photon_but_those_beyond_a_wide_field():
    sensor = sensor_with(field=30.0, pixels=120, cells=48)
    opd_m = wavefront(sensor, rough_m=0.0, y=1e-7) + 1e-7 * jnp.sin(9 * wavefront(sensor, x=1.0))
    total = float(sensor.images(opd_m, 1.0).photons.sum())
    # 2 / (pi^2 15): the wings of a square lenslet beyond 15 lambda / d on both axes.
    assert total == pytest.approx(sensor.light_share * (1 - 2 / (np.pi**2 * 15)), rel=0.005)


def test_two_colours_are_the_sum_of_each():
    both = Spectrum((0.8e-6, 0.9e-6), (0.25, 0.75))
    sensor = sensor_with(spectrum=both, pixels=72)
    opd_m = wavefront(sensor, x=3e-7, rough_m=2e-8)
    parts = []
    for one, share in ((0.8e-6, 0.25), (0.9e-6, 0.75)):
        mean_m = 0.25 * 0.8e-6 + 0.75 * 0.9e-6
        alone = sensor_with(pixels=72, spectrum=Spectrum.monochromatic(one), field=8 * mean_m / one)
        assert alone.pixel_rad == pytest.approx(sensor.pixel_rad)
        parts.append(share * np.asarray(alone.images(opd_m, 1.0).photons))
    np.testing.assert_allclose(sensor.images(opd_m, 1.0).photons, sum(parts), rtol=1e-9, atol=1e-15)


# ---------------------------------------------------------------------------------------------- centroids


def filters(sensor: ShackHartmann) -> dict:
    model = SpotModel.of_sensor(sensor)
    return {
        "gravity": centre_of_gravity(model),
        "thresholded": centre_of_gravity(model, threshold=0.02),
        "weighted": weighted_centre_of_gravity(model, fwhm_rad=1.5 * WAVELENGTH_M / sensor.subaperture_m),
        "matched": matched_filter(model),
    }


@pytest.mark.parametrize("axis", [0, 1])
def test_the_light_moves_to_where_the_path_grows_by_the_angle_of_the_slope(axis):
    """The raw centre of gravity in a wide field, nothing calibrated."""
    sensor = sensor_with(field=24.0, pixels=120, cells=48)
    slope = 10 * sensor.pixel_rad
    tilted = wavefront(sensor, **{"yx"[axis]: slope})
    spot = np.asarray(sensor.images(tilted, 1.0).photons)[full(sensor)]
    theta = (np.arange(120) - 59.5) * sensor.pixel_rad
    moved = [np.sum(spot.sum(1) * theta) / spot.sum(), np.sum(spot.sum(0) * theta) / spot.sum()]
    assert moved[axis] == pytest.approx(slope, rel=0.03)  # wings cut more on one side; cells attenuate 2 of 48
    assert abs(moved[1 - axis]) < 1e-6 * slope


@pytest.mark.parametrize("kind", ["gravity", "thresholded", "weighted", "matched"])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilt_of_one_pixel_is_measured_as_one_pixel(kind, axis):
    sensor = sensor_with(cells=16)
    found = filters(sensor)[kind].measure(
        sensor.images(wavefront(sensor, **{"yx"[axis]: sensor.pixel_rad}), 55.0).photons
    )
    slope = np.asarray(found.slope) / sensor.pixel_rad
    # A pixel is lambda / 8d, where the third order of a filter of the spot's width is 2 %.
    np.testing.assert_allclose(slope[:, axis], 1, atol=0.04)
    # Half-lit subapertures on the rim have slanted spots, of which a Gaussian weight sees the slant.
    np.testing.assert_allclose(slope[:, 1 - axis], 0, atol=0.05)
    assert abs(slope[full(sensor), 1 - axis]) < 1e-3
    back = filters(sensor)[kind].measure(sensor.images(wavefront(sensor), 55.0).photons)
    np.testing.assert_allclose(back.slope, 0, atol=1e-9 * sensor.pixel_rad)  # rims and all


def tilt_noise(sensor, spots, mean, *, draws=3000):
    measure = jax.jit(lambda key: spots.measure(jax.random.poisson(key, mean).astype(mean.dtype)).slope)
    return np.array([measure(key) for key in jax.random.split(jax.random.key(3), draws)])


@pytest.mark.parametrize("kind", ["gravity", "weighted", "matched"])
def test_the_noise_of_a_centroid_is_what_it_says(kind):
    sensor = sensor_with(pixels=24, field=6.0, cells=9, subapertures=2)
    mean = sensor.images(wavefront(sensor), 1600.0).photons
    spots = filters(sensor)[kind]
    drawn = tilt_noise(sensor, spots, mean)
    said = np.asarray(spots.variance(mean))
    # 5 sigma of a variance from 3000 draws: 5 sqrt(2 / 3000) = 13 %; four spots by two axes. Bias: 5 sigma / sqrt(n).
    np.testing.assert_allclose(drawn.var(axis=0) / said, 1, atol=0.13)
    np.testing.assert_array_less(abs(drawn.mean(axis=0)), 5 * np.sqrt(said / 3000))


def test_the_centre_of_gravity_has_the_variance_of_its_closed_form():
    """sum over pixels of angle^2 I / N^2; a sinc^2 in a field of w lambda / d: w / (2 pi^2) on each axis."""
    sensor = sensor_with()
    mean = sensor.images(wavefront(sensor), 1000.0).photons
    said = np.asarray(centre_of_gravity(SpotModel.of_sensor(sensor)).variance(mean))[full(sensor)]
    photons = float(mean[full(sensor)].sum())
    inside = quad(lambda a: np.sinc(a) ** 2, -4, 4)[0]
    unit = (WAVELENGTH_M / sensor.subaperture_m) ** 2
    # 2.5 %: 16 cells take 1 % of the motion (their sinc^2 stays where it is), which the gain gives back with its noise.
    np.testing.assert_allclose(said, 8 / (2 * np.pi**2) / inside * unit / photons, rtol=0.025)


def test_the_matched_filter_reaches_the_cramer_rao_bound():
    sensor = sensor_with(subapertures=2, cells=16)
    slope, photons = 0.3 * WAVELENGTH_M / sensor.subaperture_m, 500.0
    blurred = sum(  # as a loop leaves it: no zeros
        sensor.images(wavefront(sensor, y=y * slope, x=x * slope), photons).photons
        for y in (-1, 0, 1)
        for x in (-1, 0, 1)
    )
    mean = blurred / 9
    spots = matched_filter(SpotModel.of_mean(mean, pixel_rad=sensor.pixel_rad))
    # its own Fisher matrix of (shift y, shift x, brightness), by Fourier shifts
    image = np.asarray(mean)[0]
    shift = 1e-3
    turn = np.exp(-2j * np.pi * np.fft.fftfreq(64) * shift)
    spectrum = np.fft.fft2(image)
    rates = [
        ((np.fft.ifft2(spectrum * turn[:, None]) - np.fft.ifft2(spectrum / turn[:, None])) / (2 * shift)).real,
        ((np.fft.ifft2(spectrum * turn[None, :]) - np.fft.ifft2(spectrum / turn[None, :])) / (2 * shift)).real,
        image,
    ]
    fisher = np.array([[np.sum(a * b / image) for a in rates] for b in rates])
    bound = np.diag(np.linalg.inv(fisher))[:2] * sensor.pixel_rad**2
    # 3 %: differences over five pixels, and pixels fainter than 1e-3 of the brightest are not trusted.
    np.testing.assert_allclose(np.asarray(spots.variance(mean))[0], bound, rtol=0.03)
    plain = np.asarray(centre_of_gravity(SpotModel.of_sensor(sensor)).variance(mean))[0]
    assert np.all(plain > 2 * bound)


def test_read_noise_is_in_the_variance_and_a_threshold_helps_only_there():
    sensor = sensor_with(pixels=16, cells=16, subapertures=2)
    mean = sensor.images(wavefront(sensor), 4000.0).photons
    plain = filters(sensor)["gravity"]
    noise = 1.5
    keys = jax.random.split(jax.random.key(8), 2000)

    @jax.jit
    def both(key):
        photon, amplifier = jax.random.split(key)
        counts = jax.random.poisson(photon, mean).astype(float) + noise * jax.random.normal(amplifier, mean.shape)
        return plain.measure(counts).slope, filters(sensor)["thresholded"].measure(counts).slope

    drawn, cut = (np.array(part) for part in zip(*(both(key) for key in keys), strict=True))
    said = np.asarray(plain.variance(mean, extra_electrons2=noise**2))
    np.testing.assert_allclose(drawn.var(axis=0) / said, 1, atol=5 * np.sqrt(2 / 2000))
    assert cut.var(axis=0).mean() < drawn.var(axis=0).mean()


def test_an_empty_spot_gives_no_slope_and_no_weight():
    sensor = sensor_with()
    mean = sensor.images(wavefront(sensor, x=2e-7), 1e4).photons
    light = jnp.sum(sensor.amplitude**2, (1, 2)) / sensor.light_share
    dark = mean.at[3].set(0.0)
    for spots in filters(sensor).values():
        for found in (spots.measure(dark), spots.measure_faint(dark, light)):
            assert np.all(np.isfinite(found.slope))
            assert found.slope[3].tolist() == [0.0, 0.0]
            assert np.asarray(found.weight).tolist() == [float(k != 3) for k in range(sensor.count)]
        nothing = spots.measure_faint(0 * mean, light)
        assert not np.any(nothing.slope)
        assert not np.any(nothing.weight)


def test_a_filter_for_a_dark_spot_is_no_nan():
    mean = jnp.zeros((2, 8, 8)).at[0, 3:5, 3:6].set(4.0)
    spots = matched_filter(SpotModel.of_mean(mean, pixel_rad=1e-6))
    assert np.all(np.isfinite(spots.along_x))
    found = spots.measure(mean)
    assert found.weight.tolist() == [1.0, 0.0]
    assert np.all(np.isfinite(found.slope))


def test_dividing_by_the_mean_light_is_as_good_for_bright_and_better_for_faint_spots():
    sensor = sensor_with(pixels=16, cells=16)
    light = jnp.sum(sensor.amplitude**2, (1, 2)) / sensor.light_share
    spots = filters(sensor)["weighted"]
    for photons, faint in ((2e5, False), (30.0, True)):
        mean = sensor.images(wavefront(sensor, x=1e-8), photons).photons
        truth = np.asarray(spots.measure(mean).slope)
        errors = [[], []]
        for key in jax.random.split(jax.random.key(5), 300):
            counts = jax.random.poisson(key, mean).astype(float)
            errors[0].append(np.asarray(spots.measure(counts).slope) - truth)
            errors[1].append(np.asarray(spots.measure_faint(counts, light).slope) - truth)
        each, shared = (np.square(part).mean() for part in errors)
        if faint:
            assert shared < 0.8 * each
        else:
            assert shared == pytest.approx(each, rel=0.1)


def test_the_running_mean_spot_is_centred_and_converges_to_the_spot():
    sensor = sensor_with()
    tilted = sensor.images(wavefront(sensor, x=2 * sensor.pixel_rad), 3e4).photons
    mean = MeanSpot(jnp.ones((1, 64, 64)) / 4096, memory=0.8)
    for number in range(40):
        counts = sample_sparse_photons(jax.random.key(number), tilted, room=room_for_photons(3e4))
        mean = mean.updated(counts)
    shape = np.asarray(mean.shape[0])
    np.testing.assert_allclose(shape, shape[::-1, ::-1], atol=1e-15)
    assert shape.sum() == pytest.approx(1, abs=1e-9)
    exact = np.asarray(tilted).sum(0) / float(tilted.sum())
    exact = (exact + exact[:, ::-1]) / 2
    # nine frames' worth of photons, four copies: a percent of the brightest pixels
    assert abs(shape - exact).max() < 0.08 * exact.max()
    assert np.array_equal(mean.updated(0 * counts).shape, mean.shape)
