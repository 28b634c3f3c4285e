"""Light against closed forms: which way it goes, where it focuses, how it fades; complex amplitudes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.special import j0, j1

from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fraunhofer import propagate_fraunhofer
from nlcwfs.beam.fresnel import propagate_fresnel
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor

WAVELENGTH_M = 0.85e-6
WAVENUMBER_PER_M = 2 * np.pi / WAVELENGTH_M


def centres_m(shape: tuple[int, int], pixel_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows from the smallest y, columns from the smallest x, zero in the middle."""
    y_m, x_m = ((np.arange(n) - (n - 1) / 2) * pixel_m for n in shape)
    return y_m[:, None], x_m[None, :]


def travel(field: np.ndarray, distance_m: float, pixel_m: float) -> np.ndarray:
    near = jnp.asarray(field, complex)
    return np.asarray(propagate_fresnel(near, distance_m=distance_m, wavelength_m=WAVELENGTH_M, pixel_m=pixel_m))


# -------------------------------------------------------------------------------------------- Gaussian beam


def gaussian_beam(position_m, distance_m, *, waist_m, centre_m, slope):
    """One dimension of a beam that starts at its waist, off the axis and inclined (Goodman 2005, sec. 4.2).

    Fourier transform exp(-(x/w)^2), multiply by exp(-i pi lambda z f^2), transform back.
    """
    spread = 1 + 1j * WAVELENGTH_M * distance_m / (np.pi * waist_m**2)
    carrier = np.exp(1j * WAVENUMBER_PER_M * (slope * (position_m - centre_m) - slope**2 * distance_m / 2))
    offset_m = position_m - centre_m - slope * distance_m
    return carrier * np.exp(-(offset_m**2) / (waist_m**2 * spread)) / np.sqrt(spread)


@pytest.mark.parametrize("distance_m", [-3.5e6, -3e5, 3e5, 2.5e6])
@pytest.mark.parametrize("shape", [(200, 231), (231, 200)])
def test_a_gaussian_beam_spreads_and_curves_as_its_closed_form(distance_m, shape):
    y_m, x_m = centres_m(shape, 0.12)
    in_y = {"waist_m": 1.1, "centre_m": 0.7, "slope": 3e-7}
    in_x = {"waist_m": 1.6, "centre_m": -1.2, "slope": -5e-7}
    near = gaussian_beam(y_m, 0.0, **in_y) * gaussian_beam(x_m, 0.0, **in_x)
    expected = gaussian_beam(y_m, distance_m, **in_y) * gaussian_beam(x_m, distance_m, **in_x)
    # The beam is below 1e-12 at the edge of the window and at the last frequency: rounding is left.
    np.testing.assert_allclose(travel(near, distance_m, 0.12), expected, atol=1e-11)


# ------------------------------------------------------------------------------------------ circular pupil


def behind_a_disc(radius_m: np.ndarray, distance_m: float, *, disc_radius_m: float) -> np.ndarray:
    """Fresnel's integral over a disc of unit amplitude, as a Hankel transform (Goodman 2005, eq. 4-17)."""

    def ring(rho_m: float) -> np.ndarray:
        bend = np.exp(0.5j * WAVENUMBER_PER_M * rho_m**2 / distance_m)
        return bend * j0(WAVENUMBER_PER_M * radius_m * rho_m / distance_m) * rho_m

    integral, _ = quad_vec(ring, 0, disc_radius_m, epsabs=1e-9, epsrel=1e-9)
    front = WAVENUMBER_PER_M / (1j * distance_m) * np.exp(0.5j * WAVENUMBER_PER_M * radius_m**2 / distance_m)
    return front * integral


def on_axis(distance_m: float, disc_radius_m: float) -> complex:
    """Squared: 4 sin^2(pi N / 2) for the Fresnel number N = a^2 / (lambda z)."""
    return 1 - np.exp(1j * np.pi * disc_radius_m**2 / (WAVELENGTH_M * distance_m))


@pytest.mark.parametrize(("distance_m", "coarse_m", "window_m"), [(2.5e6, 0.2, 32.0), (-3.5e6, 0.24, 38.0)])
def test_the_light_behind_a_disc_converges_to_the_exact_integral(distance_m, coarse_m, window_m):
    axis_error, rms_error = [], []
    for pixel_m in (coarse_m, coarse_m / 2, coarse_m / 4):
        size = 2 * round(window_m / pixel_m / 2) + 1  # odd: a pixel lies on the axis
        disc = circular_pupil(Grid((size, size), pixel_m), diameter_m=8.0)
        far = travel(disc, distance_m, pixel_m)
        axis_error.append(abs(far[size // 2, size // 2] - on_axis(distance_m, 4.0)))
        y_m, x_m = centres_m((size, size), pixel_m)
        radius_m = np.hypot(y_m, x_m)
        seen = np.random.default_rng(3).choice(np.flatnonzero(radius_m < 6.0), 200, replace=False)
        exact = behind_a_disc(radius_m.flat[seen], distance_m, disc_radius_m=4.0)
        rms_error.append(np.sqrt(np.mean(abs(far.flat[seen] - exact) ** 2)))
    # Pixels average the edge: second order on the axis, where all of the edge interferes in step.
    order = np.log2(np.array(axis_error[:-1]) / axis_error[1:])
    np.testing.assert_allclose(order, 2.0, atol=0.3)
    assert axis_error[-1] < 0.02
    assert rms_error[-1] < 0.006
    assert np.all(np.diff(rms_error) < 0)


def test_the_exact_integral_agrees_with_its_value_on_the_axis():
    got = behind_a_disc(np.zeros(1), 2.5e6, disc_radius_m=4.0)[0]
    np.testing.assert_allclose(got, on_axis(2.5e6, 4.0), atol=1e-8)  # the quadrature's own tolerance
    np.testing.assert_allclose(abs(got) ** 2, 4 * np.sin(np.pi / 2 * 16 / (WAVELENGTH_M * 2.5e6)) ** 2, atol=1e-8)


@pytest.mark.parametrize("distance_m", [2.5e6, -2.5e6])
def test_a_hollow_wavefront_focuses_where_its_radius_says(distance_m):
    # A path shorter by r^2 / 2z at the edge is a sphere that closes at z: downstream for z > 0.
    size, pixel_m, radius_m = 481, 0.05, 2.0
    grid = Grid((size, size), pixel_m)
    disc = circular_pupil(grid, diameter_m=2 * radius_m)
    y_m, x_m = centres_m((size, size), pixel_m)
    opd_m = jnp.asarray(-(x_m**2 + y_m**2) / (2 * distance_m))
    near = np.asarray(pupil_field(disc, opd_m, wavelength_m=WAVELENGTH_M, photons=float(np.sum(disc**2))))
    focus, opposite = travel(near, distance_m, pixel_m), travel(near, -distance_m, pixel_m)

    fresnel_number = radius_m**2 / (WAVELENGTH_M * distance_m)
    row = size // 2
    radial = WAVENUMBER_PER_M * radius_m * x_m[0] / distance_m
    airy = np.where(radial == 0, 1.0, 2 * j1(radial) / np.where(radial == 0, 1.0, radial))
    bend = np.exp(0.5j * WAVENUMBER_PER_M * x_m[0] ** 2 / distance_m)
    expected = -1j * np.pi * fresnel_number * bend * airy
    inside = abs(x_m[0]) < 3.0
    # The antialiased edge of 80 pixels across leaves 0.2 % of the peak of 5.9.
    np.testing.assert_allclose(focus[row, inside], expected[inside], atol=0.02)
    np.testing.assert_allclose(focus[inside, row], expected[inside], atol=0.02)
    # On the other side the same curvature counts twice: half the amplitude of a Fresnel number of 2 N.
    np.testing.assert_allclose(abs(opposite[row, row]) ** 2, np.sin(np.pi * fresnel_number) ** 2, atol=0.02)


# ------------------------------------------------------------------------------------------ tilt and ripple


def gaussian_sensor(shape, pixel_m, distances_m) -> tuple[CurvatureSensor, np.ndarray, np.ndarray]:
    y_m, x_m = centres_m(shape, pixel_m)
    pupil = np.exp(-(((x_m + 0.6) / 1.2) ** 2) - ((y_m - 0.9) / 1.0) ** 2)
    monochromatic = Spectrum.monochromatic(WAVELENGTH_M)
    grid = Grid(shape, pixel_m)
    sensor = CurvatureSensor.build(pupil, grid, distances_m=distances_m, spectrum=monochromatic, dtype="float64")
    return sensor, y_m, x_m


@pytest.mark.parametrize(("slope_y", "slope_x"), [(0.0, 4e-7), (3e-7, 0.0), (-2e-7, 3e-7)])
@pytest.mark.parametrize("shape", [(120, 151), (151, 120)])
def test_a_path_that_grows_towards_x_or_y_moves_the_light_there_downstream(slope_y, slope_x, shape):
    distances_m = (2.5e6, -2.5e6, 3e5)
    sensor, y_m, x_m = gaussian_sensor(shape, 0.15, distances_m)
    planes = np.asarray(sensor.images(jnp.asarray(slope_y * y_m + slope_x * x_m), 3.0).photons)
    for image, distance_m in zip(planes, distances_m, strict=True):
        # Centroids follow straight rays exactly; the beam is dark at the edge of the window.
        np.testing.assert_allclose(np.sum(image * y_m), 0.9 + slope_y * distance_m, atol=1e-9)
        np.testing.assert_allclose(np.sum(image * x_m), -0.6 + slope_x * distance_m, atol=1e-9)


@pytest.mark.parametrize("half_periods", [0.1, 0.5, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("orders", [(3, 0), (0, 4), (2, -5)])
def test_a_ripple_shines_as_the_sine_of_its_distance(half_periods, orders):
    # 1 + i e cos(2 pi f x), travelled: intensity 1 + 2 e sin(pi lambda z f^2) cos(2 pi f x).
    # A crest of the path is bright downstream; the first null lies at lambda z f^2 = 1.
    shape, pixel_m = (30, 44), 0.2
    y_m, x_m = centres_m(shape, pixel_m)
    frequency_y, frequency_x = (order / (n * pixel_m) for order, n in zip(orders, shape, strict=True))
    distance_m = half_periods / (WAVELENGTH_M * (frequency_y**2 + frequency_x**2))
    sensor = CurvatureSensor.build(
        np.ones(shape),
        Grid(shape, pixel_m),
        distances_m=(distance_m, -distance_m),
        spectrum=Spectrum.monochromatic(WAVELENGTH_M),
        dtype="float64",
    )
    wave = np.cos(2 * np.pi * (frequency_y * y_m + frequency_x * x_m) + 0.4)

    def contrast(opd_m):
        return sensor.images(opd_m, 2.0 * wave.size).photons

    _, signal = jax.jvp(contrast, (jnp.zeros(shape),), (jnp.asarray(wave * 1e-9),))
    expected = 2 * WAVENUMBER_PER_M * 1e-9 * np.sin(np.pi * half_periods) * wave
    np.testing.assert_allclose(signal[0], expected, atol=1e-13)  # rounding of a signal of 1.5e-2
    np.testing.assert_allclose(signal[1], -expected, atol=1e-13)

    weak = np.asarray(contrast(jnp.asarray(wave * 1e-10))) - 1
    np.testing.assert_allclose(weak[0], expected / 10, atol=1e-6)  # e^2 with e = 7e-4


# ---------------------------------------------------------------------------------------------- Fraunhofer


def test_the_image_of_a_disc_is_airys():
    pixel_m, diameter_m = 0.05, 8.0
    disc = circular_pupil(Grid((163, 170), pixel_m), diameter_m=diameter_m)
    sky = Grid((41, 36), 0.2 * WAVELENGTH_M / diameter_m)
    image = propagate_fraunhofer(jnp.asarray(disc, complex), wavelength_m=WAVELENGTH_M, pixel_m=pixel_m, angles=sky)
    v_rad, u_rad = centres_m((41, 36), sky.pixel_m)
    radial = np.pi * diameter_m / WAVELENGTH_M * np.hypot(v_rad, u_rad)
    peak = np.pi * diameter_m**2 / 4 * sky.pixel_m / (pixel_m * WAVELENGTH_M)
    # The antialiased disc has its area to 2e-5; averages over pixels cost (pi dx theta / lambda)^2 / 6.
    np.testing.assert_allclose(np.asarray(image) / peak, 2 * j1(radial) / radial, atol=1e-4)


@pytest.mark.parametrize(("slope_y", "slope_x"), [(0.0, 3.0), (2.0, 0.0), (-4.0, 1.0)])
def test_a_path_that_grows_towards_x_or_y_moves_the_image_there(slope_y, slope_x):
    step_rad = 0.25 * WAVELENGTH_M / 8.0
    y_m, x_m = centres_m((52, 47), 0.2)
    disc = circular_pupil(Grid((52, 47), 0.2), diameter_m=8.0)
    opd_m = jnp.asarray((slope_y * y_m + slope_x * x_m) * step_rad)
    near = pupil_field(disc, opd_m, wavelength_m=WAVELENGTH_M)
    far = propagate_fraunhofer(near, wavelength_m=WAVELENGTH_M, pixel_m=0.2, angles=Grid((17, 15), step_rad))
    brightest = np.unravel_index(np.argmax(abs(np.asarray(far))), (17, 15))
    assert brightest == (8 + slope_y, 7 + slope_x)
