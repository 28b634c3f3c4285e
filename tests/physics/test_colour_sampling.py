"""How wrong sums over few wavelengths are, against what the coherence of colours predicts; images by NumPy alone."""

import jax
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.colour_sampling import (
    FRINGE_ERROR_ALLOWED,
    ColouredImage,
    fringe_error,
    sampling_error,
    step_coherence,
    wavelengths_needed,
)
from nlcwfs.beam.fresnel import fresnel_transfer
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil import circular_pupil

DIAMETER_M, WAVELENGTH_M, CELLS = 2.0, 0.85e-6, 48
GRID = Grid((120, 120), DIAMETER_M / CELLS)
PUPIL = circular_pupil(GRID, diameter_m=DIAMETER_M)
SEEDS = 3


def constant(distance_m):
    return lambda wavelength_m: distance_m


def inverse(distance_m):
    return lambda wavelength_m: distance_m * WAVELENGTH_M / wavelength_m


def image_of(opd_m, distance_m, spectrum):
    total = np.zeros(GRID.shape)
    for wavelength_m, share in zip(spectrum.wavelengths_m, spectrum.shares, strict=True):
        scale = {"wavelength_m": wavelength_m, "pixel_m": GRID.pixel_m}
        transfer = fresnel_transfer(GRID.shape, distance_m=distance_m(wavelength_m), **scale)
        field = PUPIL * np.exp(2j * np.pi / wavelength_m * opd_m)
        total += share * np.abs(np.fft.ifft2(np.fft.fft2(field) * transfer)) ** 2
    return total


def measured_error(air, distance_m, band, spectrum):
    """Rms error over the rms of the image less the flat wavefront's."""
    screens = PhaseScreens.build(air, shape=GRID.shape, pixel_m=GRID.pixel_m)
    wrong, whole = 0.0, 0.0
    for seed in range(SEEDS):
        opd_m = np.asarray(screens.draw(jax.random.key(seed)), float)
        dense = image_of(opd_m, distance_m, band.spectrum(48))
        wrong += np.sum((image_of(opd_m, distance_m, spectrum) - dense) ** 2)
        whole += np.sum((dense - image_of(0 * opd_m, distance_m, band.spectrum(48))) ** 2)
    return np.sqrt(wrong / whole)


@pytest.mark.parametrize("law", [constant, inverse])
@pytest.mark.parametrize("rms_nm", [300.0, 700.0])
def test_the_error_of_few_wavelengths_is_what_coherence_says_or_less(law, rms_nm):
    """Less: it counts pairs of all separations alike, and images hold more light at small ones, which fade less.

    A factor f in the phase of pairs is f^(2 n) in the error of n of Gauss's nodes.
    """
    air = Turbulence.from_rms(opd_rms_m=rms_nm * 1e-9, diameter_m=DIAMETER_M)
    distance_m, band = law(150e3), LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.4 * WAVELENGTH_M)
    image = ColouredImage(DIAMETER_M, distance_m, air.structure_m2)
    for count in (1, 2, 3):
        predicted = sampling_error(image, band, band.spectrum(count))
        found = measured_error(air, distance_m, band, band.spectrum(count))
        assert predicted / 2 ** (count + 1) < found < 1.2 * predicted, (count, found, predicted)
    needed = wavelengths_needed([image], band)
    assert measured_error(air, distance_m, band, band.spectrum(needed)) < 0.03


def test_gauss_needs_fewer_wavelengths_than_equal_steps_where_lenses_are_chromatic():
    air = Turbulence.from_rms(opd_rms_m=700e-9, diameter_m=DIAMETER_M)
    band = LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.4 * WAVELENGTH_M)
    gauss, steps = (measured_error(air, inverse(150e3), band, rule(5)) for rule in (band.spectrum, band.equal_steps))
    assert gauss < steps / 20  # exponential against second order


def test_a_common_tilt_needs_no_more_wavelengths():
    """Achromatic lenses move all colours of a tilted wavefront alike; its structure function is (slope s)^2."""
    band = LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.2 * WAVELENGTH_M)
    tilted = ColouredImage(DIAMETER_M, constant(150e3), lambda apart_m: (1e-6 * apart_m) ** 2)
    coherence = tilted.speckle_coherence(band.spectrum(4).wavelengths_m)
    np.testing.assert_allclose(coherence, 1, atol=1e-9)  # V cancels to rounding of (k slope D)^2 = 200
    through_lenses = ColouredImage(DIAMETER_M, inverse(150e3), lambda apart_m: (1e-6 * apart_m) ** 2)
    assert through_lenses.speckle_coherence(band.spectrum(4).wavelengths_m).min() < 0.8


def test_colours_from_different_directions_are_less_alike():
    """Shifts of the image by z theta: the mean of J0(k s theta) over pairs, at 1 and 1.1 times the wavelength."""
    colours = (0.85e-6, 0.935e-6)
    theta = 2e-7

    def towards(wavelength_m):
        return (0.6 * theta, -0.8 * theta) if wavelength_m > 0.9e-6 else (0.0, 0.0)

    still = ColouredImage(DIAMETER_M, inverse(150e3), lambda apart_m: 0 * apart_m, towards)
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (400_000, 2))
    points = points[np.hypot(*points.T) < 1]
    half = len(points) // 2
    apart = np.hypot(*(points[:half] - points[half : 2 * half]).T) * DIAMETER_M / 2
    k = 2 * np.pi / np.sqrt(colours[0] * colours[1])
    angles = rng.uniform(0, 2 * np.pi, half)
    expected = np.mean(np.cos(k * apart * theta * np.cos(angles)))
    found = still.speckle_coherence(colours)[0, 1]
    assert found == pytest.approx(
        expected, abs=0.02
    )  # s differs by 5 % between the colours; 150 000 random pairs: 0.002


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fringes_of_steps_in_few_wavelengths_are_as_wrong_as_drawn_steps_show(count):
    """Still air and ideal lenses: only exp(i k step) changes with the color. Given steps, drawn pistons, tilts."""
    rng, band = np.random.default_rng(5), LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.4 * WAVELENGTH_M)
    given_m, range_m, tilt_m = [0.0, 3e-7, -4e-7], 5e-7, 6e-8
    fringes = step_coherence(pistons_m=given_m, range_m=range_m, tilt_rms_m=tilt_m)
    still = ColouredImage(DIAMETER_M, inverse(0.0), lambda apart_m: 0 * apart_m, fringes=fringes)
    draws = 100_000
    pairs = np.array([(0, 1), (0, 2), (1, 2)])[rng.integers(0, 3, draws)]
    ends_m = (
        np.array(given_m)[pairs]
        + rng.uniform(-range_m, range_m, (draws, 2))
        + rng.normal(0, tilt_m, (2, draws, 2)).sum(0)
    )
    steps_m = ends_m[:, 0] - ends_m[:, 1]

    def fringe(spectrum):
        phase = 2 * np.pi * steps_m[:, None] / np.array(spectrum.wavelengths_m)
        return np.exp(1j * phase) @ np.array(spectrum.shares)

    dense = fringe(band.spectrum(24))
    wrong = np.mean(np.abs(fringe(band.spectrum(count)) - dense) ** 2)
    expected = np.sqrt(wrong / np.mean(np.abs(dense) ** 2))
    assert fringe_error(still, band, band.spectrum(count)) == pytest.approx(expected, rel=0.02)  # 5 sigma of the draws


@pytest.mark.parametrize("law", [constant, inverse])
def test_images_with_steps_of_a_wave_are_right_with_the_wavelengths_that_are_needed(law):
    """Two halves with a gap; what the step changes is the measure. Without the steps the rule takes too few."""
    band, distance_m = LightBand.flat(wavelength_m=WAVELENGTH_M, bandwidth_m=0.5 * WAVELENGTH_M), law(150e3)
    flat, steps = (lambda apart_m: 0 * apart_m), step_coherence(range_m=WAVELENGTH_M)
    needed = wavelengths_needed([ColouredImage(DIAMETER_M, distance_m, flat, fringes=steps)], band)
    without = wavelengths_needed([ColouredImage(DIAMETER_M, distance_m, flat)], band)
    opd_m = np.where(GRID.x_m > 0, 1.9 * WAVELENGTH_M, 0) * np.ones(GRID.shape)
    dense = image_of(opd_m, distance_m, band.spectrum(64))
    shown = np.sqrt(np.sum((dense - image_of(0 * opd_m, distance_m, band.spectrum(64))) ** 2))
    errors = [
        np.sqrt(np.sum((image_of(opd_m, distance_m, band.spectrum(count)) - dense) ** 2)) / shown
        for count in (needed, without)
    ]
    # This step is the longest that the range allows, whose fringes are the fewest: 3 times the rms error is allowed.
    assert errors[0] < 3 * FRINGE_ERROR_ALLOWED < errors[1], (needed, without, errors)
