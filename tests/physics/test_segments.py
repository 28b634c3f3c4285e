"""Steps between segments: the light that tells them, and reconstructors that find them in light of another grid."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.segments import Segment, Segments
from nlcwfs.config import load_config
from nlcwfs.curvature_sensor.step_visibility import telling_share
from nlcwfs.estimation.method import build_reconstructor
from nlcwfs.estimation.unwrapping_basis import unwrapping_basis
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of
from nlcwfs.simulation.segment_score import segment_pixels, segment_score

WAVELENGTH_M = 0.65e-6


def information_of_a_step(width_m, gap_m, distance_m):
    """Fisher information of the step between two discs, over that of a perfect sensor; NumPy alone."""
    cells = 384
    pixel_m = (2 * (2 * width_m + gap_m) + 6 * WAVELENGTH_M * distance_m / width_m) / cells
    grid, away_m = Grid((cells, cells), pixel_m), (width_m + gap_m) / 2
    discs = Segments((Segment(0.0, -away_m, width_m), Segment(0.0, away_m, width_m)))
    amplitude, labels = discs.amplitude(grid), discs.labels(grid)
    travel = np.exp(-1j * np.pi * WAVELENGTH_M * distance_m * (grid.fy_per_m**2 + grid.fx_per_m**2))
    norm = np.sqrt((amplitude**2).sum())
    one, two = (np.fft.ifft2(np.fft.fft2(amplitude * (labels == n) / norm) * travel) for n in (0, 1))
    found = []
    for turn in np.arange(8) / 8:
        moved = two * np.exp(2j * np.pi * turn)
        light = abs(one + moved) ** 2
        found.append(np.sum((2 * np.real(np.conj(one) * 1j * moved)) ** 2 / (light + 1e-12 * light.max())))
    return np.mean(found)


@pytest.mark.parametrize(
    ("width_m", "distance_m", "gaps_m"),
    [
        (2.4, 1e6, (0.1, 0.7, 1.6)),
        (2.4, 3.5e6, (0.3, 1.6, 5.6)),
        (8.4, 35e6, (0.4, 3.0, 16.0)),
        (8.4, 3.5e6, (0.4, 1.6)),
    ],
)
def test_the_light_that_crosses_a_gap_tells_the_step(width_m, distance_m, gaps_m):
    for gap_m in gaps_m:
        wanted = information_of_a_step(width_m, gap_m, distance_m)
        told = telling_share(gap_m, width_m, distance_m=distance_m, wavelength_m=WAVELENGTH_M)
        # Straight rims far apart in place of discs side by side: the factor that the module states.
        assert 1 / 2.7 < wanted / float(told) < 2.7


def test_a_step_is_told_less_the_wider_the_gap():
    found = [information_of_a_step(2.4, gap_m, 3.5e6) for gap_m in (0.3, 1.0, 3.0, 6.0)]
    assert all(near > 1.5 * far for near, far in itertools.pairwise(found))


SKY = (
    "seed=3",
    "precision=double",
    "beam.wavelength_um=0.65",
    "beam.segments.layout=sparse",
    "beam.segments.piston_range_nm=325",
    "atmosphere.photons=2e8",
    "atmosphere.opd_rms_nm=100",
    "detector.pixels_across_pupil=36",
    "detector.window_pixels=72",
    "simulation.light_oversampling=4",
)
FIELD = (
    "estimation.method=gerchberg-saxton",
    "estimation.gerchberg_saxton.filter=none",
    "estimation.gerchberg_saxton.amplitude=replace",
    "estimation.gerchberg_saxton.scheme=serial",
    "estimation.gerchberg_saxton.coarse_cutoffs_cpa=[]",
    "estimation.gerchberg_saxton.gain=1",
    "estimation.gerchberg_saxton.iterations=50",
    "estimation.gerchberg_saxton.tolerance_rad=0",
    "estimation.unwrapping=slopes",
    "estimation.modes=240",
)


@pytest.fixture(scope="module")
def sight():
    simulator = ExposureSimulator.build(load_config(None, SKY))
    return simulator, [simulator.expose(frame_key(seed=3, frame=number)) for number in range(2)]


def scores(simulator, exposures, settings):
    config = load_config(None, [*SKY, *settings])
    geometry = geometry_of(config, simulator)
    basis = None
    if config.estimation.unwrapping == "slopes":
        basis = unwrapping_basis(geometry, simulator.shape.on(geometry.frame), modes=config.estimation.modes)
    solver = build_reconstructor(geometry, config.estimation, basis=basis, dtype="float64")
    labels, weights = segment_pixels(simulator)
    estimate = eqx.filter_jit(lambda counts: solver.estimate(counts, jnp.ones(counts.shape, bool)))
    found = []
    for exposure in exposures:
        told = estimate(exposure.frames.electrons)
        error_m = np.asarray(told.opd_m) - np.asarray(exposure.truth_m)
        found.append((segment_score(error_m, weights, labels, wavelength_m=WAVELENGTH_M), told.outcome))
    return found


def test_the_most_likely_wavefront_finds_steps_and_what_is_inside(sight):
    simulator, exposures = sight
    for score, outcome in scores(simulator, exposures, ["estimation.map.healings=1"]):
        # The figures; photons alone allow 0.03 nm: 2e8 of them, a twentieth of which tell a step.
        assert 0 < score.piston_modulo_m < 1e-9
        assert 0.2e-9 < score.inside_m < 3e-9
        assert outcome.succeeded


def test_fifty_iterations_of_the_field_find_steps(sight):
    simulator, exposures = sight
    for score, outcome in scores(simulator, exposures, FIELD):
        assert 0 < score.piston_modulo_m < 5e-9  # the figures
        assert 0.2e-9 < score.inside_m < 6e-9
        assert outcome.succeeded


def test_five_iterations_do_not(sight):
    simulator, exposures = sight
    few = [*FIELD, "estimation.gerchberg_saxton.iterations=5"]
    assert max(score.piston_modulo_m for score, _ in scores(simulator, exposures, few)) > 20e-9


def test_pistons_are_drawn_evenly_beside_the_air(sight):
    simulator, _ = sight
    assert ExposureSimulator.build(load_config(None, [*SKY, "beam.segments.piston_range_nm=0"])).stand is None
    labels = simulator.shape.labels(simulator.light)
    cells = np.array([np.flatnonzero(labels == number)[[0, -1]] for number in range(4)])
    drawn = np.array([np.asarray(simulator.stand.draw(frame_key(seed=0, frame=n))).ravel()[cells] for n in range(60)])
    np.testing.assert_array_equal(drawn[..., 0], drawn[..., 1])  # a segment is raised as a whole
    assert 300e-9 < abs(drawn).max() <= 325e-9
    # Variance of an even distribution, range^2 / 3: 240 draws give it to 6 % (kurtosis 1.8), four sigma are 23 %.
    assert np.var(drawn) == pytest.approx((325e-9) ** 2 / 3, rel=0.23)
    key = frame_key(seed=3, frame=0)
    sky, _ = jax.random.split(key)
    air_m = simulator.on_light(simulator.screens.draw(sky)) + simulator.stand.draw(key)
    np.testing.assert_allclose(simulator.expose(key).opd_m, simulator.levelled(air_m), atol=1e-15)
