"""Fisher scoring against dense algebra, SciPy's Poisson distribution and finite differences; and its count of FFTs."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.bayesian_unwrapping import unwrapped, unwrapping_ffts
from nlcwfs.estimation.iterate import iterate
from nlcwfs.estimation.ladder import finest_level
from nlcwfs.estimation.resolution_level import Level, Measurement
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import PlaneScale, mean_counts
from nlcwfs.estimation.turn_islands import tearing_ffts, torn_phase
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase

SHAPE = (8, 8)
CELLS = 64
FREEDOM = CELLS + 2  # and two tilts
ENOUGH = 300  # conjugate gradients: many times the degrees of freedom
TILT_RMS_RAD, DIAMETER_M = 0.8, 6.0

rng = np.random.default_rng(2024)


# ----------------------------------------------------- the same unknowns as white noise in pixels, as matrices

FREQUENCY = np.hypot(np.fft.fftfreq(8)[:, None], np.fft.fftfreq(8))
POWER = 0.05 * np.maximum(FREQUENCY, 0.1) ** -2.0


def phase_matrix() -> np.ndarray:
    """From 64 pixels of white noise and two numbers for the tilt to the phase."""
    pixels = np.eye(CELLS).reshape(CELLS, *SHAPE)
    waves = np.fft.ifft2(np.fft.fft2(pixels) * np.sqrt(POWER)).real.reshape(CELLS, CELLS).T
    along = np.broadcast_to(np.arange(8) - 3.5, SHAPE)
    tilts = [2 * TILT_RMS_RAD * part.ravel() / (DIAMETER_M / 2) for part in (along.T, along)]
    return np.column_stack([waves, *tilts])


def as_unknown(white: np.ndarray) -> Unknown:
    """Parseval: the half spectrum of the same white noise."""
    waves = np.fft.fft2(white[:CELLS].reshape(SHAPE))[:, :5] / 8
    return Unknown(jnp.asarray(waves), jnp.asarray(white[CELLS:]))


def prior() -> WhitenedPhase:
    return WhitenedPhase.build(
        Grid(SHAPE, 1.0), jnp.asarray(POWER[:, :5]), tilt_rms_rad=TILT_RMS_RAD, diameter_m=DIAMETER_M
    )


PHASE = phase_matrix()
RESPONSE = rng.normal(0, 3.0, (2 * 30, CELLS))  # counts of two planes of 5 x 6 pixels for each radian of a cell
LIGHT = rng.uniform(40, 80, 60)
KNOWN_RAD = rng.normal(0, 0.1, SHAPE)
DARK = np.array([0.5, 3.0])
TRUTH = rng.normal(0, 0.2, FREEDOM)
COUNTS = rng.poisson(np.maximum(LIGHT + RESPONSE @ (PHASE @ TRUTH + KNOWN_RAD.ravel()), 0.1)).astype(float)
USABLE = rng.uniform(size=60) > 0.15


def linear_problem(expected: Callable | None = None, **changes) -> gn.Problem:
    """Counts that are a straight line of the phase; some pixels are not used and hold nonsense."""
    counts = np.where(USABLE, COUNTS, 1e5)
    given = {
        "expected": lambda phase: jnp.reshape(LIGHT + RESPONSE @ jnp.ravel(phase), (2, 5, 6)),
        "counts": jnp.asarray(counts.reshape(2, 5, 6)),
        "usable": jnp.asarray(USABLE.reshape(2, 5, 6)),
        "dark": jnp.asarray(DARK[:, None, None]),
        "known_rad": jnp.asarray(KNOWN_RAD),
        "prior": prior(),
        "information": jnp.asarray(10.0),
        "shown": Unknown(jnp.ones(()), jnp.ones(2)),
    }
    return gn.Problem(**given | ({"expected": expected} if expected else {}) | changes)


@functools.cache
def dense_step(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Start, solution of the normal equations, and the decrease of the cost that they promise; all in NumPy."""
    start = np.random.default_rng(seed).normal(0, 0.3, FREEDOM)
    mean = LIGHT + RESPONSE @ (PHASE @ start + KNOWN_RAD.ravel())
    weight = USABLE / (mean + np.repeat(DARK, 30))
    slope = RESPONSE @ PHASE
    gradient = slope.T @ (weight * (COUNTS - mean)) - start
    hessian = slope.T @ (weight[:, None] * slope) + np.eye(FREEDOM)
    step = np.linalg.solve(hessian, gradient)
    return start, step, float(gradient @ step) / 2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_step_solves_the_normal_equations(seed):
    start, expected, promised = dense_step(seed)
    problem = linear_problem()
    direction, predicted = jax.jit(lambda unknown: gn.direction_of_step(problem, ENOUGH, unknown))(as_unknown(start))
    np.testing.assert_allclose(problem.prior.phase_rad(direction).ravel(), PHASE @ expected, atol=1e-9)
    np.testing.assert_allclose(direction.slope, expected[CELLS:], atol=1e-9)
    assert float(predicted) == pytest.approx(promised, rel=1e-9)


def test_few_conjugate_gradients_promise_less_and_go_the_same_way():
    """Each one more brings the step nearer in the norm of the curvature (Hestenes & Stiefel 1952, theorem 6:1)."""
    start, _, promised = dense_step(1)
    problem = linear_problem()
    promises = [float(gn.direction_of_step(problem, n, as_unknown(start))[1]) for n in (1, 2, 4, 8, 16)]
    assert np.all(np.diff(promises) > 0)
    assert 0 < promises[0] < 0.9 * promised
    assert promises[-1] == pytest.approx(promised, rel=0.02)


def test_a_flat_preconditioner_only_slows_down():
    """Any positive diagonal leads to the same step."""
    start, expected, _ = dense_step(2)
    for information in (0.0, 1e4):
        problem = linear_problem(information=jnp.asarray(information))
        direction, _ = gn.direction_of_step(problem, ENOUGH, as_unknown(start))
        np.testing.assert_allclose(problem.prior.phase_rad(direction).ravel(), PHASE @ expected, atol=1e-7)


# ----------------------------------------------------------------------------------------------- the cost


def numpy_cost(white: np.ndarray) -> float:
    """By SciPy's distribution function where its argument is whole, and the same formula in between."""
    mean = LIGHT + RESPONSE @ (PHASE @ white + KNOWN_RAD.ravel())
    seen, light = (COUNTS + np.repeat(DARK, 30))[USABLE], (mean + np.repeat(DARK, 30))[USABLE]

    def log_likelihood(rate):
        return scipy.special.xlogy(seen, rate) - rate - scipy.special.gammaln(seen + 1)

    return float(np.sum(log_likelihood(seen) - log_likelihood(light)) + np.sum(white**2) / 2)


def test_the_cost_is_the_negative_logarithm_of_the_posterior():
    problem = linear_problem()
    for seed in (4, 5):
        white = np.random.default_rng(seed).normal(0, 0.3, FREEDOM)
        assert float(gn.cost(problem, as_unknown(white))) == pytest.approx(numpy_cost(white), rel=1e-10)


def test_without_dark_noise_the_deviance_is_poissons():
    counts, mean = rng.poisson(2.0, (2, 5, 6)), rng.uniform(0.5, 5, (2, 5, 6))
    poisson = scipy.stats.poisson
    expected = 2 * np.sum(poisson.logpmf(counts, np.maximum(counts, 1e-300)) - poisson.logpmf(counts, mean))
    problem = linear_problem(
        counts=jnp.asarray(counts * 1.0), usable=jnp.ones((2, 5, 6), bool), dark=jnp.full((2, 1, 1), 1e-300)
    )
    assert np.any(counts == 0)
    assert float(gn.deviance(problem, jnp.asarray(mean))) == pytest.approx(expected, rel=1e-10)


def test_the_step_promises_what_the_slope_of_the_cost_promises():
    """Along a step d the cost falls at the rate g.d, twice the promise: central differences of the cost in NumPy."""
    start, step, _ = dense_step(3)
    _, predicted = gn.direction_of_step(linear_problem(), ENOUGH, as_unknown(start))
    size = 1e-5
    rate = (numpy_cost(start + size * step) - numpy_cost(start - size * step)) / (2 * size)
    assert rate == pytest.approx(-2 * float(predicted), rel=1e-5)


# -------------------------------------------------------------------------------------- the sensor itself

DISTANCES_M = (-2.2e6, 1.5e6, 3.1e6)


@functools.cache
def level(oversampling: int = 1, planes: int = 3, moments: int = 1) -> Level:
    pupil, moving = PupilShape(8.0, obstruction_ratio=0.2), {"motion": "sine", "moments": moments}
    geometry = SensorGeometry(pupil, Grid((20, 22), 0.5), 0.65e-6, DISTANCES_M[:planes], **moving)
    return finest_level(geometry, Turbulence(1.0), oversampling=oversampling, window=1.2, dtype="float64")


def sensor_problem(optics: Level, *, strength: float = 1.0, truth_rad=0.0, known_rad=0.0) -> gn.Problem:
    """A sensor's counts of a phase, without noise; the prior knows nothing of it."""
    rows, columns = optics.grid.shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns))
    power = strength * 0.02 * np.maximum(frequency, 0.05) ** (-11 / 3)
    flat = jnp.zeros(optics.grid.shape)
    planes = optics.optics.transfer.shape[1]
    scale = PlaneScale(jnp.full((planes, 1, 1), 1e4), jnp.zeros((planes, 1, 1)))
    counts = mean_counts(optics, scale, flat + truth_rad)
    return gn.Problem(
        expected=lambda phase_rad: mean_counts(optics, scale, phase_rad),
        counts=counts,
        usable=jnp.ones(counts.shape, bool),
        dark=jnp.full((planes, 1, 1), 1e-2),
        known_rad=flat + known_rad,
        prior=WhitenedPhase.build(optics.grid, jnp.asarray(power), tilt_rms_rad=1.0, diameter_m=8.0),
        information=jnp.asarray(40.0),
        shown=Unknown(jnp.ones(()), jnp.ones(2)),
    )


def test_near_the_solution_every_step_doubles_the_digits():
    """A perfect fit: what is left of the model's bend is the square of the error. The prior's mean is the truth."""
    optics = level()
    y, x = np.broadcast_arrays(optics.grid.y_m / 4, optics.grid.x_m / 4)
    truth_rad = 1.2 * x * y + 0.6 * x**2 - 0.4 * y**3
    problem = sensor_problem(optics, truth_rad=truth_rad, known_rad=truth_rad, strength=0.003)
    rough = np.random.default_rng(6).normal(size=optics.grid.shape)
    radius = np.hypot(20 * np.fft.fftfreq(20)[:, None], np.arange(12))
    waves = 0.3 * np.fft.rfft2(rough, norm="ortho") * np.exp(-((radius / 4) ** 2))
    state = gn.init(problem, Unknown(jnp.asarray(waves), jnp.asarray([0.02, -0.03])))
    step = jax.jit(lambda state: gn.step(problem, 100, state))
    errors = []
    for _ in range(4):
        errors.append(float(jnp.sqrt(problem.prior.dot(state.unknown, state.unknown))))
        state = step(state)
    errors = np.array(errors)
    assert errors[0] > 1
    assert np.all(errors[1:] < 0.2 * errors[:-1] ** 2)  # measured 0.01 to 0.11: the bend of this light
    assert errors[-1] < 1e-9


def test_iterations_end_as_soon_as_a_step_promises_little():
    optics = level()
    y, x = np.broadcast_arrays(optics.grid.y_m / 4, optics.grid.x_m / 4)
    problem = sensor_problem(optics, truth_rad=0.5 * x * y + 0.3 * x**3)
    tolerance = jnp.asarray(0.05)
    step = jax.jit(lambda state: gn.step(problem, 12, state))
    promises, state = [], gn.init(problem, problem.prior.nothing())
    while not bool(gn.terminate(state, steps=50, tolerance=tolerance)):
        state = step(state)
        promises.append(float(state.predicted))
    assert 2 <= len(promises) < 20
    assert all(promise >= 0.05 for promise in promises[:-1])
    assert promises[-1] < 0.05
    together = jax.jit(
        lambda state: iterate(
            lambda state: gn.step(problem, 12, state),
            lambda state: gn.terminate(state, steps=50, tolerance=tolerance),
            state,
        )
    )(gn.init(problem, problem.prior.nothing()))
    assert int(together.iteration) == len(promises)


def test_iterations_end_when_used_up_or_when_nothing_helps():
    problem = linear_problem()
    state = gn.step(problem, 3, gn.init(problem, as_unknown(np.zeros(FREEDOM))))
    ends = {"steps": 9, "tolerance": jnp.asarray(0.0)}
    assert not bool(gn.terminate(state, **ends))
    assert bool(gn.terminate(state, **ends | {"steps": 1}))
    failed = eqx.tree_at(lambda one: one.accepted, state, jnp.asarray(False))
    assert bool(gn.terminate(failed, **ends))


# ----------------------------------------------------------------------------------- steps that are too long


def bent(phase):
    """Counts that grow with the square of the phase: from near zero, the straight line shoots far beyond."""
    return jnp.reshape(20 + 30 * jnp.ravel(phase)[:60] ** 2, (2, 5, 6))


def bent_problem() -> gn.Problem:
    return linear_problem(
        bent,
        counts=bent(jnp.full(SHAPE, 1.0)),
        usable=jnp.ones((2, 5, 6), bool),
        known_rad=jnp.full(SHAPE, 0.15),
        prior=WhitenedPhase.build(Grid(SHAPE, 1.0), jnp.full((8, 5), 4.0), tilt_rms_rad=0.01, diameter_m=8.0),
    )


def test_a_step_that_goes_too_far_is_shortened_until_the_fit_is_better():
    problem = bent_problem()
    start = problem.prior.nothing()
    direction, _ = gn.direction_of_step(problem, ENOUGH, start)
    costs = [float(gn.cost(problem, gn.plus(start, direction, 0.4**n))) for n in range(4)]
    first = float(gn.cost(problem, start))
    shortened = next(n for n, cost in enumerate(costs) if cost < first)
    assert shortened > 0  # else nothing is tested
    state = gn.step(problem, ENOUGH, gn.init(problem, start))
    assert bool(state.accepted)
    assert int(state.tries) == 1 + shortened + 1
    assert float(state.cost) == pytest.approx(costs[shortened], rel=1e-12)
    expected = problem.prior.phase_rad(direction) * 0.4**shortened
    np.testing.assert_allclose(problem.prior.phase_rad(state.unknown), expected, atol=1e-12)


@jax.custom_jvp
def lie(phase):
    return jnp.reshape(LIGHT + RESPONSE @ jnp.ravel(phase), (2, 5, 6))


@lie.defjvp
def _lie(primals, tangents):
    return lie(primals[0]), -jnp.reshape(RESPONSE @ jnp.ravel(tangents[0]), (2, 5, 6))


def test_a_step_that_helps_at_no_length_is_given_up():
    """The model tells the opposite of its slope: every step leads uphill."""
    problem = linear_problem(lie)
    start = as_unknown(np.zeros(FREEDOM))
    before = gn.init(problem, start)
    after = gn.step(problem, 40, before)
    assert not bool(after.accepted)
    assert int(after.tries) == 1 + 1 + gn.BACKTRACKS
    assert float(after.cost) == float(before.cost)
    np.testing.assert_array_equal(after.unknown.waves, start.waves)
    np.testing.assert_array_equal(after.unknown.slope, start.slope)
    assert bool(gn.terminate(after, steps=99, tolerance=jnp.asarray(0.0)))


# ------------------------------------------------------------------------------------------- count of FFTs


def ffts_in(jaxpr) -> float:
    """Two-dimensional complex FFTs in a program, those of loops as often as they run; a real one is half."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "fft":
            real = "RFFT" in equation.params["fft_type"].name
            total += np.prod(equation.invars[0].aval.shape[:-2], dtype=float) * (0.5 if real else 1.0)
        assert equation.primitive.name != "while"  # nobody knows how often it runs
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                total += times * ffts_in(inner) if hasattr(inner, "eqns") else 0
    return total


@pytest.mark.parametrize("planes", [1, 3])
@pytest.mark.parametrize("inner", [1, 5])
def test_the_count_of_a_step_is_what_the_program_holds(planes, inner):
    problem = sensor_problem(level(2, planes))
    program = jax.make_jaxpr(lambda unknown: gn.direction_of_step(problem, inner, unknown))(problem.prior.nothing())
    assert ffts_in(program.jaxpr) == gn.ffts_per_step(planes, inner)


@pytest.mark.parametrize("planes", [1, 3])
def test_the_count_of_a_try_is_that_of_the_cost_rounded_up(planes):
    problem = sensor_problem(level(2, planes))
    program = jax.make_jaxpr(lambda unknown: gn.cost(problem, unknown))(problem.prior.nothing())
    assert np.ceil(ffts_in(program.jaxpr)) == gn.ffts_per_try(planes)


@pytest.mark.parametrize("planes", [1, 3])
@pytest.mark.parametrize("iterations", [1, 7])
@pytest.mark.parametrize("moments", [1, 5])
def test_the_count_of_tearing_is_what_the_program_holds(planes, iterations, moments):
    optics = level(2, planes, moments)
    counts = jnp.ones((planes, *optics.measured_shape))
    measured = Measurement(counts, jnp.ones(counts.shape, bool), jnp.asarray(0.0))
    scale = PlaneScale(jnp.ones((planes, 1, 1)), jnp.zeros((planes, 1, 1)))
    program = jax.make_jaxpr(lambda phase: torn_phase(optics, measured, scale, phase, iterations=iterations, gain=1.0))(
        jnp.zeros(optics.grid.shape)
    )
    assert ffts_in(program.jaxpr) == tearing_ffts(planes, iterations, moments=moments)


@pytest.mark.parametrize("inner", [2, 8])
@pytest.mark.parametrize("rounds", [1, 3])
def test_the_count_of_unwrapping_is_what_the_program_holds(rounds, inner):
    lit = jnp.ones(SHAPE, bool)
    program = jax.make_jaxpr(lambda phase: unwrapped(phase, lit, prior(), rounds=rounds, inner=inner))(jnp.zeros(SHAPE))
    assert ffts_in(program.jaxpr) == unwrapping_ffts(rounds=rounds, inner=inner)
