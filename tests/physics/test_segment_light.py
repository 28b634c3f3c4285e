"""The light of segments alone tells the images of all their pistons, against images of the moved pistons themselves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.segment_layouts import sparse
from nlcwfs.curvature_sensor.apparent_star import POINT, ApparentStar
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.map_solution import Solution
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.segment_light import SegmentLight, interference
from nlcwfs.estimation.segment_turns import looked, moves_of
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import light_on_pixels
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.whitened_phase import Unknown

WAVELENGTH_M, PLANES_M = 0.65e-6, (-3.5e6, 2.5e6, 3.5e6)
BAND = LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.5 * WAVELENGTH_M)
FRAME = Grid((24, 24), 0.6)
QUICK = EstimationSettings(modes=20)


@functools.cache
def solver(star=POINT, *, ideal=False):
    spectrum = BAND.spectrum(3)
    chromatic = [[z_m * WAVELENGTH_M / one_m for z_m in PLANES_M] for one_m in spectrum.wavelengths_m]
    geometry = SensorGeometry(
        PupilShape(8.0, segments=sparse()),
        FRAME,
        WAVELENGTH_M,
        PLANES_M,
        flux_fractions=(0.5, 0.2, 0.3),
        spectrum=spectrum,
        colour_distances_m=tuple(map(tuple, chromatic)) if ideal else None,
        star=star,
    )
    return MaximumAPosteriori.build(geometry, QUICK, dtype="float64")


@pytest.mark.parametrize(("star", "ideal"), [(POINT, True), (ApparentStar(size_rad=2e-7), False)])
def test_pistons_change_the_images_as_the_light_of_pairs_tells(star, ideal):
    model = solver(star, ideal=ideal)
    steps, level, rng = model.steps, model.level, np.random.default_rng(1)
    phase_rad = jnp.asarray(rng.normal(size=level.grid.shape) * 0.3)
    turns = np.array([0.3, -1.2, 2.8, 0.1])
    labels = np.asarray(steps.labels).reshape(steps.shape)
    moved_rad = phase_rad + 2 * np.pi * turns[labels]
    expected = light_on_pixels(level, moved_rad) - light_on_pixels(level, phase_rad)
    maps = np.asarray(interference(level, steps, phase_rad))
    found = np.zeros(expected.shape)
    for colour, wavelength_m in enumerate(model.geometry.spectrum.wavelengths_m):
        for number, (one, other) in enumerate(steps.pairs):
            angle = 2 * np.pi * (turns[one] - turns[other]) * WAVELENGTH_M / wavelength_m
            found += (np.cos(angle) - 1) * maps[colour, number, 0] + np.sin(angle) * maps[colour, number, 1]
    np.testing.assert_allclose(found, expected, atol=1e-12 * float(jnp.max(light_on_pixels(level, phase_rad))))


def exposure(model, turns, photons):
    """A flat wavefront before counts of these pistons, without noise: all that it does not explain is theirs."""
    steps, level = model.steps, model.level
    labels = np.asarray(steps.labels).reshape(steps.shape)
    light = light_on_pixels(level, jnp.asarray(2 * np.pi * np.asarray(turns)[labels]))
    shares = np.array([0.5, 0.2, 0.3])[:, None, None]
    counts = photons * shares * light / jnp.sum(light, axis=(1, 2), keepdims=True)
    near = Measurement(counts, jnp.ones(counts.shape, bool), jnp.asarray(0.0))
    flat = jnp.zeros(level.grid.shape)
    scale = model.plane_scale(near, flat)
    task = model.task(near, flat, scale, model.prior(model.power, model.tilt_rms_rad), jnp.asarray(1.0))
    none, start = jnp.asarray(0, jnp.int32), task.prior.nothing()
    zero, model_counts = jnp.asarray(0.0), task.problem.expected(flat)
    return task, Solution(start, model_counts, gn.cost(task.problem, start), zero, none, none, jnp.asarray(True))


def test_small_pistons_cost_as_much_as_the_likelihood_says():
    """Both are a quadratic there; the variance of the counts is taken half from the counts, half from the model."""
    model = solver()
    task, still = exposure(model, [0, 0.03, -0.02, 0.01], 1e5)
    light = SegmentLight.build(task, model.steps, still)
    for turns in ([0.0, 0.03, -0.02, 0.01], [0.0, -0.04, 0.0, 0.02], [0.01, 0.0, 0.05, 0.0]):
        moved = 2 * jnp.pi * jnp.asarray(turns) / model.steps.rms_rad[0]
        unknown = Unknown(still.unknown.waves, still.unknown.slope.at[2:6].add(moved))
        expected = float(gn.cost(task.problem, unknown) - still.cost)
        assert float(light.cost(jnp.asarray(turns))) == pytest.approx(expected, rel=0.05, abs=0.05)


def test_turns_far_and_near_are_seen_from_the_flat_wavefront():
    """Without fringes in between: no small steps would lead there."""
    model, cases = solver(), [(0, 5, 0, 0), (0, -2, 1, 2), (0, -6, -6, 0)]
    lights = [
        SegmentLight.build(task, model.steps, still) for task, still in (exposure(model, one, 1e5) for one in cases)
    ]
    look = jax.jit(lambda light: looked(light, jnp.asarray(moves_of(4))))
    for light, turns in zip(lights, cases, strict=True):
        found, costs = look(light)
        best = np.asarray(found[int(jnp.argmin(costs))])
        np.testing.assert_allclose(best - best[0], turns, atol=0.02)  # the prior of pistons pulls a little


def test_bright_light_in_single_precision_finds_its_turns():
    """A common piston is told by the prior alone, a part in 1e9 of what the light tells of others."""
    model = solver()
    task, still = exposure(model, (0, 1, -1, 0), 2e8)
    exact = SegmentLight.build(task, model.steps, still)
    single = jax.tree.map(lambda one: one.astype(jnp.float32), exact)
    start = jnp.asarray([0, 0.97, -1.02, 0], jnp.float32)
    turns, cost = jax.jit(lambda light, start: light.fitted(start))(single, start)
    np.testing.assert_allclose(np.asarray(turns - turns[0]), (0, 1, -1, 0), atol=0.005)
    assert float(cost) < -1e5  # of 2e8 photons
