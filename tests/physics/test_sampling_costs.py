"""What windows and pixels cost, as `sampling` predicts it, against light on a much finer and wider grid.

The light here is a Fresnel transform of its own, in NumPy: nothing is shared with the code under test.
"""

import numpy as np
import pytest
from scipy import fft

from nlcwfs.beam.sampling_cost import SensedLight, light_outside, pixel_error, wrapping_error

DIAMETER_M, WAVELENGTH_M = 8.0, 0.85e-6


def centres_m(count, pixel_m):
    return (np.arange(count) - (count - 1) / 2) * pixel_m


def round_pupil(count, pixel_m, parts=4):
    fine_m = centres_m(count * parts, pixel_m / parts)
    lit = np.hypot(fine_m[:, None], fine_m) < DIAMETER_M / 2
    return lit.reshape(count, parts, count, parts).mean(axis=(1, 3))


def defocused(field, distance_m, pixel_m):
    frequency = np.fft.fftfreq(len(field), pixel_m)
    travel = np.exp(-1j * np.pi * WAVELENGTH_M * distance_m * (frequency[:, None] ** 2 + frequency**2))
    return np.abs(fft.ifft2(fft.fft2(field) * travel)) ** 2


def waves(random, frequency_per_m, variance_rad2):
    """A random phase that can be looked up anywhere: a sum of plane waves, each with its own variance."""
    angle_rad = random.uniform(0, 2 * np.pi, len(frequency_per_m))
    start_rad = random.uniform(0, 2 * np.pi, len(frequency_per_m))
    along_x = 2j * np.pi * frequency_per_m * np.cos(angle_rad)
    along_y = 2j * np.pi * frequency_per_m * np.sin(angle_rad)
    amplitude = np.sqrt(2 * variance_rad2) * np.exp(1j * start_rad)

    def phase_rad(count, pixel_m):
        inside = min(count, int(np.ceil(DIAMETER_M / pixel_m)) // 2 * 2 + count % 2 + 2)  # the pupil only
        x_m = centres_m(inside, pixel_m)
        rows = amplitude[:, None] * np.exp(along_y[:, None] * x_m)
        return np.pad((rows.T @ np.exp(along_x[:, None] * x_m)).real, (count - inside) // 2)

    return phase_rad


def kolmogorov(random, fried_m, finest_per_m, count=600):
    # Down to a period of 1e6 m: an outer scale of 50 D would take a third of the tilt away. One wave in each
    # of equal steps of log f.
    octaves = np.log(finest_per_m * 1e6)
    frequency = np.exp(-octaves * (np.arange(count) + random.uniform(0, 1, count)) / count) * finest_per_m
    spectrum = 0.0229 * fried_m ** (-5 / 3) * frequency ** (-11 / 3)
    return waves(random, frequency, spectrum * 2 * np.pi * frequency**2 * octaves / count)


def white(random, rms_rad, cycles, count=300):
    frequency = np.sqrt(random.uniform(0, 1, count)) * cycles / DIAMETER_M
    return waves(random, frequency, np.full(count, rms_rad**2 / count))


@pytest.mark.parametrize("distance_m", [-2.5e6, 3.5e6])
def test_the_light_that_misses_a_window_is_as_predicted(distance_m):
    random = np.random.default_rng(7)
    pixel_m, count, fried_m = DIAMETER_M / 128, 1024, 0.8
    pupil = round_pupil(count, pixel_m)
    image = np.zeros_like(pupil)
    for _ in range(10):
        phase_rad = kolmogorov(random, fried_m, finest_per_m=0.5 / pixel_m)(count, pixel_m)
        image += defocused(pupil * np.exp(1j * phase_rad), distance_m, pixel_m)
    light = SensedLight(DIAMETER_M, WAVELENGTH_M, fried_m=fried_m)
    # Ripples finer than the pixel are not in the screens; their light goes far: the rest of the spectrum.
    finer = 2 * np.pi * 0.0229 * fried_m ** (-5 / 3) * 3 / 5 * (0.5 / pixel_m) ** (-5 / 3)
    for half in (80, 96, 128, 200):
        middle = slice(count // 2 - half, count // 2 + half)
        simulated = 1 - image[middle, middle].sum() / image.sum() + finer
        predicted = light_outside(light, distance_m=distance_m, window_m=2 * half * pixel_m)
        # 25 %: the tilt of ten screens moves the light; the mean of 40 agrees to 10 %.
        assert predicted == pytest.approx(simulated, rel=0.25)


def test_a_flat_wavefront_loses_the_light_its_edge_diffracts():
    pixel_m, count = DIAMETER_M / 180, 1024
    image = defocused(round_pupil(count, pixel_m), 3.5e6, pixel_m)
    middle = slice(count // 2 - 128, count // 2 + 128)
    simulated = 1 - image[middle, middle].sum() / image.sum()
    predicted = light_outside(SensedLight(DIAMETER_M, WAVELENGTH_M), distance_m=3.5e6, window_m=256 * pixel_m)
    assert predicted == pytest.approx(simulated, rel=0.15)  # coarser pixels, narrower grid


@pytest.mark.parametrize(
    ("window", "rms_rad", "low", "high"),
    # Bounds: the smallest and largest ratio of estimate and simulation that is of use to choose a grid.
    # Where phase and window are small the estimate is an upper one: rings are not as rough as speckles.
    [(64, 1.0, 0.9, 2.2), (64, 3.0, 0.75, 1.3), (128, 1.0, 1.0, 3.5), (128, 3.0, 0.75, 1.5)],
)
@pytest.mark.parametrize("distance_m", [2.5e6, -3.5e6])
def test_the_error_of_a_model_grid_is_about_as_predicted(distance_m, window, rms_rad, low, high):
    random = np.random.default_rng(11)
    pixel_m, fine, count = DIAMETER_M / 45, 4, 2 * window
    squared_error = squared = 0.0
    coarse_pupil, fine_pupil = round_pupil(window, pixel_m), round_pupil(count * fine, pixel_m / fine)
    for _ in range(4):
        phase_rad = white(random, rms_rad, cycles=5)
        model = coarse_pupil * np.exp(1j * phase_rad(window, pixel_m))
        truth = fine_pupil * np.exp(1j * phase_rad(count * fine, pixel_m / fine))
        seen = defocused(truth, distance_m, pixel_m / fine)
        seen = seen.reshape(count, fine, count, fine).mean(axis=(1, 3))
        middle = slice((count - window) // 2, (count + window) // 2)
        squared_error += np.sum((defocused(model, distance_m, pixel_m) - seen[middle, middle]) ** 2)
        squared += np.sum(seen[middle, middle] ** 2)
    simulated = np.sqrt(squared_error / squared)
    light = SensedLight(DIAMETER_M, WAVELENGTH_M, cycles_per_aperture=5.0, rms_rad=rms_rad)
    predicted = np.hypot(
        wrapping_error(light, distance_m=distance_m, window_m=window * pixel_m),
        pixel_error(light, distance_m=distance_m, pixel_m=pixel_m),
    )
    assert low < predicted / simulated < high
