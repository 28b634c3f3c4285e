"""A reconstructor whose model follows a vibrating membrane: against direct sums, and against light on finer cells."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.curvature_sensor.apparent_star import POINT
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.curvature_sensor.membrane import membrane_moments, moving_light
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.map_solution import solved
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import light_on_pixels, mean_counts, plane_scale
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.turn_islands import torn_phase

TELESCOPE, WAVELENGTH_M, PLANES_M = PupilShape(2.0), 0.85e-6, (-219e3, -156e3, 156e3, 219e3)
FRAME, FINER, DEAD = Grid((36, 36), 2.0 / 24), 4, 0.1
BAND = LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.2 * WAVELENGTH_M)


@functools.cache
def solver(moments: int, wavelengths: int = 1) -> MaximumAPosteriori:
    spectrum = None if wavelengths == 1 else BAND.spectrum(wavelengths)
    motion = {"motion": "sine", "moments": moments, "dead_share": DEAD}
    geometry = SensorGeometry(TELESCOPE, FRAME, WAVELENGTH_M, PLANES_M, spectrum=spectrum, **motion)
    return MaximumAPosteriori.build(geometry, EstimationSettings(modes=60))


def steep(shape: tuple[int, int]) -> np.ndarray:
    """Two radians of ripples of about six cycles across the telescope, and slower ones."""
    smooth = scipy.ndimage.gaussian_filter(np.random.default_rng(5).normal(0, 1, shape), 3.0, mode="wrap")
    return 2 * smooth / smooth.std()


def direct(level, phase_rad: np.ndarray, wavelengths_m, shares) -> np.ndarray:
    """Fresnel's factor by hand, at 500 equal steps of the time in which light is integrated."""
    pupil = np.asarray(level.optics.pupil, float)
    f2 = np.fft.fftfreq(level.grid.shape[0], level.grid.pixel_m)[:, None] ** 2
    f2 = f2 + np.fft.fftfreq(level.grid.shape[1], level.grid.pixel_m)[None, :] ** 2
    times = (np.arange(500) + 0.5) / 500 * (1 - DEAD) + DEAD / 2  # of the half period; both halves are alike
    places = np.pi / 2 * np.sin(np.pi * times[:250])
    light = np.zeros((4, *level.grid.shape))
    for colour_m, share in zip(wavelengths_m, shares, strict=True):
        near = np.fft.fft2(pupil * np.exp(1j * phase_rad * WAVELENGTH_M / colour_m)) / np.sqrt(np.sum(pupil**2))
        for plane, distance_m in enumerate(PLANES_M):
            for place in places:
                far = np.fft.ifft2(near * np.exp(-1j * np.pi * colour_m * place * distance_m * f2))
                light[plane] += share * np.abs(far) ** 2 / len(places)
    rows, columns = level.measured_shape
    return light.reshape(4, rows, 2, columns, 2).sum((2, 4))


@pytest.mark.parametrize("wavelengths", [1, 2])
def test_the_model_is_the_mean_over_the_motion(wavelengths):
    """16 moments follow these ripples but for the finest around the sharp rim, 0.7 %; planes at rest miss a third."""
    level = solver(16, wavelengths).level
    phase_rad = steep(level.grid.shape)
    colours = BAND.spectrum(wavelengths) if wavelengths > 1 else None
    light = ((WAVELENGTH_M,), (1.0,)) if colours is None else (colours.wavelengths_m, colours.shares)
    expected = direct(level, phase_rad, *light)
    spread = expected - expected.mean((1, 2), keepdims=True)

    def missed(model: MaximumAPosteriori) -> float:
        found = np.asarray(light_on_pixels(model.level, jnp.asarray(phase_rad, jnp.float32)), float)
        return float(np.sqrt(np.sum((found - expected) ** 2) / np.sum(spread**2)))

    assert missed(solver(16, wavelengths)) < 0.01
    assert missed(solver(1, wavelengths)) > 0.2
    assert solver(16, wavelengths).level.has_band == (wavelengths > 1)  # moments alone tell no whole wavelengths
    assert solver(16, wavelengths).level.moment_count == 16


def test_a_field_behind_the_membrane_rests_at_the_truth_and_nowhere_else():
    """Without noise Gerchberg-Saxton on all moments leaves the true phase; with planes at rest it leads away."""
    model = solver(6)
    level, phase_rad = model.level, jnp.asarray(0.3 * steep(model.level.grid.shape), jnp.float32)
    near = model.capture.measurement(jnp.ones((4, 36, 36)), jnp.ones((4, 36, 36), bool), 0.0)
    measured = near.padded(level.measured_shape)
    light = 1e7 * light_on_pixels(level, phase_rad)
    measured = eqx.tree_at(lambda one: one.counts, measured, jnp.where(measured.usable, light, 0))
    scale = plane_scale(light_on_pixels(level, phase_rad), measured, fits_background=False)
    assert float(jnp.abs(mean_counts(level, scale, phase_rad) / light - 1).max()) < 1e-3

    def moved_rad(level) -> float:
        torn = torn_phase(level, measured, scale, phase_rad, iterations=3, gain=1.0)
        turn, weight = np.exp(1j * np.asarray(torn - phase_rad, float)), np.asarray(level.weight, float)
        return float(np.sqrt(np.sum(weight * np.angle(turn / np.sum(weight * turn)) ** 2)))

    assert moved_rad(level) < 0.01
    assert moved_rad(eqx.tree_at(lambda one: one.moving, level, None)) > 0.1


def exposed(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts of a million photons in 24 moments on cells four times finer than pixels, and the wavefront on pixels."""
    cells = Grid((216, 216), FRAME.pixel_m / FINER)
    pupil = TELESCOPE.on(cells)
    weights = light_weights(pupil)
    screens = PhaseScreens.build(
        Turbulence.from_rms(opd_rms_m=200e-9, diameter_m=2.0), shape=pupil.shape, pixel_m=cells.pixel_m
    )
    opd_m = np.asarray(screens.draw(jax.random.key(seed)), float)
    opd_m = np.where(weights > 0, opd_m - np.sum(weights * opd_m), 0)
    sine, one = membrane_moments("sine", count=24, dead_share=DEAD), BAND.spectrum(1)
    spectrum, places_m, _ = moving_light(one, np.array([PLANES_M]), POINT, sine)
    sensor = CurvatureSensor.build(pupil, cells, distances_m=places_m, spectrum=spectrum)
    seen = {"factor": FINER, "window": FRAME.shape}
    light = integrate_on_pixels(sensor.images(jnp.asarray(opd_m, jnp.float32), 1e6).photons, **seen)
    counts = np.random.default_rng(seed).poisson(np.asarray(light, float))
    both = integrate_on_pixels(jnp.asarray(np.stack([weights, weights * opd_m]), jnp.float32), **seen)
    lit, weighted = np.asarray(both, float)
    return counts, lit, np.where(lit > 0, weighted / np.where(lit > 0, lit, 1), 0)


def left_nm(moments: int, seed: int) -> float:
    """Error of the most likely wavefront near the truth: what the model takes for light of other wavefronts."""
    model, (counts, light, truth_m) = solver(moments), exposed(seed)
    level, none = model.level, jnp.asarray(0, jnp.int32)

    @jax.jit
    def solution(counts, phase_rad):
        near = model.capture.measurement(counts, jnp.ones(counts.shape, bool), 0.0).padded(level.measured_shape)
        scale = model.plane_scale(near, phase_rad)
        task = model.task(
            near, 0 * phase_rad, scale, model.prior(model.power, model.tilt_rms_rad), jnp.ones((), jnp.float32)
        )
        start = task.prior.start(phase_rad, noise_variance=0.1 / task.problem.information)
        found = solved(task, MapSettings(steps=5), start, (none, none))
        return model.on_frame(task.prior.phase_rad(found.unknown))

    truth_rad = jnp.asarray(truth_m * 2 * np.pi / WAVELENGTH_M, jnp.float32)
    rest = [(a - b) // 2 for a, b in zip(level.measured_shape, FRAME.shape, strict=True)]
    wide = jnp.pad(truth_rad, [(one, one) for one in rest])
    start_rad = jax.image.resize(wide, level.grid.shape, method="cubic").astype(jnp.float32)
    found_rad = np.asarray(solution(jnp.asarray(counts, jnp.float32), start_rad), float)
    missed_m = found_rad * WAVELENGTH_M / (2 * np.pi) - truth_m
    missed_m = np.where(light > 0, missed_m - np.sum(light * missed_m) / np.sum(light), 0)
    return 1e9 * np.sqrt(np.sum(light * missed_m**2) / np.sum(light))


def test_moments_in_the_model_save_what_the_motion_costs():
    """200 nm of air, a million photons; the models differ in nothing but their moments."""
    rests, moves = (np.array([left_nm(moments, seed) for seed in range(2)]) for moments in (1, 6))
    assert np.all(moves < 0.8 * rests), (rests, moves)
