"""Whole wavelengths of the steps between segments, from one exposure of a wide band: drawn evenly up to a wave."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.segment_layouts import sparse
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings

WAVELENGTH_M, PLANES_M = 0.65e-6, (-3.5e6, -2.5e6, 2.5e6, 3.5e6)
TELESCOPE = PupilShape(8.0, segments=sparse())
BAND = LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.5 * WAVELENGTH_M)
FRAME, FINER = Grid((40, 40), 8.0 / 20), 4
CELLS = Grid((160, 160), FRAME.pixel_m / FINER)


@functools.cache
def solver(wavelengths: int) -> MaximumAPosteriori:
    spectrum = None if wavelengths == 1 else BAND.spectrum(wavelengths)
    geometry = SensorGeometry(TELESCOPE, FRAME, WAVELENGTH_M, PLANES_M, spectrum=spectrum)
    return MaximumAPosteriori.build(geometry, EstimationSettings(modes=60))


@functools.cache
def light() -> CurvatureSensor:
    """21 wavelengths: steps of two waves have fringes over the band that fewer do not follow."""
    return CurvatureSensor.build(TELESCOPE.on(CELLS), CELLS, distances_m=PLANES_M, spectrum=BAND.spectrum(21))


@functools.cache
def estimate():
    model = solver(5)
    return jax.jit(lambda counts: model.estimate(counts, jnp.ones(counts.shape, bool)))


def trial(seed: int, photons: float) -> tuple[list[int], float]:
    """Turns by which the estimate is off, against the first segment; and the probability that it tells for that."""
    rng = np.random.default_rng(seed)
    air = Turbulence.from_rms(opd_rms_m=100e-9, diameter_m=8.0)
    screens = PhaseScreens.build(air, shape=CELLS.shape, pixel_m=CELLS.pixel_m)
    pistons_m = rng.uniform(-1, 1, 4) * WAVELENGTH_M
    opd_m = np.asarray(screens.draw(jax.random.key(seed)), float) + pistons_m[TELESCOPE.labels(CELLS)]
    mean = integrate_on_pixels(
        light().images(jnp.asarray(opd_m, jnp.float32), photons).photons, factor=FINER, window=FRAME.shape
    )
    counts = rng.poisson(np.asarray(mean, float))
    found = estimate()(jnp.asarray(counts, jnp.float32))
    truth_m = opd_m.reshape(FRAME.shape[0], FINER, FRAME.shape[1], FINER).mean((1, 3))
    missed_m = np.asarray(found.opd_m, float) - truth_m
    lit, labels = TELESCOPE.on(FRAME) > 0.9, TELESCOPE.labels(FRAME)
    means_m = np.array([missed_m[lit & (labels == number)].mean() for number in range(4)])
    turns = np.round((means_m - means_m[0]) / WAVELENGTH_M).astype(int)
    return turns.tolist(), float(found.wrong_turn)


@pytest.mark.parametrize("first", [0, 10])
def test_whole_wavelengths_are_found_and_believed(first):
    """1e5 photons; turns beside are forty nats away and more, so none of twenty may be wrong.

    The seventh, on which a model of five colors shows its fringes again, is nearer: 13 nats in one of the trials.
    """
    for seed in range(first, first + 10):
        turns, wrong = trial(seed, 1e5)
        assert turns == [0, 0, 0, 0]
        assert 0 <= wrong < 1e-4


def test_one_color_tells_no_turns():
    counts, model = jax.ShapeDtypeStruct((4, *FRAME.shape), jnp.float32), solver(1)
    shapes = jax.eval_shape(lambda counts: model.estimate(counts, jnp.ones(counts.shape, bool)), counts)
    assert shapes.wrong_turn is None


def test_faint_light_says_how_often_it_is_wrong():
    """3e3 photons hardly tell turns: the mean of what is told is the share that is wrong, within chance."""
    found = [trial(seed, 3e3) for seed in range(40, 52)]
    wrong = np.mean([turns != [0, 0, 0, 0] for turns, _ in found])
    told = np.mean([one for _, one in found])
    assert told > 0.3
    assert abs(wrong - told) < 2.5 * np.sqrt(told * (1 - told) / len(found)), (wrong, told)
