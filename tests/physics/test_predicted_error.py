"""The error bar and the count of FFTs that come with every wavefront."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation import gerchberg_saxton as gs
from nlcwfs.estimation.reconstructor import GerchbergSaxton
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings, GerchbergSaxtonSettings
from nlcwfs.estimation.turbulence_filter import expected_error


@pytest.mark.parametrize("shape", [(24, 27), (21, 32)])
@pytest.mark.parametrize("noise_variance", [0.01, 1.0])
def test_the_predicted_error_is_that_of_a_linear_gaussian_measurement(shape, noise_variance):
    """Monte Carlo: a Gaussian phase, white noise on it, the best linear estimate, what is left without piston."""
    rng = np.random.default_rng(3)
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]
    power = 3e-4 * np.maximum(np.hypot(fy, fx), 0.02) ** (-11 / 3)
    left = []
    for _ in range(300):
        phase = np.fft.fft2(rng.normal(size=shape)) * np.sqrt(power)
        noise = np.fft.fft2(rng.normal(0, np.sqrt(noise_variance), shape))
        error = np.fft.ifft2((phase + noise) * power / (power + noise_variance) - phase).real
        left.append(np.var(error))
    half = jnp.asarray(power[:, : shape[1] // 2 + 1])
    predicted = float(expected_error(half, jnp.asarray(noise_variance), Grid(shape, 0.2)))
    spread = np.std(left) / np.sqrt(len(left)) / np.mean(left)  # relative, of the mean variance
    assert predicted**2 == pytest.approx(np.mean(left), rel=5 * spread)
    assert spread < 0.02


def sensor(**options) -> GerchbergSaxton:
    geometry = SensorGeometry(PupilShape(8.0), Grid((32, 32), 0.36), 0.65e-6, (-3.5e6, -2.5e6, 3.0e6))
    return GerchbergSaxton.build(geometry, EstimationSettings(gerchberg_saxton=GerchbergSaxtonSettings(**options)))


def ffts_in(jaxpr) -> float:
    """Two-dimensional complex FFTs in a program, those of loops as often as they run; a real one is half."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "fft":
            shape = equation.invars[0].aval.shape
            real = "RFFT" in equation.params["fft_type"].name
            assert len(equation.params["fft_lengths"]) == 2
            total += np.prod(shape[:-2], dtype=float) * (0.5 if real else 1.0)
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns") and equation.primitive.name != "while":
                    total += times * ffts_in(inner)
    return total


@pytest.mark.parametrize("scheme", ["averaged", "serial"])
@pytest.mark.parametrize("kind", ["turbulence", "low-pass", "none"])
@pytest.mark.parametrize("which", [0, -1])
def test_the_count_of_ffts_is_what_the_program_holds(scheme, kind, which):
    solver = sensor(scheme=scheme, filter=kind)
    level, options = solver.levels[which], solver.settings.gerchberg_saxton
    shape = (3, *level.measured_shape)
    measured = Measurement(jnp.ones(shape, "float32"), jnp.ones(shape, bool), jnp.asarray(0, "float32"))
    flat, one = jnp.zeros(level.grid.shape, "float32"), jnp.asarray(1, "float32")
    problem = gs.problem_at(level, measured, options, flat, jnp.asarray(0), one, jnp.ones(level.grid.shape, "float32"))
    program = jax.make_jaxpr(lambda phase: gs.step(problem, options, gs.init(phase)).phase_rad)(flat)
    blurs = level.structures is not None
    assert ffts_in(program.jaxpr) == gs.ffts_per_iteration(3, options, blurs=blurs)


def test_the_whole_count_adds_what_is_outside_the_iterations():
    solver = sensor(iterations=7, tolerance_rad=0.0, coarse_iterations=5)
    usable = jnp.ones((3, 32, 32), bool)
    program = jax.make_jaxpr(lambda counts: solver.estimate(counts, usable).opd_m)(jnp.ones((3, 32, 32), "float32"))
    estimate = eqx.filter_jit(solver.estimate)(jnp.ones((3, 32, 32), "float32"), usable)
    options = solver.settings.gerchberg_saxton
    cutoffs = len(options.coarse_cutoffs_cpa)
    coarse, fine = (gs.ffts_per_iteration(3, options, blurs=blurs) for blurs in (True, False))
    iterations = 5 * cutoffs * coarse + 7 * fine
    assert int(estimate.iterations) == 5 * cutoffs + 7
    assert int(estimate.ffts) - iterations == ffts_in(program.jaxpr)
