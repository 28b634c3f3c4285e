"""What light does whatever its shape: energy, inverse, adjoint, symmetries, shares of photons."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fraunhofer import propagate_fraunhofer
from nlcwfs.beam.fresnel import propagate_fresnel
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor

WAVELENGTH_M = 0.85e-6
PIXEL_M = 0.2
LIGHT = {"wavelength_m": WAVELENGTH_M, "pixel_m": PIXEL_M}
ROUNDING = 1e-12  # a few FFTs of some hundred pixels in float64, for fields of order 1

few = settings(max_examples=20, deadline=None)  # the first example of a shape compiles
seeds = st.integers(0, 2**32 - 1)
shapes = st.sampled_from([(12, 15), (15, 12), (9, 13), (10, 16)])  # odd and even, never square
distances = st.floats(-4e6, 4e6)


def random_field(seed: int, shape: tuple[int, int]) -> np.ndarray:
    real, imaginary = np.random.default_rng(seed).normal(size=(2, *shape))
    return real + 1j * imaginary


def random_pupil(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Real amplitudes without any symmetry, a third of them dark."""
    rng = np.random.default_rng(seed + 1)
    return rng.uniform(0.1, 1, shape) * (rng.uniform(size=shape) > 1 / 3)


def random_opd(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """About one radian at every pixel."""
    return np.random.default_rng(seed + 2).normal(scale=150e-9, size=shape)


def travel(field: np.ndarray, distance_m: float) -> np.ndarray:
    return np.asarray(propagate_fresnel(jnp.asarray(field), distance_m=distance_m, **LIGHT))


def sensor_of(pupil: np.ndarray, distances_m, *, wavelength_m: float = WAVELENGTH_M, **options) -> CurvatureSensor:
    options.setdefault("spectrum", Spectrum.monochromatic(wavelength_m))
    grid = Grid(pupil.shape, PIXEL_M)
    return CurvatureSensor.build(pupil, grid, distances_m=distances_m, dtype="float64", **options)


def images(sensor: CurvatureSensor, opd_m: np.ndarray, photons: float = 1000.0) -> np.ndarray:
    return np.asarray(sensor.images(jnp.asarray(opd_m), photons).photons)


# ------------------------------------------------------------------------------------------------ Fresnel


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_travel_neither_makes_nor_loses_energy(seed, shape, distance_m):
    near = random_field(seed, shape)
    far = travel(near, distance_m)
    np.testing.assert_allclose(np.sum(abs(far) ** 2), np.sum(abs(near) ** 2), rtol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_travelling_there_and_back_changes_nothing(seed, shape, distance_m):
    near = random_field(seed, shape)
    np.testing.assert_allclose(travel(travel(near, distance_m), -distance_m), near, atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, first_m=distances, second_m=distances)
def test_two_journeys_are_one_of_their_summed_length(seed, shape, first_m, second_m):
    near = random_field(seed, shape)
    twice = travel(travel(near, first_m), second_m)
    np.testing.assert_allclose(twice, travel(near, first_m + second_m), atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_the_adjoint_of_travel_is_travel_back(seed, shape, distance_m):
    near, far = random_field(seed, shape), random_field(seed + 1, shape)
    forward = np.vdot(far, travel(near, distance_m))
    backward = np.vdot(travel(far, -distance_m), near)
    np.testing.assert_allclose(forward, backward, atol=ROUNDING * near.size)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_travel_is_linear_in_the_complex_amplitude(seed, shape, distance_m):
    first, second = random_field(seed, shape), random_field(seed + 1, shape)
    factor = 0.3 - 1.7j
    together = travel(first + factor * second, distance_m)
    apart = travel(first, distance_m) + factor * travel(second, distance_m)
    np.testing.assert_allclose(together, apart, atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances, down=st.integers(-5, 5), right=st.integers(-5, 5))
def test_a_shifted_field_arrives_shifted(seed, shape, distance_m, down, right):
    near = random_field(seed, shape)
    shifted = travel(np.roll(near, (down, right), axis=(0, 1)), distance_m)
    expected = np.roll(travel(near, distance_m), (down, right), axis=(0, 1))
    np.testing.assert_allclose(shifted, expected, atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_rows_and_columns_travel_alike(seed, shape, distance_m):
    near = random_field(seed, shape)
    np.testing.assert_allclose(travel(near.T, distance_m), travel(near, distance_m).T, atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_travel_back_is_the_travel_of_the_conjugate(seed, shape, distance_m):
    near = random_field(seed, shape)
    back = travel(near, -distance_m)
    np.testing.assert_allclose(back, travel(near.conj(), distance_m).conj(), atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_travel_is_the_sum_of_its_plane_waves(seed, shape, distance_m):
    near = random_field(seed, shape)
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in shape)
    # Integer orders of a plane wave, those of an even grid from -n/2 to n/2 - 1.
    order_y, order_x = (np.arange(-(n // 2), n - n // 2) for n in shape)
    waves_y = np.exp(2j * np.pi * np.outer(rows, order_y) / shape[0])
    waves_x = np.exp(2j * np.pi * np.outer(columns, order_x) / shape[1])
    strength = waves_y.conj().T @ near @ waves_x.conj() / near.size
    squared_y, squared_x = ((order / (n * PIXEL_M)) ** 2 for order, n in zip((order_y, order_x), shape, strict=True))
    delay_rad = np.pi * WAVELENGTH_M * distance_m * (squared_y[:, None] + squared_x[None, :])
    expected = waves_y @ (strength * np.exp(-1j * delay_rad)) @ waves_x.T
    np.testing.assert_allclose(travel(near, distance_m), expected, atol=10 * ROUNDING)  # phases of 100 rad


# --------------------------------------------------------------------------------------------- Fraunhofer


@few
@given(seed=seeds, shape=shapes, wide=st.sampled_from([(7, 10), (10, 7)]))
def test_the_far_field_is_the_sum_over_the_pupil(seed, shape, wide):
    near = random_field(seed, shape)
    step_rad = 0.3 * WAVELENGTH_M / (max(shape) * PIXEL_M)
    far = propagate_fraunhofer(jnp.asarray(near), angles=Grid(wide, step_rad), **LIGHT)
    y_m, x_m = ((np.arange(n) - (n - 1) / 2) * PIXEL_M for n in shape)
    v_rad, u_rad = ((np.arange(n) - (n - 1) / 2) * step_rad for n in wide)
    path_m = np.multiply.outer(v_rad, y_m)[:, None, :, None] + np.multiply.outer(u_rad, x_m)[None, :, None, :]
    waves = np.exp(-2j * np.pi * path_m / WAVELENGTH_M)
    expected = PIXEL_M * step_rad / WAVELENGTH_M * np.einsum("vuyx,yx->vu", waves, near)
    np.testing.assert_allclose(far, expected, atol=ROUNDING)


@few
@given(seed=seeds, size=st.sampled_from([9, 12]))
def test_all_the_light_is_on_the_sky(seed, size):
    near = random_field(seed, (size, size))
    sky = Grid((size, size), WAVELENGTH_M / (size * PIXEL_M))  # one period of the directions a grid can tell apart
    far = propagate_fraunhofer(jnp.asarray(near), angles=sky, **LIGHT)
    np.testing.assert_allclose(np.sum(abs(np.asarray(far)) ** 2), np.sum(abs(near) ** 2), rtol=ROUNDING)


# -------------------------------------------------------------------------------------------- pupil field


@few
@given(seed=seeds, shape=shapes, photons=st.floats(1e-3, 1e9))
def test_a_longer_path_is_a_larger_phase(seed, shape, photons):
    pupil, opd_m = random_pupil(seed, shape), random_opd(seed, shape)
    field = pupil_field(pupil, jnp.asarray(opd_m), wavelength_m=WAVELENGTH_M, photons=photons)
    expected = pupil * np.sqrt(photons / np.sum(pupil**2)) * np.exp(2j * np.pi * opd_m / WAVELENGTH_M)
    np.testing.assert_allclose(field, expected, atol=ROUNDING * np.sqrt(photons))


# ------------------------------------------------------------------------------------------------- images


@few
@given(seed=seeds, shape=shapes, distance_m=st.floats(2e5, 4e6))
def test_the_images_are_what_the_pupil_sends(seed, shape, distance_m):
    pupil, opd_m = random_pupil(seed, shape), random_opd(seed, shape)
    got = images(sensor_of(pupil, (distance_m, -0.3 * distance_m)), opd_m)
    spectrum = np.fft.fft2(pupil * np.exp(2j * np.pi * opd_m / WAVELENGTH_M))
    frequency_y, frequency_x = (np.fft.fftfreq(n, PIXEL_M) for n in shape)
    squared = frequency_y[:, None] ** 2 + frequency_x[None, :] ** 2
    for image, z_m in zip(got, (distance_m, -0.3 * distance_m), strict=True):
        far = np.fft.ifft2(spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * z_m * squared))
        expected = 500.0 * abs(far) ** 2 / np.sum(pupil**2)  # half of the 1000 photons
        np.testing.assert_allclose(image, expected, atol=1000 * ROUNDING)


@few
@given(seed=seeds, shape=shapes, photons=st.floats(1e-3, 1e9), share=st.floats(0.01, 0.98), distance_m=distances)
def test_every_photon_lands_on_the_plane_that_owns_it(seed, shape, photons, share, distance_m):
    fractions = (share, 0.99 - share, 0.01)
    sensor = sensor_of(random_pupil(seed, shape), (distance_m, -2e6, 3e5), flux_fractions=fractions)
    received = images(sensor, random_opd(seed, shape), photons).sum(axis=(1, 2))
    np.testing.assert_allclose(received, photons * np.array(fractions), rtol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, piston_m=st.floats(-2e-6, 2e-6))
def test_piston_cannot_be_seen(seed, shape, piston_m):
    sensor, opd_m = sensor_of(random_pupil(seed, shape), (-2e6, 3e5)), random_opd(seed, shape)
    # 15 radians of piston cost their rounding, 15 times 1e-16, for 1000 photons.
    np.testing.assert_allclose(images(sensor, opd_m + piston_m), images(sensor, opd_m), atol=1000 * ROUNDING)


@few
@given(seed=seeds, shape=shapes, distance_m=distances)
def test_the_other_side_of_the_pupil_sees_the_opposite_wavefront(seed, shape, distance_m):
    # For real A: P(-z)[A exp(i phi)] = conj(P(z)[A exp(-i phi)]); nothing is turned or reflected.
    sensor, opd_m = sensor_of(random_pupil(seed, shape), (distance_m, -distance_m)), random_opd(seed, shape)
    np.testing.assert_allclose(images(sensor, opd_m)[::-1], images(sensor, -opd_m), atol=1000 * ROUNDING)


@few
@given(seed=seeds, shape=shapes, down=st.integers(-5, 5), right=st.integers(-5, 5))
def test_a_shifted_pupil_gives_shifted_images(seed, shape, down, right):
    def roll(array):
        return np.roll(array, (down, right), axis=(-2, -1))

    pupil, opd_m, distances_m = random_pupil(seed, shape), random_opd(seed, shape), (-2e6, 3e5)
    shifted = images(sensor_of(roll(pupil), distances_m), roll(opd_m))
    np.testing.assert_allclose(shifted, roll(images(sensor_of(pupil, distances_m), opd_m)), atol=1000 * ROUNDING)


@few
@given(seed=seeds, shape=shapes)
def test_a_static_aberration_adds_to_the_wavefront(seed, shape):
    pupil, opd_m, static_m = random_pupil(seed, shape), random_opd(seed, shape), random_opd(seed + 9, shape)
    known = images(sensor_of(pupil, (-2e6, 3e5), static_opd_m=static_m), opd_m)
    in_the_light = images(sensor_of(pupil, (-2e6, 3e5)), opd_m + static_m)
    np.testing.assert_allclose(known, in_the_light, atol=1000 * ROUNDING)
    without = images(sensor_of(pupil, (-2e6, 3e5)), opd_m)
    assert abs(known - without).max() > 1  # photons: it is not lost on the way


@few
@given(seed=seeds, shape=shapes)
def test_the_wavefront_outside_the_pupil_does_not_count(seed, shape):
    pupil, opd_m = random_pupil(seed, shape), random_opd(seed, shape)
    sensor = sensor_of(pupil, (-2e6, 3e5))
    elsewhere = np.where(pupil > 0, opd_m, random_opd(seed + 5, shape))
    np.testing.assert_allclose(images(sensor, elsewhere), images(sensor, opd_m), atol=1000 * ROUNDING)


@few
@given(seed=seeds, shape=shapes, share=st.floats(0, 1))
def test_colours_add_their_photons(seed, shape, share):
    pupil, opd_m, distances_m = random_pupil(seed, shape), random_opd(seed, shape), (-2e6, 3e5)
    both = sensor_of(pupil, distances_m, spectrum=Spectrum((0.68e-6, 1.02e-6), (share, 1 - share)))
    blue, red = (images(sensor_of(pupil, distances_m, wavelength_m=w), opd_m) for w in (0.68e-6, 1.02e-6))
    np.testing.assert_allclose(images(both, opd_m), share * blue + (1 - share) * red, atol=1000 * ROUNDING)


@few
@given(seed=seeds, shape=shapes, wavelength_m=st.floats(0.4e-6, 2e-6))
def test_the_same_phase_at_the_same_wavelength_times_distance_gives_the_same_images(seed, shape, wavelength_m):
    pupil, opd_m = random_pupil(seed, shape), random_opd(seed, shape)
    ratio = wavelength_m / WAVELENGTH_M
    here = images(sensor_of(pupil, (-2e6, 3e5)), opd_m)
    there = images(sensor_of(pupil, (-2e6 / ratio, 3e5 / ratio), wavelength_m=wavelength_m), opd_m * ratio)
    np.testing.assert_allclose(there, here, atol=1000 * ROUNDING)


# ---------------------------------------------------------------------------------------------- gradients


@few
@given(seed=seeds, shape=shapes)
def test_the_slope_of_the_images_is_that_of_finite_differences(seed, shape):
    sensor = sensor_of(random_pupil(seed, shape), (-2e6, 3e5))
    opd_m, direction_m = random_opd(seed, shape), random_opd(seed + 7, shape)
    step = 1e-4  # moves phases by 1e-4 rad: error step^2 / 6 of the third derivative, rounding 1e-16 / step

    def photons(opd):
        return sensor.images(opd, 1000.0).photons

    _, slope = jax.jvp(photons, (jnp.asarray(opd_m),), (jnp.asarray(direction_m),))
    difference = (images(sensor, opd_m + step * direction_m) - images(sensor, opd_m - step * direction_m)) / (2 * step)
    np.testing.assert_allclose(slope, difference, atol=1e-6 * abs(difference).max())


@few
@given(seed=seeds, shape=shapes)
def test_the_gradient_is_the_adjoint_of_the_slope_and_finite_in_the_dark(seed, shape):
    sensor = sensor_of(random_pupil(seed, shape), (-2e6, 3e5))
    opd_m, direction_m = jnp.asarray(random_opd(seed, shape)), jnp.asarray(random_opd(seed + 7, shape))
    weights = jnp.asarray(np.random.default_rng(seed).normal(size=(2, *shape)))

    def photons(opd):
        return sensor.images(opd, 1000.0).photons

    _, slope = jax.jvp(photons, (opd_m,), (direction_m,))
    (gradient,) = jax.vjp(photons, opd_m)[1](weights)
    assert np.all(np.isfinite(gradient))
    dark = np.asarray(sensor.pupil) == 0
    assert np.all(np.asarray(gradient)[dark] == 0)
    # Each side sums some hundred terms of up to 1000 photons.
    np.testing.assert_allclose(np.vdot(gradient, direction_m), np.vdot(weights, slope), atol=1e-9, rtol=1e-10)
