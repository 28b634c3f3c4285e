"""The mean images of a loop and their derivatives against closed forms and averages."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "loop"))
from small_loop import small

from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.interaction_matrix import linearised
from nlcwfs.simulation.closed_loop.image_light import ImageLight, residual_structure
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop_waves import loop_waves

CONFIG = small("curvature_sensor.static_rms_nm=60", "curvature_sensor.distances_km=[-60, 90]")


@pytest.fixture(scope="module")
def light():
    return LoopLight.build(CONFIG)


def lit(light):
    return np.asarray(light.weights) > 0


def test_the_model_is_the_light_on_coarser_cells(light):
    """A wavefront of a few waves: 5 % of the brightest pixel, at the rim, are what cells of half a pixel miss."""
    grid, where = light.part, lit(light)
    y, x = np.broadcast_arrays(grid.y_m, grid.x_m)
    wave_m = 60e-9 * (np.sin(2.1 * x + 0.3) + np.cos(1.7 * y - 0.8 * x))
    model = ImageLight.build(CONFIG, light)(jnp.asarray(wave_m[where], jnp.float32))
    fine = light.optics.images(jnp.asarray(np.where(where, wave_m, 0), jnp.float32), 1.0)
    still = light.still
    pixels = integrate_on_pixels(fine, factor=still.factor, window=still.window)
    assert float(jnp.max(jnp.abs(model - pixels))) < 0.07 * float(jnp.max(pixels))
    flipped = ImageLight.build(CONFIG, light)(jnp.asarray(-wave_m[where], jnp.float32))
    assert float(jnp.max(jnp.abs(flipped - pixels))) > 0.1 * float(jnp.max(pixels))


def test_mean_image_and_mean_derivative_are_those_of_many_random_wavefronts(light):
    """Averages over drawn residuals. The closed form is of waves that are alike all over the pupil and beyond."""
    waves = loop_waves(CONFIG, light)
    driven_m2 = np.full(waves.driven, (90e-9) ** 2 / waves.driven)
    beyond = np.flatnonzero(np.arange(len(waves.cycles)) >= waves.driven)
    model = ImageLight.build(CONFIG, light)
    mean = model.amid(CONFIG, light, waves, driven_m2)
    start = jnp.zeros(int(lit(light).sum()), jnp.float32)
    push = waves.shapes[[0, 3, 11]].astype(np.float32)
    rng, images, slopes = np.random.default_rng(1), [], []
    rms_m = np.sqrt(np.concatenate([driven_m2, waves.open_m2[beyond]]))
    for _ in range(40):
        drawn = jnp.asarray((rng.standard_normal(len(rms_m)) * rms_m) @ waves.shapes, jnp.float32)
        one = linearised(lambda m: model(m).ravel(), drawn, push)
        images.append(one.signal)
        slopes.append(one.interaction)
    found = linearised(lambda m: mean(m).ravel(), start, push)
    sharp = linearised(lambda m: model(m).ravel(), start, push)
    averaged, slope = np.mean(images, axis=0), np.mean(slopes, axis=0)

    def missed(one, wanted):
        return np.linalg.norm(one - wanted) / np.linalg.norm(wanted)

    def gain(one):
        return np.sum(one * slope) / np.sum(one**2)

    assert missed(found.signal, averaged) < 0.12  # noise of 40 draws
    assert gain(found.interaction) == pytest.approx(1, abs=0.08)  # what makes the loop's gain right
    assert gain(sharp.interaction) < 0.88


def test_far_points_differ_by_twice_the_variance(light):
    waves = loop_waves(CONFIG, light)
    driven_m2 = np.linspace(1, 3, waves.driven) * 1e-17
    radian = 2 * np.pi / 0.85e-6
    near, far = residual_structure(np.array([0.0, 400.0]), light, waves, driven_m2)
    finest = waves.cycles[waves.driven - 1] / 2
    fried = 0.976 * 0.5e-6 / (0.6 / 206265) * (0.85 / 0.5) ** 1.2
    beyond = 2 * np.pi * 0.0229 * fried ** (-5 / 3) * 3 / 5 * finest ** (-5 / 3)
    assert near == 0
    assert far == pytest.approx(2 * (np.sum(driven_m2) * radian**2 + beyond), rel=0.05)  # waves of 400 m still beat
