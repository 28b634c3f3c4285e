"""What defocused light shows of a wave: against light of the test's own NumPy code."""

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation.ladder import finest_level
from nlcwfs.estimation.map_error import kept_by_pixels
from nlcwfs.estimation.phase_prior import PriorSettings, expected_air
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.wave_sensitivity import LAGS, SPECKLED_LOSS, roughness, seen_share

WAVELENGTH_M, CELL_M, CELLS = 0.85e-6, 0.1, 128
DISTANCES_M = (-3.5e6, -2.5e6, 2.5e6, 3.5e6)
FRACTIONS = np.array([0.1, 0.4, 0.3, 0.2])


def information(phase_rad: np.ndarray, wave_rad: np.ndarray) -> float:
    """Fisher information of a wave's amplitude for one photon in all, by central differences of Fresnel's images."""
    f = np.fft.fftfreq(CELLS, CELL_M)
    square = f[:, None] ** 2 + f[None] ** 2

    def images(phase: np.ndarray) -> np.ndarray:
        near = np.fft.fft2(np.exp(1j * phase)) / CELLS
        far = [np.fft.ifft2(near * np.exp(-1j * np.pi * WAVELENGTH_M * z * square)) for z in DISTANCES_M]
        return FRACTIONS[:, None, None] * np.abs(far) ** 2

    small = 1e-5
    slope = (images(phase_rad + small * wave_rad) - images(phase_rad - small * wave_rad)) / (2 * small)
    return float(np.sum(slope**2 / np.maximum(images(phase_rad), 1e-12)))


def wave(cycles: int) -> np.ndarray:
    return np.sqrt(2) * np.cos(2 * np.pi * cycles * np.arange(CELLS) / CELLS)[None] * np.ones((CELLS, 1))


def told(cycles: int, rough_rad2: float) -> float:
    """Information of a wave for one photon, from the share."""
    share = seen_share(
        np.array([cycles / (CELLS * CELL_M)]),
        jnp.full(len(LAGS), rough_rad2),
        pixel_m=CELL_M,
        distances_m=DISTANCES_M,
        fractions=jnp.asarray(FRACTIONS),
        wavelength_m=WAVELENGTH_M,
    )
    return 4 / SPECKLED_LOSS * float(share[0])


@pytest.mark.parametrize("cycles", [1, 2, 3, 5, 8, 13])
def test_flat_light_shows_a_wave_as_fresnel_says(cycles):
    assert told(cycles, 0.0) == pytest.approx(information(np.zeros((CELLS, CELLS)), wave(cycles)), rel=1e-4)


def rough_screen(rms_rad: float, rng: np.random.Generator) -> np.ndarray:
    """Noise that is smooth over four cells: its structure function is 2 rms^2 at the lags that count."""
    f = np.fft.fftfreq(CELLS)
    smooth = np.exp(-((f[:, None] ** 2 + f[None] ** 2) * 4**2))
    screen = np.fft.ifft2(np.fft.fft2(rng.normal(size=(CELLS, CELLS))) * smooth).real
    return rms_rad * screen / screen.std()


@pytest.mark.parametrize(("rms_rad", "cycles"), [(0.4, 2), (0.4, 3), (3.0, 2), (3.0, 3), (3.0, 8)])
def test_rough_light_shows_slow_waves_better(rms_rad, cycles):
    """Within a factor of two, where flat light would be wrong by up to fifty: it conditions, it does not weigh."""
    rng = np.random.default_rng(cycles)
    found = np.mean([information(rough_screen(rms_rad, rng), wave(cycles)) for _ in range(4)])
    assert 0.5 < told(cycles, 2 * rms_rad**2) / found < 2.0


def test_roughness_of_white_noise_is_twice_its_variance():
    geometry = SensorGeometry(PupilShape(8.0), Grid((64, 64), 0.18), WAVELENGTH_M, DISTANCES_M)
    air = expected_air(PriorSettings(), seeing_arcsec=0.6, diameter_m=8.0)
    level = finest_level(geometry, air, oversampling=1, window=1.5, dtype="float64")
    noise = np.random.default_rng(3).normal(scale=0.7, size=level.grid.shape)
    assert np.allclose(roughness(jnp.asarray(noise), level), 2 * 0.7**2, rtol=0.1)
    ramp = 0.01 * np.arange(level.grid.shape[1])[None] * np.ones((level.grid.shape[0], 1))
    assert np.allclose(roughness(jnp.asarray(ramp), level)[:4], (0.01 * np.array(LAGS[:4])) ** 2 / 2)


@pytest.mark.parametrize("per_pixel", [0.05, 0.2, 0.4])
def test_what_pixels_keep_of_a_wave(per_pixel):
    """Against the mean over nine by nine points in pixels of waves of many directions."""
    inside = (np.arange(9) - 4) / 9
    kept = []
    for angle in np.linspace(0, np.pi, 24, endpoint=False):
        turn = 2 * np.pi * per_pixel * (np.cos(angle) * inside[None] + np.sin(angle) * inside[:, None])
        kept.append(abs(np.mean(np.exp(1j * turn))) ** 2)
    assert kept_by_pixels(np.array([per_pixel]))[0] == pytest.approx(np.mean(kept), rel=0.01)
