"""The statistics of turbulence: spectrum, structure function, Noll's variances, independence."""

import itertools
import math

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, j0, kv

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence

WAVELENGTH_M = 0.5e-6
TO_RAD = 2 * np.pi / WAVELENGTH_M


def draw_rad(turbulence, *, shape, pixel_m, count, seed) -> np.ndarray:
    """Phase of many screens at the wavelength where r0 holds."""
    screens = PhaseScreens.build(turbulence, shape=shape, pixel_m=pixel_m, dtype="float32")
    keys = jax.random.split(jax.random.key(seed), count)
    return TO_RAD * np.asarray(jax.jit(lambda keys: jax.lax.map(screens.draw, keys, batch_size=50))(keys), float)


def structure(phase_rad: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Mean square difference over a separation, for every screen."""
    height, width = phase_rad.shape[1:]
    first = phase_rad[:, max(0, -rows) : height - max(0, rows), max(0, -columns) : width - max(0, columns)]
    second = phase_rad[:, max(0, rows) : height + min(0, rows), max(0, columns) : width + min(0, columns)]
    return np.mean((second - first) ** 2, axis=(1, 2))


def von_karman(separation_m: float, fried_m: float, outer_scale_m: float) -> float:
    """Structure function of the phase (Jenkins 1998, MNRAS 294, 69; Conan 2008, JOSA A 25, 527, eq. 12)."""
    argument = 2 * np.pi * separation_m / outer_scale_m
    strength = 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    shape = gamma(5 / 6) / 2 ** (1 / 6) - argument ** (5 / 6) * kv(5 / 6, argument)
    return strength * (outer_scale_m / fried_m) ** (5 / 3) * shape


def noll_variance(radial_order: int) -> float:
    """Variance of one Zernike mode for D = r0 (Noll 1976, JOSA 66, 207, eq. 25; spectrum 0.0229 f^-11/3)."""
    n = radial_order
    bessel = gamma(14 / 3) * gamma(n - 5 / 6) / (2 ** (14 / 3) * gamma(17 / 6) ** 2 * gamma(n + 23 / 6))
    return 8 * np.pi ** (8 / 3) * 0.0229 * (n + 1) * bessel


def test_the_tilt_of_kolmogorov_s_air_is_noll_s():
    """D / r0 = 8 / 0.2 at the wavelength of r0, and a colour with twice as long waves; 3 digits of Noll's table."""
    air = Turbulence(0.2, WAVELENGTH_M)
    expected = math.sqrt(noll_variance(1) * 40 ** (5 / 3))
    assert air.tilt_rms_rad(WAVELENGTH_M, diameter_m=8.0) == pytest.approx(expected, rel=2e-3)
    assert air.tilt_rms_rad(2 * WAVELENGTH_M, diameter_m=8.0) == pytest.approx(expected / 2, rel=2e-3)


# ------------------------------------------------------------------------------------------ the spectrum


@pytest.mark.parametrize("separation_m", [0.1, 1.0, 8.0])
@pytest.mark.parametrize("outer_scale_m", [math.inf, 25.0, 4.0])
def test_the_spectrum_integrates_to_the_structure_function(separation_m, outer_scale_m):
    air = Turbulence(0.16, WAVELENGTH_M, outer_scale_m)

    def per_decade(log_frequency: float) -> float:
        frequency = math.exp(log_frequency)
        power = TO_RAD**2 * air.opd_spectrum(np.array([frequency]))[0]
        angle = 2 * np.pi * frequency * separation_m
        seen = 1 - j0(angle) if angle > 0.01 else angle**2 / 4 - angle**4 / 64  # 1 - J0 loses its digits
        return 4 * np.pi * frequency**2 * power * seen

    edges = np.log(np.array([1e-8, 1e-2, 1, 10, 100]) / separation_m)
    got = sum(quad(per_decade, a, b, limit=400)[0] for a, b in itertools.pairwise(edges))
    if math.isinf(outer_scale_m):
        expected = 6.88 * (separation_m / 0.16) ** (5 / 3)
    else:
        expected = von_karman(separation_m, 0.16, outer_scale_m)
    # 0.0229 and 6.88 are rounded to three digits; the tail beyond 100 / separation holds 0.1 %.
    np.testing.assert_allclose(got, expected, rtol=5e-3)


def test_a_longer_wavelength_sees_the_same_path():
    blue = Turbulence(0.16, 0.5e-6, 25.0)
    red = Turbulence(blue.fried_at(0.85e-6), 0.85e-6, 25.0)
    frequency = np.geomspace(1e-3, 10, 7)
    np.testing.assert_allclose(red.opd_spectrum(frequency), blue.opd_spectrum(frequency), rtol=1e-12)
    np.testing.assert_allclose(red.fried_m, 0.16 * 1.7 ** (6 / 5), rtol=1e-12)


def test_the_papers_609_nm_are_eight_fried_lengths():
    # Phase variance 1.0299 (D / r0)^(5/3) at any wavelength (Noll 1976, table IV).
    air = Turbulence.from_rms(opd_rms_m=609e-9, diameter_m=8.0)
    for wavelength_m in (0.5e-6, 0.65e-6, 1.6e-6):
        variance = 1.0299 * (8.0 / air.fried_at(wavelength_m)) ** (5 / 3)
        np.testing.assert_allclose(np.sqrt(variance) * wavelength_m / (2 * np.pi), 609e-9, rtol=1e-12)
    np.testing.assert_allclose(8.0 / air.fried_at(0.65e-6), 8.2, atol=0.05)  # Guyon 2010 rounds so
    assert math.isinf(air.outer_scale_m)


def test_seeing_is_the_width_of_a_long_exposure():
    # Where the long exposure exp(-3.44 (l d / r0)^(5/3)) of a large telescope falls to half its peak.
    air = Turbulence.from_seeing(seeing_arcsec=0.8, outer_scale_m=30.0)
    assert air.outer_scale_m == 30.0
    assert air.wavelength_m == WAVELENGTH_M

    def blurred(angle_rad: float) -> float:
        scale = angle_rad * air.fried_m / WAVELENGTH_M
        return quad(lambda u: u * math.exp(-3.44 * u ** (5 / 3)) * j0(2 * np.pi * u * scale), 0, 6)[0]

    half_width = 0.4 * np.pi / 180 / 3600
    np.testing.assert_allclose(blurred(half_width) / blurred(0.0), 0.5, atol=2e-3)  # 0.976 has three digits


# ------------------------------------------------------------------------------------------- the screens


def test_differences_across_a_screen_follow_kolmogorovs_law():
    # From four pixels to most of the screen.
    phase = draw_rad(Turbulence(1.0), shape=(48, 42), pixel_m=0.25, count=1500, seed=11)
    for steps in (4, 8, 16, 32):
        for rows, columns in ((steps, 0), (0, steps)):
            sample = structure(phase, rows, columns)
            expected = 6.88 * (0.25 * steps) ** (5 / 3)
            error = 5 * sample.std() / np.sqrt(sample.size)  # 5 sigma of 1500 independent screens
            assert error < 0.17 * expected  # else the test could not tell
            # 2 % more for the finite cells of the low frequencies.
            np.testing.assert_allclose(sample.mean(), expected, atol=error + 0.02 * expected)


def test_no_direction_is_preferred():
    phase = draw_rad(Turbulence(1.0), shape=(20, 27), pixel_m=0.25, count=1000, seed=12)
    along_x = structure(phase, 0, 10)
    for rows, columns in ((10, 0), (6, 8), (8, -6), (-8, 6), (-6, -8)):  # all ten pixels long
        difference = structure(phase, rows, columns) - along_x
        error = 5 * difference.std() / np.sqrt(difference.size)  # 5 sigma
        # Square cells favour no axis by more than 2 %.
        np.testing.assert_allclose(difference.mean(), 0.0, atol=error + 0.02 * along_x.mean())


def test_the_low_orders_have_nolls_variances():
    size, count = 32, 8000
    phase = draw_rad(Turbulence(1.0), shape=(size, size), pixel_m=1.0, count=count, seed=13)
    y, x = ((np.arange(size) - (size - 1) / 2) / (size / 2) for _ in range(2))
    y, x = np.meshgrid(y, x, indexing="ij")
    square = x**2 + y**2
    disc = square <= 1
    diameter = 2 * np.sqrt(disc.sum() / np.pi)  # of the disc of the same area, in r0
    modes = {
        0: [np.ones_like(x)],
        1: [2 * x, 2 * y],
        2: [np.sqrt(3) * (2 * square - 1), np.sqrt(6) * 2 * x * y, np.sqrt(6) * (x**2 - y**2)],
        3: [
            np.sqrt(8) * (3 * square - 2) * x,
            np.sqrt(8) * (3 * square - 2) * y,
            np.sqrt(8) * (x**3 - 3 * x * y**2),
            np.sqrt(8) * (3 * x**2 * y - y**3),
        ],
    }
    shapes = np.array([mode[disc] for family in modes.values() for mode in family])
    coefficients = phase[:, disc] @ np.linalg.pinv(shapes)
    variance = np.mean(coefficients**2, axis=0) / diameter ** (5 / 3)

    # 8000 screens know a variance to 1.6 %, the mean of two, three, four to 1.1, 0.9, 0.8 %. The cells of the
    # low frequencies and the edge's pixels cost 3 % of one mode, 1 % of the mean of an order, 2.5 % of tilt.
    np.testing.assert_allclose(variance[1:3].mean(), noll_variance(1), rtol=0.025 + 3 * 0.011)
    np.testing.assert_allclose(variance[3:6].mean(), noll_variance(2), rtol=0.01 + 3 * 0.009)
    np.testing.assert_allclose(variance[6:10].mean(), noll_variance(3), rtol=0.01 + 3 * 0.008)
    np.testing.assert_allclose(variance[3:6], noll_variance(2), rtol=0.03 + 4 * 0.016)
    np.testing.assert_allclose(variance[6:10], noll_variance(3), rtol=0.03 + 4 * 0.016)

    # All orders together, and without tilt (Noll 1976, table IV).
    total = phase[:, disc].var(axis=1)
    np.testing.assert_allclose(total.mean(), 1.0299 * diameter ** (5 / 3), rtol=0.015 + 3 * 0.010)
    rest = total - np.sum(coefficients[:, 1:3] ** 2 * shapes[1:3].var(axis=1), axis=1)
    np.testing.assert_allclose(rest.mean(), 0.134 * diameter ** (5 / 3), rtol=0.01 + 3 * 0.004)


def test_the_same_key_gives_the_same_screen_and_another_key_an_unrelated_one():
    screens = PhaseScreens.build(Turbulence(0.2), shape=(24, 31), pixel_m=0.2, dtype="float64")
    first, again, other = (np.asarray(screens.draw(jax.random.key(seed))) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert abs(first - other).max() > 0.5 * first.std()

    phase = draw_rad(Turbulence(1.0), shape=(24, 30), pixel_m=0.2, count=400, seed=14)
    flat = phase.reshape(400, -1)
    flat = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    overlap = np.sum(flat[:-1] * flat[1:], axis=1)  # each screen with the next
    np.testing.assert_allclose(overlap.mean(), 0.0, atol=5 * overlap.std() / np.sqrt(overlap.size))
    # Tilt dominates: two directions in a plane, whose cosine has a standard deviation below 1 / sqrt(2).
    assert 0.4 < overlap.std() < 0.72


def test_screens_have_no_piston_and_scale_with_the_strength_of_the_air():
    weak, strong = (
        np.asarray(PhaseScreens.build(air, shape=(24, 31), pixel_m=0.2, dtype="float64").draw(jax.random.key(3)))
        for air in (Turbulence(0.4), Turbulence(0.1))
    )
    # The mean is removed to the rounding of waves millions of times longer than the screen.
    np.testing.assert_allclose(weak.mean(), 0.0, atol=1e-10 * weak.std())
    np.testing.assert_allclose(strong, weak * 4 ** (5 / 6), rtol=1e-9, atol=1e-9 * abs(strong).max())
