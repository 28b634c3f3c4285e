"""From slopes to modes: turbulence without noise, tilt, noise, and two ways to one interaction matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, lenslet_grid
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.slopes_to_modes import (
    average_gradients,
    diffractive_response,
    minimum_variance,
    response,
    truncated_inverse,
)
from nlcwfs.estimation.spot_centroids import centre_of_gravity, matched_filter
from nlcwfs.estimation.spot_model import SpotModel

WAVELENGTH_M, DIAMETER_M, ACROSS = 0.85e-6, 8.0, 12
AIR = Turbulence.from_rms(opd_rms_m=80e-9, diameter_m=DIAMETER_M)  # weak: spots stay whole, slopes linear
CONTROLLED = 40


@pytest.fixture(scope="module")
def bench():
    settings = ShackHartmannSettings(subapertures=ACROSS)
    grid = lenslet_grid(settings, diameter_m=DIAMETER_M, fried_m=AIR.fried_at(WAVELENGTH_M))
    pupil = PupilShape(DIAMETER_M).on(grid)
    spectrum = Spectrum.monochromatic(WAVELENGTH_M)
    sensor = ShackHartmann.build(
        pupil, grid, diameter_m=DIAMETER_M, spectrum=spectrum, settings=settings, dtype="float64"
    )
    basis = modal_basis(pupil, grid, diameter_m=DIAMETER_M, count=160)
    prior = basis.kolmogorov_rad2 * (DIAMETER_M / AIR.fried_at(WAVELENGTH_M)) ** (5 / 3)
    return sensor, grid, basis, prior * (WAVELENGTH_M / (2 * np.pi)) ** 2


def screens(grid, count):
    draw = PhaseScreens.build(AIR, shape=grid.shape, pixel_m=grid.pixel_m, dtype="float64")
    return [draw.draw(jax.random.key(number)) for number in range(count)]


def test_cells_pushed_one_by_one_are_modes_pushed_whole(bench):
    """The adjoint against pushing and pulling each mode through the optics."""
    sensor, grid, basis, _ = bench
    spots = matched_filter(SpotModel.of_sensor(sensor))
    at_m = 30e-9 * screens(grid, 1)[0] / 80e-9
    kernels = diffractive_response(sensor, spots, at_m)
    found = response(sensor, kernels, basis.modes[[0, 7, 60]])
    for column, mode in zip(found.T, basis.modes[[0, 7, 60]], strict=True):
        push = [spots.measure(sensor.images(at_m + sign * 1e-10 * mode, 1.0).photons).slope for sign in (1, -1)]
        exact = np.asarray((push[0] - push[1]) / 2e-10).ravel()
        np.testing.assert_allclose(column, exact, atol=1e-5 * abs(exact).max())


def test_geometry_and_optics_agree_for_a_centre_of_gravity(bench):
    sensor, grid, basis, _ = bench
    spots = centre_of_gravity(SpotModel.of_sensor(sensor))
    optics = response(sensor, diffractive_response(sensor, spots, jnp.zeros(grid.shape)), basis.modes[:CONTROLLED])
    geometry = response(sensor, average_gradients(sensor), basis.modes[:CONTROLLED])
    lit = np.repeat(np.asarray(sensor.amplitude).min((1, 2)) > 0.999 * np.asarray(sensor.amplitude).max(), 2)
    for one, other in zip(optics.T, geometry.T, strict=True):
        # Light beyond the field is cut: a few percent of the mean gradient of curved wavefronts.
        assert np.linalg.norm((one - other)[lit]) < 0.06 * np.linalg.norm(other[lit])


def test_geometry_is_the_slope_of_a_plane_on_every_spot(bench):
    sensor, grid, _, _ = bench
    planes = np.stack([grid.y_m * np.ones(grid.shape), grid.x_m * np.ones(grid.shape)])
    found = response(sensor, average_gradients(sensor), planes).reshape(sensor.count, 2, 2)
    np.testing.assert_allclose(found, np.tile(np.eye(2), (sensor.count, 1, 1)), atol=1e-10)


def left_of(bench, reconstructor, spots, opd_m):
    """Squared rms left by the sensor's modes, and by the best fit of as many."""
    sensor, _, basis, _ = bench
    found = np.asarray(reconstructor.coefficients_m(spots.measure(sensor.images(opd_m, 1.0).photons)))
    weights = np.asarray(basis.weights)
    truth = np.asarray(basis.project(opd_m))[: len(found)]
    mean = np.sum(weights * np.asarray(opd_m))
    total = np.sum(weights * (np.asarray(opd_m) - mean) ** 2)
    fit = total - np.sum(truth**2)
    return fit + np.sum((found - truth) ** 2), fit


def test_a_screen_without_noise_comes_back_within_fitting_and_aliasing(bench):
    """Aliasing of a Shack-Hartmann sensor is 0.08 (d / r0)^(5/3) rad^2, a third of its fitting error (Rigaut 1998)."""
    sensor, grid, basis, prior = bench
    spots = centre_of_gravity(SpotModel.of_sensor(sensor))
    interaction = response(sensor, average_gradients(sensor), basis.modes)
    noise = np.full(2 * sensor.count, (0.02 * WAVELENGTH_M / sensor.subaperture_m) ** 2)
    best = minimum_variance(interaction, prior_m2=prior, noise_rad2=noise * 1e-2, keep=CONTROLLED)
    plain = truncated_inverse(interaction[:, :CONTROLLED])
    results = {"best": [], "plain": []}
    for opd_m in screens(grid, 6):
        results["best"].append(left_of(bench, best, spots, opd_m))
        results["plain"].append(left_of(bench, plain, spots, opd_m))
    ratio = {name: np.sum(parts, axis=0)[0] / np.sum(parts, axis=0)[1] for name, parts in results.items()}
    assert 1 < ratio["best"] < 1.15  # modes beyond the controlled ones are known to alias
    assert ratio["best"] < ratio["plain"] < 1.35


def test_tilt_comes_back_whole(bench):
    """A ridge on unscaled modes would take it."""
    sensor, grid, basis, prior = bench
    spots = centre_of_gravity(SpotModel.of_sensor(sensor))
    interaction = response(sensor, average_gradients(sensor), basis.modes)
    noise = np.asarray(spots.variance(sensor.images(jnp.zeros(grid.shape), 1e6).photons)).ravel()
    found = minimum_variance(interaction, prior_m2=prior, noise_rad2=noise, keep=CONTROLLED)
    slope = 0.2 * WAVELENGTH_M / sensor.subaperture_m
    opd_m = jnp.asarray(slope * (grid.y_m - 2 * grid.x_m) * np.ones(grid.shape))
    truth = np.asarray(basis.project(opd_m))[:CONTROLLED]
    got = np.asarray(found.coefficients_m(spots.measure(sensor.images(opd_m, 1e6).photons)))
    # The window cuts more of a wing on one side, 3 % at 0.4 lambda / d; the prior holds back 0.1 % at 1e6 photons.
    assert np.linalg.norm(got - truth) < 0.05 * np.linalg.norm(truth)


def test_the_error_under_noise_is_what_the_matrix_says(bench):
    sensor, grid, basis, prior = bench
    mean = sensor.images(jnp.zeros(grid.shape), 2e4).photons
    spots = matched_filter(SpotModel.of_sensor(sensor))
    noise = np.asarray(spots.variance(mean)).ravel()
    interaction = response(sensor, average_gradients(sensor), basis.modes)
    found = minimum_variance(interaction, prior_m2=prior, noise_rad2=noise, keep=CONTROLLED)
    said = np.sum(np.asarray(found.matrix) ** 2 * noise, axis=1)
    keys = jax.random.split(jax.random.key(2), 100)
    draw = jax.jit(lambda key: found.coefficients_m(spots.measure(jax.random.poisson(key, mean).astype(float))))
    drawn = np.array([draw(key) for key in keys])
    # 5 sigma of the mean of forty variances of 100 draws; perfect spots have zeros, where the first order is 10 % off.
    assert drawn.var(axis=0).sum() == pytest.approx(said.sum(), rel=0.2)


def test_minimum_variance_solves_the_normal_equations():
    rng = np.random.default_rng(3)
    interaction, prior, noise = rng.normal(size=(9, 4)), rng.uniform(0.5, 2, 4), rng.uniform(0.1, 1, 9)
    exact = (
        np.diag(prior) @ interaction.T @ np.linalg.inv(interaction @ np.diag(prior) @ interaction.T + np.diag(noise))
    )
    found = minimum_variance(interaction, prior_m2=prior, noise_rad2=noise)
    np.testing.assert_allclose(found.matrix, exact, atol=1e-12)
    kept = minimum_variance(interaction, prior_m2=prior, noise_rad2=noise, keep=2)
    np.testing.assert_allclose(kept.matrix, exact[:2], atol=1e-12)
    np.testing.assert_allclose(truncated_inverse(interaction).matrix @ interaction, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior_m2": np.array([1.0, 0.0])}, r"minimum_variance.prior_m2: must be 2 positive"),
        ({"noise_rad2": np.array([1.0, -1.0, 1.0])}, r"minimum_variance.noise_rad2: must be 3 positive"),
    ],
)
def test_impossible_variances_are_refused(change, message):
    given = {"prior_m2": np.ones(2), "noise_rad2": np.ones(3)} | change
    with pytest.raises(SettingsError, match=message):
        minimum_variance(np.ones((3, 2)), **given)
    with pytest.raises(SettingsError, match="least_singular: must be between 0 and 1, got 1"):
        truncated_inverse(np.ones((3, 2)), least_singular=1.0)
