"""Long exposures and the size of their images, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import j0, j1

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.science.image_size import encircled_energy, energy_radius, full_width_half_maximum
from nlcwfs.science.long_exposure import LongExposure

DIAMETER_M = 8.0
WAVELENGTH_M = 1.6e-6
RESOLUTION_RAD = WAVELENGTH_M / DIAMETER_M
GRID = Grid((94, 97), 0.088)  # 91 pixels across, not square
PUPIL = circular_pupil(GRID, diameter_m=DIAMETER_M)
SKY = Grid((161, 164), RESOLUTION_RAD / 8)  # 10 lambda / D to either side


def begun(angles=SKY, wavelength_m=WAVELENGTH_M, dtype="float64"):
    return LongExposure.init(PUPIL, wavelength_m=wavelength_m, pixel_m=GRID.pixel_m, angles=angles, dtype=dtype)


def airy(angles, shift=(0.0, 0.0)):
    radius = np.pi * np.hypot(angles.y_m - shift[0], angles.x_m - shift[1]) / RESOLUTION_RAD
    return np.where(radius < 1e-6, 1, (2 * j1(np.maximum(radius, 1e-6)) / np.maximum(radius, 1e-6)) ** 2)


@pytest.fixture(scope="module")
def perfect():
    return begun().add(np.zeros(GRID.shape))


@pytest.mark.parametrize("radius", [0.5, 1.22, 2.233, 5.0, 9.7])
def test_a_perfect_star_s_encircled_energy_is_rayleigh_s(perfect, radius):
    """1 - J0^2 - J1^2 of pi r D / lambda (Rayleigh 1881; Born & Wolf, sec. 8.5.2)."""
    expected = 1 - j0(np.pi * radius) ** 2 - j1(np.pi * radius) ** 2
    found = encircled_energy(perfect.image, SKY, radius_rad=radius * RESOLUTION_RAD, total=float(perfect.total))
    # The pupil's edge pixels hold less light than a disc has there: a part p of a pixel has amplitude p, light p^2.
    assert found == pytest.approx(expected, abs=0.01)
    # With the light of a true disc only the sampling of the sky is left: (pi / 8)^2 / 24 = 0.6 % of the core's 0.5.
    grown = found * float(perfect.total) * SKY.pixel_m**2 / (4 / np.pi * RESOLUTION_RAD**2)
    assert grown == pytest.approx(expected, abs=3e-3)


def test_the_radius_of_a_share_is_where_that_share_is(perfect):
    total = 4 / np.pi * (RESOLUTION_RAD / SKY.pixel_m) ** 2  # of the Airy pattern, over all directions
    for radius in (0.5, 1.22, 5.0):
        share = float(1 - j0(np.pi * radius) ** 2 - j1(np.pi * radius) ** 2)
        found = energy_radius(airy(SKY), SKY, fraction=share, total=total) / RESOLUTION_RAD
        slope = 2 * np.pi * j1(np.pi * radius) ** 2 / (np.pi * radius) + 1e-3  # of the share: flat at a dark ring
        assert found == pytest.approx(radius, abs=3e-3 / slope)  # as above


def test_the_window_s_own_light_is_the_whole_when_none_is_given():
    spot = np.exp(-((SKY.y_m - 0.2e-6) ** 2 + SKY.x_m**2) / (2 * 0.3e-6**2))
    largest = encircled_energy(spot, SKY, radius_rad=80 * SKY.pixel_m)
    assert largest == pytest.approx(1, abs=1e-6)
    centred = np.exp(-(SKY.y_m**2 + SKY.x_m**2) / (2 * 0.3e-6**2))
    found = energy_radius(centred, SKY, fraction=0.8)
    assert found == pytest.approx(0.3e-6 * np.sqrt(-2 * np.log(0.2)), rel=2e-3)  # 12 pixels a sigma


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.13, -0.41), (-2.3, 1.07)])
@pytest.mark.parametrize("pixels", [3, 8])
def test_an_airy_disc_is_1_029_wide_wherever_it_falls(pixels, shift):
    angles = Grid((12 * pixels, 12 * pixels + 1), RESOLUTION_RAD / pixels)
    image = airy(angles, (shift[0] * RESOLUTION_RAD, shift[1] * RESOLUTION_RAD))
    found = full_width_half_maximum(image, angles) / RESOLUTION_RAD
    assert found == pytest.approx(1.02899, rel=4e-3 if pixels == 3 else 2e-4)


def test_an_image_longer_than_wide_has_its_mean_width():
    angles = Grid((81, 90), 0.1)
    spot = np.exp(-(angles.y_m**2 / (2 * 1.2**2) + angles.x_m**2 / (2 * 0.8**2)))
    direction = np.linspace(0, 2 * np.pi, 2001)[:-1]
    radius = np.sqrt(2 * np.log(2) / (np.cos(direction) ** 2 / 0.8**2 + np.sin(direction) ** 2 / 1.2**2))
    assert full_width_half_maximum(spot, angles) == pytest.approx(2 * radius.mean(), rel=1e-3)


def test_small_gaussian_aberrations_cost_what_marechal_says():
    """Strehl exp(-sigma^2), with sigma of the light's phase: exact for a Gaussian phase, alike on every pixel."""
    sigma_rad, draws = 0.4, 400
    basis = modal_basis(PUPIL, GRID, diameter_m=DIAMETER_M, count=60, kind="disc-harmonics")
    rng = np.random.default_rng(1)
    scale_m = sigma_rad / np.sqrt(60) * WAVELENGTH_M / (2 * np.pi)

    @jax.jit
    def step(exposure, coefficients_m):
        return exposure.add(basis.combine(coefficients_m)), None

    drawn_m = jnp.asarray(scale_m * rng.normal(size=(draws, 60)))
    exposure, _ = jax.lax.scan(step, begun(Grid((1, 1), RESOLUTION_RAD)), drawn_m)
    assert int(exposure.exposures) == draws
    assert float(exposure.strehl) == pytest.approx(np.exp(-(sigma_rad**2)), rel=0.02)
    assert float(exposure.image[0, 0]) == pytest.approx(float(exposure.strehl), rel=1e-12)  # the axis is the image


def test_jitter_blurs_the_image_as_a_convolution_does():
    """A tilt of a wavelengths over the diameter moves the image by a lambda / D, so Gaussian tilts blur it."""
    jitter, draws = 0.45, 4000  # lambda / D, each axis
    angles = Grid((57, 63), RESOLUTION_RAD / 6)
    rng = np.random.default_rng(2)
    tilts = rng.normal(size=(draws // 2, 2)) * jitter
    tilts = np.concatenate([tilts, -tilts])  # the mean is zero: half the noise
    ramps_m = np.stack([GRID.y_m + 0 * GRID.x_m, GRID.x_m + 0 * GRID.y_m]) * WAVELENGTH_M / DIAMETER_M

    def step(exposure, tilt):
        return exposure.add(jnp.tensordot(tilt, jnp.asarray(ramps_m), axes=1)), None

    exposure, _ = jax.jit(lambda start, along: jax.lax.scan(step, start, along))(begun(angles), jnp.asarray(tilts))
    wide = Grid((57 * 3, 63 * 3), angles.pixel_m)
    blurred = gaussian_filter(airy(wide), jitter * 6, truncate=6)[57:-57, 63:-63]
    # 5 sigma of 4000 draws of an image that varies by 0.3 where it is steepest: 0.02; the sum does better.
    np.testing.assert_allclose(exposure.image, blurred, atol=0.012)
    assert float(exposure.strehl) == pytest.approx(float(blurred[28, 31]), abs=0.012)
    width = full_width_half_maximum(exposure.image, angles)
    assert width == pytest.approx(full_width_half_maximum(blurred, angles), rel=0.015)
    assert width > 1.3 * 1.029 * RESOLUTION_RAD


def test_images_are_averaged_and_tilt_keeps_its_sign(perfect):
    tilt_m = 2 * WAVELENGTH_M / DIAMETER_M * (GRID.x_m + 0 * GRID.y_m)
    both = perfect.add(tilt_m)
    expected = (airy(SKY) + airy(SKY, (0, 2 * RESOLUTION_RAD))) / 2  # towards +x
    np.testing.assert_allclose(both.image, expected, atol=1e-3)  # the edge of the pupil on 91 pixels
    assert int(both.exposures) == 2
    assert float(both.strehl) == pytest.approx(expected[80, 81:83].max(), abs=0.02)  # the axis is between two pixels
    assert float(perfect.strehl) == pytest.approx(1, abs=1e-12)


def test_an_image_at_another_wavelength_is_as_much_larger():
    red = begun(wavelength_m=2 * WAVELENGTH_M).add(np.zeros(GRID.shape))
    assert full_width_half_maximum(red.image, SKY) == pytest.approx(2 * 1.02899 * RESOLUTION_RAD, rel=2e-3)
    assert red.image_sum.dtype == jnp.float64
    assert begun(dtype="float32").add(np.zeros(GRID.shape)).image.dtype == jnp.float32


def test_what_does_not_fit_in_the_window_is_refused(perfect):
    with pytest.raises(SamplingError, match="radius_rad: must be positive and within the window"):
        encircled_energy(perfect.image, SKY, radius_rad=12 * RESOLUTION_RAD)
    with pytest.raises(SamplingError, match=r"fraction: must be at most 0\.9.*, what the window holds, got 0.999"):
        energy_radius(perfect.image, SKY, fraction=0.999, total=float(perfect.total))
    with pytest.raises(SettingsError, match=r"fraction: must be between 0 and 1, got 1\.5"):
        energy_radius(perfect.image, SKY, fraction=1.5)
    with pytest.raises(SettingsError, match="image: must hold light"):
        encircled_energy(np.zeros(SKY.shape), SKY, radius_rad=RESOLUTION_RAD)
    with pytest.raises(SettingsError, match="image: must hold light"):
        full_width_half_maximum(np.zeros(SKY.shape), SKY)
    with pytest.raises(SamplingError, match=r"image.shape: must hold the image down to half .*, got \(5, 5\)"):
        full_width_half_maximum(airy(Grid((5, 5), RESOLUTION_RAD / 20)), Grid((5, 5), RESOLUTION_RAD / 20))
