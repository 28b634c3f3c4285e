"""How much of the turbulence a mirror leaves, and what noise does to it."""

import jax
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.mirror.mirror import WORTH_FITTING, Mirror
from nlcwfs.mirror.settings import MirrorSettings

DIAMETER_M = 8.0
GRID = Grid((82, 82), 0.1)
PUPIL = circular_pupil(GRID, diameter_m=DIAMETER_M)
LIGHT = PUPIL**2 / np.sum(PUPIL**2)
DRAWS = 60

NOLL_LEFT = {3: 0.134, 6: 0.0648, 10: 0.0401, 15: 0.0279, 21: 0.0208}
"""Noll 1976, table IV: rad^2 left after so many Zernikes, piston among them, for D / r0 = 1."""


@pytest.fixture(scope="module")
def screens():
    """Phase in rad for D / r0 = 1: at a wavelength of 2 pi metres, a metre is a radian."""
    air = Turbulence(fried_m=DIAMETER_M, wavelength_m=2 * np.pi)
    drawn = PhaseScreens.build(air, shape=GRID.shape, pixel_m=GRID.pixel_m, dtype="float64")
    return [np.asarray(drawn.draw(jax.random.key(number))) for number in range(DRAWS)]


def left_rad2(mirror, screens):
    """Mean variance of what the best command leaves, and its standard error."""
    found = []
    for screen in screens:
        rest = np.where(PUPIL > 0, screen - np.asarray(mirror.opd_m(mirror.fitted(screen))), 0)
        rest = rest - np.sum(LIGHT * rest)
        found.append(np.sum(LIGHT * rest**2))
    return np.mean(found), np.std(found) / np.sqrt(len(found))


def beyond_pixels_rad2(pixel):
    """Variance of waves finer than half a cycle per pixel along an axis, which screens lack; `pixel` in units of D."""
    angle = (np.arange(2000) + 0.5) * np.pi / 4 / 2000  # an eighth of the square
    nearest = 0.5 / pixel / np.cos(angle)
    return 0.0229 * 2 * np.pi * 0.6 * np.mean(nearest ** (-5 / 3))


def built(**settings):
    return Mirror.build(MirrorSettings(**settings), PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")


@pytest.mark.parametrize("piston_too", list(NOLL_LEFT))
def test_zernikes_leave_what_noll_says(screens, piston_too):
    left, doubt = left_rad2(built(kind="zernike", modes=piston_too - 1), screens)
    expected = NOLL_LEFT[piston_too] - beyond_pixels_rad2(GRID.pixel_m / DIAMETER_M)
    # 5 sigma of the draws; 2 % because the light of rim pixels, the square of their area, makes the disc smaller.
    assert left == pytest.approx(expected, abs=5 * doubt + 0.02 * expected)
    assert doubt < 0.12 * expected


def test_many_zernikes_leave_what_noll_s_asymptote_says(screens):
    left, doubt = left_rad2(built(kind="zernike", modes=189), screens)
    expected = 0.2944 * 190 ** (-np.sqrt(3) / 2) - beyond_pixels_rad2(GRID.pixel_m / DIAMETER_M)
    assert left == pytest.approx(expected, abs=5 * doubt + 0.06 * expected)  # Noll's fit, seen to be 5 % off by 190


@pytest.mark.parametrize("count", [2, 30, 200])
def test_karhunen_loeve_modes_leave_what_their_variances_say(screens, count):
    left, doubt = left_rad2(built(modes=count), screens)
    basis = modal_basis(PUPIL, GRID, diameter_m=DIAMETER_M, count=count)
    expected = basis.kolmogorov_total_rad2 - np.sum(basis.kolmogorov_rad2)
    # The theory on pixels folds what is finer than they into them, the screens lack it.
    expected -= beyond_pixels_rad2(GRID.pixel_m / DIAMETER_M)
    assert left == pytest.approx(expected, abs=5 * doubt + 0.02 * expected)


def test_ideal_modes_up_to_a_cutoff_leave_the_spectrum_beyond_it(screens):
    """0.0863 f^(-5/3) rad^2 beyond f cycles per aperture, the integral of Kolmogorov's spectrum."""
    cutoff = 10.0
    expected = 0.0229 * 2 * np.pi * 0.6 * cutoff ** (-5 / 3) - beyond_pixels_rad2(GRID.pixel_m / DIAMETER_M)
    for kind in ("karhunen-loeve", "fourier"):
        left, doubt = left_rad2(built(kind=kind, cutoff_cpa=cutoff), screens)
        # The edge of the pupil smears frequencies: 10 %. Waves of a larger square reach a little further.
        assert left == pytest.approx(expected, abs=5 * doubt + 0.1 * expected)


@pytest.mark.parametrize("across", [9, 17])
def test_gaussian_actuators_leave_the_usual_share_of_a_pitch(screens, across):
    """0.23 to 0.35 (d / r0)^(5/3) for a pitch d (Hudgin 1977, JOSA 67, 393)."""
    mirror = built(kind="actuators", actuators_across=across)
    left, doubt = left_rad2(mirror, screens)
    left += beyond_pixels_rad2(GRID.pixel_m / DIAMETER_M)
    share = left * (across - 1) ** (5 / 3)
    assert 0.23 - 5 * doubt < share < 0.35


@pytest.mark.parametrize("kind", ["karhunen-loeve", "zernike", "fourier", "actuators"])
def test_noise_of_the_pixels_does_not_blow_up(kind):
    """The shape takes rank / pixels of the noise, whatever the commands; these are bounded by the truncation."""
    pupil = np.ones(GRID.shape) * (PUPIL > 0.5)  # all or nothing: every pixel counts alike
    settings = MirrorSettings(kind=kind, cutoff_cpa=8.0, actuators_across=17)
    mirror = Mirror.build(settings, pupil, GRID, diameter_m=DIAMETER_M, dtype="float64")
    rng, pixels = np.random.default_rng(8), int(pupil.sum())
    noise = rng.normal(size=(40, *GRID.shape))
    commands = np.stack([np.asarray(mirror.fitted(each)) for each in noise])
    shapes = np.stack([np.asarray(mirror.opd_m(each))[pupil > 0] for each in commands])
    # Chi square with 40 * rank degrees of freedom: 5 sigma.
    expected = mirror.rank / pixels
    assert np.mean(shapes**2) == pytest.approx(expected, rel=5 * np.sqrt(2 / (40 * mirror.rank)))
    strongest = np.linalg.norm(np.asarray(mirror.shapes), ord=2) / np.sqrt(pixels)
    assert mirror.condition <= 1 / WORTH_FITTING
    worst = mirror.condition / strongest / np.sqrt(pixels)  # all of a command in its least effective combination
    assert np.sqrt(np.mean(commands**2, axis=0)).max() < worst * (1 + 5 / np.sqrt(80))
