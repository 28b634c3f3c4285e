"""The physics of a design: blind waves, travel by matrices, information, and the planes that are found."""

import itertools
import math

import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.simulation.design.blind_frequencies import blind_frequencies, flat_signal
from nlcwfs.simulation.design.loop_errors import Planes, best_of_rates, errors_with, ideal_errors, loop_errors
from nlcwfs.simulation.design.loop_residual import BEYOND, Loop, LoopResidual
from nlcwfs.simulation.design.pixel_law import choices
from nlcwfs.simulation.design.plane_information import Pixels, PlaneInformation, travel_matrix
from nlcwfs.simulation.design.plane_search import COARSE, search_planes

WAVELENGTH_M = 0.85e-6
EIGHT_METRES = {"wavelength_m": WAVELENGTH_M, "diameter_m": 8.0}
SMALL = Loop(Turbulence(0.17), 1.0, WAVELENGTH_M, 4.0, 10.0, 1.0, photons_per_s=2e5)
UNIT_M = 1.0 / WAVELENGTH_M  # D^2 / lambda of the small telescope
SPREAD_M = UNIT_M / 8  # where light of 4 cycles has left the axis by half the diameter


@pytest.fixture(scope="module")
def residual():
    return LoopResidual.build(SMALL, PupilShape(1.0, 0.2)).redrawn(rate_hz=500.0, draws=2, seed=3)


@pytest.fixture(scope="module")
def information(residual):
    return PlaneInformation(residual, Pixels(12, 20))


def test_planes_whose_distances_are_five_to_seven_share_a_blind_wave():
    # sin(pi lambda z f^2) = 0 for both where lambda z f^2 is 5 and 7: f = sqrt(5 / (lambda 2500 km)).
    shared = 8 * math.sqrt(5 / (WAVELENGTH_M * 2.5e6))
    found = blind_frequencies([-3.5e6, -2.5e6, 2.5e6, 3.5e6], up_to=16.0, **EIGHT_METRES)
    np.testing.assert_allclose(found, [shared], rtol=1e-12)  # rounding
    assert shared == pytest.approx(12.27, abs=0.005)
    assert blind_frequencies([2.5e6, 3.5e6], up_to=shared * 0.999, **EIGHT_METRES) == []
    assert len(blind_frequencies([2.5e6, 3.5e6], up_to=shared * 1.42, **EIGHT_METRES)) == 2  # the next at sqrt(2)


def test_planes_at_300_and_3500_km_share_none_below_16_cycles():
    assert blind_frequencies([3e5, 3.5e6], up_to=16.0, **EIGHT_METRES) == []
    # ... for the nearer alone is blind first at 8 sqrt(1 / (lambda 300 km)) = 15.84, where the other shows 0.87.
    first = 8 * math.sqrt(1 / (WAVELENGTH_M * 3e5))
    assert blind_frequencies([-3e5], up_to=16.0, **EIGHT_METRES) == pytest.approx([first])
    told = flat_signal(np.array([first]), [3e5, 3.5e6], **EIGHT_METRES)
    assert told == pytest.approx(abs(math.sin(math.pi * 3.5e6 / 3e5)) / math.sqrt(2), rel=1e-9)  # rounding


def test_one_plane_is_blind_at_the_roots_of_whole_numbers():
    found = blind_frequencies([2e6], up_to=16.0, **EIGHT_METRES)
    expected = [8 * math.sqrt(n / (WAVELENGTH_M * 2e6)) for n in range(1, 7)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)  # rounding; the seventh is at 16.23


@pytest.mark.parametrize("distance_m", [0.03 * UNIT_M, -0.05 * UNIT_M, 0.004 * UNIT_M])
def test_travel_by_two_matrices_is_fresnels(distance_m):
    """Against plain NumPy: one FFT on a grid of twenty telescopes, and photons that fall where they fall."""
    cells, wide = 24, 24 * 20
    cell_m = 1.0 / cells
    x = (np.arange(cells) - (cells - 1) / 2) * cell_m
    small = np.exp(-25 * (x**2 + 1.5 * x[:, None] ** 2)) * (1 + x) * np.exp(1j * (9 * x * x[:, None] + 6 * x[:, None]))
    padded = np.pad(small, (wide - cells) // 2)
    frequency = np.fft.fftfreq(wide, cell_m)
    transfer = np.exp(-1j * np.pi * WAVELENGTH_M * distance_m * (frequency[:, None] ** 2 + frequency**2))
    there = np.fft.ifft2(np.fft.fft2(padded) * transfer)
    middle = slice(wide // 2 - 20, wide // 2 + 20)
    near, far = ((np.arange(n) - (n - 1) / 2) * cell_m for n in (cells, 40))
    travel = travel_matrix(near, far, distance_m=distance_m, wavelength_m=WAVELENGTH_M)
    ours = travel @ small @ travel.T
    # The field ends at exp(-25 / 4) = 0.2 % of its peak, where the cells cut its spectrum.
    np.testing.assert_allclose(ours, there[middle, middle], atol=0.003 * np.abs(there).max())
    assert not np.allclose(ours, there[middle, middle].T, atol=0.1 * np.abs(there).max())
    assert not np.allclose(ours, there[middle, middle][::-1], atol=0.1 * np.abs(there).max())


def test_information_is_that_of_images_made_in_numpy(residual):
    """Central differences of images by a wide FFT, on pixels of four by four places."""
    distance_m, across, window = 0.03 * UNIT_M, 12, 20
    grid = residual.grid
    cells = round(1 / grid.pixel_m)
    refined = 3  # places for each cell, four for each of 12 pixels across 16 cells
    assert cells == 16
    wide = cells * 15

    def pixels(phase_rad, side):
        near = np.sqrt(residual.weights) * np.exp(1j * phase_rad)
        margin = (wide - near.shape[0]) // 2
        spectrum = np.fft.fftshift(np.fft.fft2(np.pad(near, margin)))
        frequency = np.fft.fftshift(np.fft.fftfreq(wide, grid.pixel_m))
        spectrum = spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * side * (frequency[:, None] ** 2 + frequency**2))
        more = wide * (refined - 1) // 2
        fine = np.fft.ifft2(np.fft.ifftshift(np.pad(spectrum, more))) * refined  # photons for each finer cell
        # Interpolated cells are centred a third of a cell off the middle ones: roll the middle to the middle.
        light = np.roll(np.abs(fine) ** 2, (refined - 1) // 2, axis=(0, 1))
        per_pixel = refined * cells // across
        half = per_pixel * window // 2
        centre = light.shape[0] // 2
        cut = light[centre - half : centre + half, centre - half : centre + half]
        return cut.reshape(window, per_pixel, window, per_pixel).sum(axis=(1, 3))

    chosen = [0, 4, 17, 40]
    expected = np.zeros((4, 4))
    phase_rad = residual.draws_rad[1]
    for side in (distance_m, -distance_m):
        step = 1e-4
        signals = [
            (pixels(phase_rad + step * mode, side) - pixels(phase_rad - step * mode, side)) / (2 * step)
            for mode in np.asarray(residual.basis.modes)[chosen]
        ]
        mean = pixels(phase_rad, side)
        expected += np.einsum("ayx,byx,yx->ab", signals, signals, 1 / mean) / 2
    information = PlaneInformation(residual, Pixels(across, window), places_per_cell=3.0)
    found = information.of_pair(distance_m)[1][np.ix_(chosen, chosen)]
    # The cells cut the spectrum of the pupil's edge at half a cycle, on frequencies of another spacing: 1 %.
    np.testing.assert_allclose(found, expected, atol=0.01 * expected.max())


def test_no_planes_beat_the_quantum_limit(residual, information):
    planes = Planes((0.02 * UNIT_M, 0.05 * UNIT_M), (0.4, 0.6))
    for matrix in information.of_pair(0.02 * UNIT_M):
        assert np.linalg.eigvalsh(matrix).max() < 4 * 1.02  # 4 for each photon and rad^2 (Haffert et al. 2023); float32
    errors = loop_errors(information, planes, rate_hz=500.0)
    assert 1.2 < errors.loss < 4  # speckled light needs 2 to 2.3 times the photons, the window loses some


def test_what_is_left_open_is_the_inverse_of_all_that_is_known(residual):
    generator = np.random.default_rng(2)
    count = residual.basis.count
    root = generator.standard_normal((count, count)) / math.sqrt(count)
    errors = errors_with(residual, [root @ root.T, 2 * np.eye(count)], rate_hz=300.0)
    photons, prior = SMALL.photons_per_s / 300, residual.prior_rad2(300.0)
    left = [np.diag(np.linalg.inv(photons * one + np.diag(1 / prior))) for one in (root @ root.T, 2 * np.eye(count))]
    expected_rad2 = np.mean(left, axis=0)[: residual.controlled].sum()
    assert errors.photon_m == pytest.approx(WAVELENGTH_M / (2 * np.pi) * math.sqrt(expected_rad2), rel=1e-9)  # rounding


def test_fitting_and_lag_are_those_of_closed_forms(residual):
    # 0.2944 J^(-sqrt(3)/2) (D/r0)^(5/3) of Noll (1976) for Zernikes; Karhunen-Loeve modes do up to 10 % better.
    strength = (1.0 / Turbulence(0.17).fried_at(WAVELENGTH_M)) ** (5 / 3)
    noll = 0.2944 * (residual.controlled + 1) ** (-math.sqrt(3) / 2) * strength
    assert 0.75 * noll < residual.fitting_rad2() < 1.1 * noll
    # An obstruction of 0.2 and the pixels of the pupil are in the one, a sharp cut in the other.
    assert residual.fitting_rad2() == pytest.approx(BEYOND * 4.0 ** (-5 / 3) * strength, rel=0.2)
    # Frozen flow: structure function at wind times delay, for as much as the mirror holds of it.
    short = np.sum(residual.lag_rad2(5000.0)[: residual.told])
    whole = 6.88 * (10.0 / 5000 / Turbulence(0.17).fried_at(WAVELENGTH_M)) ** (5 / 3)
    assert 0.1 * whole < short < whole  # 2 mm: most of that difference is finer than the mirror


def test_the_best_rate_is_where_lag_and_photons_grow_alike(residual):
    found = best_of_rates(lambda rate_hz: ideal_errors(residual, rate_hz=rate_hz, loss=2.1).total_m)
    around = [ideal_errors(residual, rate_hz=found * one, loss=2.1).total_m for one in (0.8, 1.0, 1.25)]
    assert around[1] < around[0]
    assert around[1] < around[2]


def test_the_planes_that_are_found_leave_less_than_any_others_tried(information):
    found = search_planes(information, pairs=2, rate_hz=500.0)
    best_m = loop_errors(information, found, rate_hz=500.0).photon_m
    assert sum(found.shares) == pytest.approx(1)
    for near, far in itertools.combinations([one * SPREAD_M for one in COARSE], 2):
        even_m = loop_errors(information, Planes.evenly(near, far), rate_hz=500.0).photon_m
        assert best_m <= even_m * 1.001  # the split is rounded to a hundredth
    one = search_planes(information, pairs=1, rate_hz=500.0)
    assert len(one.distances_m) == 1
    for share in COARSE:
        alone_m = loop_errors(information, Planes.evenly(share * SPREAD_M), rate_hz=500.0).photon_m
        assert loop_errors(information, one, rate_hz=500.0).photon_m <= alone_m


def test_a_wider_window_and_finer_pixels_tell_more(residual):
    planes = Planes.evenly(0.03 * UNIT_M)
    tried = [Pixels(12, 14), Pixels(12, 20), Pixels(12, 40), Pixels(6, 20)]
    narrow, usual, wide, coarse = choices(residual, planes, pixels=tried, rate_hz=500.0, dark_share=0.0)
    assert narrow.caught < usual.caught < wide.caught <= 1.01  # cells of the pupil cut the spectrum: 1 %
    assert wide.errors.photon_m < usual.errors.photon_m < narrow.errors.photon_m
    assert coarse.errors.photon_m > wide.errors.photon_m
    dark = choices(residual, planes, pixels=tried[1:2], rate_hz=500.0, dark_share=0.01)[0]
    assert dark.errors.photon_m > usual.errors.photon_m  # read noise hides
