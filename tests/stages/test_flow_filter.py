"""Kalman's filter: covariances against plain iteration, light against differences, its prior against algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation.flow_filter import Flow, FlowFilter, Still, modal_information, settled_sum
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.modal_prior import ModalPrior
from nlcwfs.estimation.moving_modes import Step
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.whitened_phase import Unknown

MODES = 30


def random_step(rng: np.random.Generator, count: int) -> Step:
    again = 0.95 * np.linalg.qr(rng.standard_normal((count, count)))[0]
    root = rng.standard_normal((count, count)) / 4
    return Step(again, root @ root.T + 0.01 * np.eye(count))


@pytest.mark.parametrize("seed", range(4))
def test_what_stays_is_told_from_what_moves_as_kalman_would(seed):
    """The filter of the sum against a filter of both parts, step by step, on random systems."""
    rng = np.random.default_rng(seed)
    count, few = 6, 3
    step, still = random_step(rng, count), Still(rng.uniform(0.5, 2, few), 0.99)
    seen = rng.standard_normal((count, count))
    information = seen @ seen.T
    covariance, to_still = settled_sum(step, still, information)
    both = np.hstack([np.eye(count), np.eye(count, few)])
    again = np.zeros((count + few, count + few))
    again[:count, :count], again[count:, count:] = step.again, still.kept * np.eye(few)
    new = np.zeros_like(again)
    new[:count, :count], new[count:, count:] = step.new, np.diag(still.variance * (1 - still.kept**2))
    wanted = new.copy()
    for _ in range(3000):
        left = wanted - wanted @ both.T @ np.linalg.solve(
            both @ wanted @ both.T + np.linalg.inv(information), both @ wanted
        )
        wanted = again @ left @ again.T + new
    np.testing.assert_allclose(covariance, both @ wanted @ both.T, rtol=1e-6, atol=1e-8)
    gain = wanted @ both.T @ np.linalg.inv(both @ wanted @ both.T)
    np.testing.assert_allclose(to_still, gain[count:], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(gain[:count] + np.eye(count, few) @ gain[count:], np.eye(count), atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_a_prior_is_its_covariance_and_its_own_transpose(seed):
    rng = np.random.default_rng(seed)
    modes, lit, shape = rng.standard_normal((20, 7)), np.sort(rng.choice(36, 20, replace=False)), (6, 6)
    root = rng.standard_normal((7, 7))
    information = np.diag(rng.uniform(0.1, 3, 7))
    prior = ModalPrior.build(modes, root @ root.T, information, lit, shape)
    kept = np.asarray(prior.root, float)
    np.testing.assert_allclose(kept @ kept.T, root @ root.T, rtol=1e-4, atol=1e-4)
    turned = kept.T @ information @ kept  # each unknown is seen apart from the others
    np.testing.assert_allclose(turned, np.diag(np.asarray(prior.seen)), atol=1e-4 * np.abs(turned).max())
    unknown = Unknown(jnp.asarray(rng.standard_normal(7), jnp.float32), jnp.zeros(2, jnp.float32))
    gradient = jnp.asarray(rng.standard_normal(shape), jnp.float32)
    along = float(jnp.sum(gradient * prior.phase_rad(unknown)))
    assert along == pytest.approx(float(prior.dot(prior.transposed(gradient), unknown)), rel=1e-4)


@pytest.fixture(scope="module")
def sensor():
    geometry = SensorGeometry(PupilShape(2.0), Grid((24, 24), 0.125), 0.85e-6, (-219e3, -156e3, 156e3, 219e3))
    solver = MaximumAPosteriori.build(geometry, EstimationSettings(modes=20, seeing_arcsec=0.6))
    grid = solver.level.grid
    amplitude = np.sqrt(np.asarray(solver.level.light, float))
    return solver, modal_basis(amplitude, grid, diameter_m=2.0, count=MODES)


def problem_of(solver: MaximumAPosteriori, photons: float):
    none = jnp.zeros((4, *solver.level.measured_shape), jnp.float32)
    measured = Measurement(none, jnp.ones(none.shape, bool), jnp.zeros((), jnp.float32))
    counts = jnp.full((4, 1, 1), photons / 4, jnp.float32)
    prior = solver.prior(solver.power, solver.tilt_rms_rad)
    return solver.problem(measured, solver.known_rad(jnp.zeros(2, jnp.float32)), PlaneScale(counts, 0 * counts), prior)


def test_information_is_that_of_differences_of_the_light(sensor):
    solver, basis = sensor
    problem = problem_of(solver, 1e4)
    modes_rad = jnp.asarray(0.2 * np.random.default_rng(0).standard_normal(MODES), jnp.float32)
    phase_rad = problem.known_rad + basis.combine(modes_rad)
    told = modal_information(problem, phase_rad, basis)
    model = np.asarray(problem.expected(phase_rad), float)

    def slope(number: int, by: float = 0.02) -> np.ndarray:
        mode = jnp.asarray(basis.modes[number], jnp.float32)
        ahead, behind = (np.asarray(problem.expected(phase_rad + sign * by * mode), float) for sign in (1, -1))
        return (ahead - behind) / (2 * by)

    slopes = np.stack([slope(number) for number in range(MODES)])
    wanted = np.einsum("kpyx,lpyx,pyx->kl", slopes, slopes, 1 / (model + np.asarray(problem.dark)))
    np.testing.assert_allclose(told, wanted, atol=0.01 * np.abs(wanted).max())
    # no light tells more than the quantum limit, 4 photons for each squared radian of a mode
    assert np.linalg.eigvalsh(told)[-1] < 4 * 1e4


def test_it_errs_by_what_it_expects(sensor):
    """Air that moves as the filter believes, light of the model itself: error over expectation, of 60 frames."""
    solver, basis = sensor
    rng = np.random.default_rng(1)
    variance = np.asarray(basis.kolmogorov_rad2) * 8.0
    kept = 0.995  # a tenth of a radian is new in a frame
    again = kept * np.eye(MODES)
    step = Step(again, np.diag(variance * (1 - kept**2)))
    problem = problem_of(solver, 2e4)
    information = modal_information(problem, problem.known_rad, basis)
    still = Still(1e-6 * np.ones(5), 0.99)
    filtered = FlowFilter.build(solver, basis, step, still, information, beyond_rad2=0.0)
    light = jax.jit(problem.expected)
    follow = jax.jit(
        lambda counts, flow, known: filtered.follow(counts, jnp.ones(counts.shape, bool), flow, known_rad=known)
    )
    air = rng.standard_normal(MODES) * np.sqrt(variance)
    flow = Flow(jnp.asarray(air, jnp.float32), jnp.zeros(5, jnp.float32))
    errors, surprises = [], []
    inner = [slice((a - b) // 2, (a - b) // 2 + b) for a, b in zip(solver.level.measured_shape, (24, 24), strict=True)]
    mirror = air
    for _ in range(60):
        air = again @ air + rng.standard_normal(MODES) * np.sqrt(np.diag(step.new))
        known = -basis.combine(jnp.asarray(mirror, jnp.float32))
        mean = light(problem.known_rad + basis.combine(jnp.asarray(air, jnp.float32)) + known)
        counts = rng.poisson(np.asarray(mean, float))[:, inner[0], inner[1]].astype(np.float32)
        flow, surprise = follow(jnp.asarray(counts), flow, known)
        mirror = again @ np.asarray(flow.whole_rad, float)
        errors.append(np.asarray(flow.whole_rad, float) - air)
        surprises.append(float(surprise))
    rms = np.sqrt(np.mean(np.sum(np.square(errors[5:]), axis=1)))
    assert rms == pytest.approx(filtered.left_rad, rel=0.2)
    assert 0.7 < np.mean(surprises[5:]) < 1.3
