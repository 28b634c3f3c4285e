"""What the parts of the estimation do whatever the pupil, the phase and the noise."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation import gerchberg_saxton as gs
from nlcwfs.estimation.amplitude_constraint import LARGEST_FACTOR, modulus_factor
from nlcwfs.estimation.angle import angle, cosine_and_sine, wrap
from nlcwfs.estimation.centroid_tilt import centroid_tilt
from nlcwfs.estimation.reconstructor import GerchbergSaxton
from nlcwfs.estimation.resolution_level import Level, Measurement, resample_phase, sum_blocks
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings, GerchbergSaxtonSettings
from nlcwfs.estimation.tilt import mean_slope, tilt_phase
from nlcwfs.estimation.turbulence_filter import smoothed_phase, wiener_filter
from nlcwfs.estimation.turbulence_strength import LARGEST_STEP, slope_weights, updated_strength
from nlcwfs.estimation.unwrapping import SlopeUnwrapper

WAVELENGTH_M = 0.65e-6
PIXEL_M = 0.2
ROUNDING = 1e-11  # a few FFTs of some hundred pixels in float64, for numbers of order 1

ANGLE_ERROR = 1.2e-5  # of the polynomial for angles: Abramowitz & Stegun 1964, 4.4.47

few = settings(max_examples=20, deadline=None)  # the first example of a shape compiles
seeds = st.integers(0, 2**32 - 1)
shapes = st.sampled_from([(12, 15), (15, 12), (9, 14)])  # odd and even, never square


def numbers(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


# --------------------------------------------------------------------------------------- modulus_factor


def factor_of(counts, model, usable, **options) -> np.ndarray:
    return np.asarray(modulus_factor(jnp.asarray(counts), jnp.asarray(model), jnp.asarray(usable), **options))


@few
@given(seed=seeds, shape=shapes)
def test_replacing_imposes_the_square_root_of_the_counts(seed, shape):
    rng = numbers(seed)
    counts, model = rng.poisson(2.0, (2, *shape)).astype(float), rng.exponential(2.0, (2, *shape)) + 1e-9
    usable = rng.uniform(size=counts.shape) > 0.2
    far = np.sqrt(model) * np.exp(1j * rng.uniform(-np.pi, np.pi, counts.shape))
    imposed = far * factor_of(counts, model, usable, method="replace")
    np.testing.assert_allclose(abs(imposed[usable]), np.sqrt(counts[usable]), rtol=1e-12)
    np.testing.assert_array_equal(imposed[~usable], far[~usable])


@few
@given(seed=seeds, error=st.floats(-0.2, 0.2), others=st.floats(1e-4, 1e-2))
def test_where_light_is_plenty_the_poisson_step_is_the_square_root(seed, error, others):
    model = np.full((1, 20, 20), others)
    row, column = numbers(seed).integers(0, 20, 2)
    model[0, row, column] = 1.0  # a speckle far above the mean, which damps the dark pixels
    counts = 1e6 * model
    counts[0, row, column] *= 1 + error
    factor = factor_of(counts, 1e6 * model, np.ones_like(model, bool), method="poisson")
    # Second order of the two curves differs by 1/8 + 1/4; the mean is at most 1.3 % of the speckle, times 0.1 / 2.
    assert abs(factor[0, row, column] - np.sqrt(1 + error)) < 0.5 * error**2 + 2e-3 * abs(error) + 1e-12
    assert np.sum(factor != 1) <= 1


@few
@given(seed=seeds, doubt=st.floats(0, 1))
def test_the_poisson_step_leaves_alone_what_fits_or_is_masked(seed, doubt):
    rng = numbers(seed)
    model = rng.exponential(1.0, (2, 6, 7))
    usable = rng.uniform(size=model.shape) > 0.3
    counts = np.where(usable, model, rng.choice([0.0, 1e9, np.nan, np.inf], model.shape))
    np.testing.assert_array_equal(factor_of(counts, model, usable, method="poisson", doubt=doubt), 1)


@few
@given(seed=seeds, level=st.floats(1e-3, 1e3))
def test_the_poisson_step_is_bounded_and_points_to_the_counts(seed, level):
    rng = numbers(seed)
    counts, model = rng.poisson(level, (2, 6, 7)) * 1.0, rng.exponential(level, (2, 6, 7))
    factor = factor_of(counts, model, np.ones(counts.shape, bool), method="poisson")
    assert np.all((factor >= 0) & (factor <= LARGEST_FACTOR))
    assert np.all((factor - 1) * (counts - model) >= 0)
    assert np.all((factor == 1) == (counts == model))


@few
@given(seed=seeds, read_variance=st.floats(1e3, 1e6))
def test_where_read_noise_rules_the_model_is_left_alone(seed, read_variance):
    rng = numbers(seed)
    model = rng.exponential(2.0, (1, 6, 7))
    counts = model + rng.normal(0, np.sqrt(read_variance), model.shape)
    usable = np.ones(model.shape, bool)
    factor = factor_of(counts, model, usable, method="poisson", read_variance=read_variance)
    # A read-out error of one sigma moves the amplitude by 1 / (2 sigma), as the likelihood wants; no photon's does.
    np.testing.assert_array_less(abs(factor - 1), abs(counts - model) / (2 * read_variance) + 1e-12)


# ---------------------------------------------------------------------------------- Gerchberg and Saxton

PLAIN = {
    "filter": "none",
    "amplitude": "replace",
    "start": "flat",
    "fast_forward": 0.0,
    "gain": 1.0,
    "coarse_cutoffs_cpa": (),
    "tolerance_rad": 0.0,
}
DISTANCES_M = (-1.1e5, 0.6e5, 1.4e5)  # about one Fresnel number on a pupil of two metres
SHARES = (0.5, 0.2, 0.3)


@functools.cache
def plain_step(shape: tuple[int, int], planes: int, scheme: str):
    """One compiled iteration of the paper's algorithm, for any pupil and counts."""

    solver = bench(shape, planes, scheme)

    def one(pupil, counts, phase_rad, gain):
        level, options = with_pupil(solver.levels[-1], pupil), solver.settings.gerchberg_saxton
        measured = Measurement(counts, jnp.ones(counts.shape, bool), jnp.asarray(0.0))
        flat, first, strength = jnp.zeros(shape), jnp.asarray(0), jnp.asarray(1.0)
        problem = gs.problem_at(level, measured, options, flat, first, strength, None)
        return gs.step(problem._replace(gain=gain), options, gs.init(phase_rad)).phase_rad

    return jax.jit(one)


def with_pupil(level: Level, pupil: jax.Array) -> Level:
    """The level with another pupil, so that one compilation serves all."""
    light = pupil**2
    parts = (pupil, pupil / jnp.sqrt(jnp.sum(light)), light / jnp.max(light), light / jnp.sum(light))
    return eqx.tree_at(lambda x: (x.optics.pupil, x.modulus, x.light, x.weight), level, parts)


@functools.cache
def bench(shape: tuple[int, int], planes: int, scheme: str) -> GerchbergSaxton:
    shares = np.array(SHARES[:planes]) / sum(SHARES[:planes])
    geometry = SensorGeometry(
        pupil=PupilShape(diameter_m=1.0, amplitude_map=np.ones(shape), map_pixel_m=PIXEL_M),
        frame=Grid(shape, PIXEL_M),
        wavelength_m=WAVELENGTH_M,
        distances_m=DISTANCES_M[:planes],
        flux_fractions=tuple(shares),
    )
    settings = EstimationSettings(gerchberg_saxton=GerchbergSaxtonSettings(scheme=scheme, **PLAIN))
    solver = GerchbergSaxton.build(geometry, settings, dtype="float64")
    assert solver.levels[-1].grid.shape == shape  # the window needs no rim: the light is on the model's own grid
    return solver


def seen_by_numpy(pupil, phase_rad, planes: int) -> np.ndarray:
    """Amplitude on every plane of light of unit power: the definition, in NumPy."""
    fy, fx = (np.fft.fftfreq(n, PIXEL_M) for n in pupil.shape)
    squared = fy[:, None] ** 2 + fx**2
    spectrum = np.fft.fft2(pupil / np.sqrt(np.sum(pupil**2)) * np.exp(1j * phase_rad))
    return np.array(
        [np.fft.ifft2(spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * z * squared)) for z in DISTANCES_M[:planes]]
    )


def random_case(seed: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    rng = numbers(seed)
    pupil = rng.uniform(0.1, 1, shape) * (rng.uniform(size=shape) > 1 / 3)
    assume(pupil.max() > 0)
    return pupil, rng.normal(0, 2.0, shape), rng


@few
@given(seed=seeds, shape=shapes, gain=st.floats(0.1, 3.0))
def test_an_iteration_is_the_papers(seed, shape, gain):
    """Written out in NumPy: measured modulus, light back, mean over the planes by their light, pupil's phase."""
    pupil, phase_rad, rng = random_case(seed, shape)
    counts = rng.poisson(20.0, (3, *shape)).astype(float)
    shares, scale = np.array(SHARES)[:, None, None], np.sqrt(counts.sum(axis=(1, 2), keepdims=True))
    imposed = np.sqrt(counts) / scale * np.exp(1j * np.angle(seen_by_numpy(pupil, phase_rad, 3)))
    fy, fx = (np.fft.fftfreq(n, PIXEL_M) for n in shape)
    back = np.exp(1j * np.pi * WAVELENGTH_M * np.array(DISTANCES_M)[:, None, None] * (fy[:, None] ** 2 + fx**2))
    returned = np.fft.ifft2(np.sum(shares * np.fft.fft2(imposed) * back, axis=0))
    light = (pupil / pupil.max()) ** 2
    expected = phase_rad + gain * light * np.angle(returned * np.exp(-1j * phase_rad))
    after = np.asarray(plain_step(shape, 3, "averaged")(pupil, counts, phase_rad, gain))
    # A turn of pi may go either way.
    apart = np.where(light > 0, after - expected, 0)
    sure = abs(np.angle(returned * np.exp(-1j * phase_rad))) < np.pi - 1e-3
    np.testing.assert_allclose(apart[sure], 0, atol=gain * ANGLE_ERROR)


@few
@given(seed=seeds, shape=shapes, scheme=st.sampled_from(["averaged", "serial"]))
def test_the_true_field_is_a_fixed_point(seed, shape, scheme):
    pupil, phase_rad, _ = random_case(seed, shape)
    shares = np.array(SHARES)[:, None, None]
    counts = 1e4 * shares * abs(seen_by_numpy(pupil, phase_rad, 3)) ** 2
    after = np.asarray(plain_step(shape, 3, scheme)(pupil, counts, phase_rad, 1.0))
    np.testing.assert_allclose(after, phase_rad, atol=3 * ANGLE_ERROR)  # serial turns the phase three times


@few
@given(seed=seeds, shape=shapes)
def test_another_field_is_no_fixed_point(seed, shape):
    pupil, phase_rad, rng = random_case(seed, shape)
    counts = 1e4 * np.array(SHARES)[:, None, None] * abs(seen_by_numpy(pupil, phase_rad, 3)) ** 2
    other = phase_rad + rng.normal(0, 0.3, shape)
    after = np.asarray(plain_step(shape, 3, "averaged")(pupil, counts, other, 1.0))
    lit = pupil > 0.5 * pupil.max()
    assert np.sqrt(np.mean((after - other)[lit] ** 2)) > 1e-3


@few
@given(seed=seeds, shape=shapes, planes=st.integers(1, 3), gain=st.floats(0.05, 1.99), photons=st.floats(10, 1e6))
def test_the_amplitude_misfit_never_grows(seed, shape, planes, gain, photons):
    """Fienup 1982, Applied Optics 21, 2758, eq. 10: error reduction, here summed over planes by their light.

    A step of the phase towards the returning light shortens the distance pixel by pixel for any gain below 2.
    """
    pupil, phase_rad, rng = random_case(seed, shape)
    shares = np.array(SHARES[:planes]) / sum(SHARES[:planes])
    truth = abs(seen_by_numpy(pupil, rng.normal(0, 2.0, shape), planes)) ** 2
    counts = rng.poisson(photons * shares[:, None, None] * truth).astype(float)
    assume(np.all(counts.sum(axis=(1, 2)) > 0))
    measured = np.sqrt(counts / counts.sum(axis=(1, 2), keepdims=True))

    def misfit(phase_rad):
        apart = abs(seen_by_numpy(pupil, phase_rad, planes)) - measured
        return float(np.sum(shares * np.sum(apart**2, axis=(1, 2))))

    step = plain_step(shape, planes, "averaged")
    values = [misfit(phase_rad)]
    for _ in range(4):
        phase_rad = np.asarray(step(pupil, counts, phase_rad, gain))
        values.append(misfit(phase_rad))
    assert np.all(np.diff(values) <= 1e-9)  # the phase is wrong by 1e-5 rad, its square counts
    assert values[-1] < values[0]


@few
@given(seed=seeds, shape=shapes)
def test_with_one_plane_serial_and_averaged_are_the_same(seed, shape):
    pupil, phase_rad, rng = random_case(seed, shape)
    counts = rng.poisson(50.0, (1, *shape)).astype(float)
    serial, averaged = (
        np.asarray(plain_step(shape, 1, scheme)(pupil, counts, phase_rad, 1.0)) for scheme in ("serial", "averaged")
    )
    np.testing.assert_allclose(serial, averaged, atol=ROUNDING)


@few
@given(seed=seeds, size=st.floats(1e-6, 1e6))
def test_angles_are_those_of_the_arctangent(seed, size):
    rng = numbers(seed)
    complex_ = size * np.r_[rng.normal(size=40) + 1j * rng.normal(size=40), 1, 1j, -1j, -1 + 1e-9j, 1 - 1e-9j, 1 + 1j]
    np.testing.assert_allclose(angle(jnp.asarray(complex_)), np.angle(complex_), atol=ANGLE_ERROR)
    assert float(angle(jnp.zeros(1, complex))[0]) == 0  # a pixel without light does not move


@few
@given(seed=seeds, size=st.floats(1e-3, 1e3))
def test_fast_waves_are_cosine_and_sine(seed, size):
    phase_rad = np.r_[size * numbers(seed).normal(size=50), np.arange(-8, 9) * np.pi / 4]
    cosine, sine = cosine_and_sine(jnp.asarray(phase_rad))
    np.testing.assert_allclose(cosine, np.cos(phase_rad), atol=3e-9)  # Abramowitz & Stegun, 4.3.97 and 4.3.99
    np.testing.assert_allclose(sine, np.sin(phase_rad), atol=3e-9)


# ------------------------------------------------------------------------------------ turbulence filter


def random_power(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Positive, the same for a wave and its conjugate, over five decades; whole spectrum."""
    log = rng.uniform(-3, 2, shape)
    conjugate = np.roll(log[::-1, ::-1], (1, 1), axis=(0, 1))
    return 10 ** ((log + conjugate) / 2)


def smoothed(phase_rad, power, noise) -> np.ndarray:
    half = jnp.asarray(power[:, : power.shape[1] // 2 + 1])
    return np.asarray(smoothed_phase(jnp.asarray(phase_rad), wiener_filter(half, noise)))


@few
@given(seed=seeds, shape=shapes, noise=st.floats(1e-3, 10))
def test_the_filter_is_wieners(seed, shape, noise):
    rng = numbers(seed)
    phase_rad, power = rng.normal(size=shape), random_power(rng, shape)
    expected = np.fft.ifft2(np.fft.fft2(phase_rad) * power / (power + noise))
    np.testing.assert_allclose(expected.imag, 0, atol=ROUNDING)
    np.testing.assert_allclose(smoothed(phase_rad, power, noise), expected.real, atol=ROUNDING)


@few
@given(seed=seeds, shape=shapes, noise=st.floats(1e-3, 10))
def test_the_filter_is_linear_self_adjoint_and_shrinks(seed, shape, noise):
    rng = numbers(seed)
    (a, b), power = rng.normal(size=(2, *shape)), random_power(rng, shape)
    of_a, of_b = smoothed(a, power, noise), smoothed(b, power, noise)
    np.testing.assert_allclose(smoothed(2 * a - 3 * b, power, noise), 2 * of_a - 3 * of_b, atol=ROUNDING)
    assert np.sum(of_a * b) == pytest.approx(np.sum(a * of_b), abs=1e-10)
    assert np.sum(of_a * a) > 0  # no wave changes its sign
    assert np.sum(of_a**2) < np.sum(a**2)


@few
@given(seed=seeds, shape=shapes, piston_rad=st.floats(-20, 20), noise=st.floats(1e-3, 10))
def test_piston_shrinks_like_the_longest_wave_and_stays_piston(seed, shape, piston_rad, noise):
    power = random_power(numbers(seed), shape)
    left = smoothed(np.full(shape, piston_rad), power, noise)
    np.testing.assert_allclose(left, piston_rad * power[0, 0] / (power[0, 0] + noise), atol=ROUNDING)


# ------------------------------------------------------------------------------------------ unwrapping


@few
@given(phase_rad=st.floats(-1e3, 1e3))
def test_wrapping_takes_whole_turns_only(phase_rad):
    wrapped = float(wrap(jnp.asarray(phase_rad)))
    assert abs(wrapped) <= np.pi + 1e-9
    turns = (phase_rad - wrapped) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)


@functools.cache
def unwrapper(passes: int) -> tuple[SlopeUnwrapper, np.ndarray, np.ndarray]:
    """On an obstructed pupil of no symmetry, 20 modes; with the modes and the light."""
    grid = Grid((19, 22), 0.42)
    pupil = np.array(PupilShape(diameter_m=7.5, obstruction_ratio=0.3).on(grid))
    pupil[:6, :9] = 0
    basis = modal_basis(pupil, grid, diameter_m=7.5, count=20)
    return SlopeUnwrapper.build(basis, passes=passes, dtype="float64"), np.asarray(basis.modes), basis.weights


def largest_difference(phase_rad: np.ndarray, lit: np.ndarray) -> float:
    down = abs(np.diff(phase_rad, axis=0))[lit[1:] & lit[:-1]]
    right = abs(np.diff(phase_rad, axis=1))[lit[:, 1:] & lit[:, :-1]]
    return max(down.max(), right.max())


@few
@given(seed=seeds, steepness=st.floats(0.05, 0.98), passes=st.sampled_from([0, 2]), piston_rad=st.floats(-9, 9))
def test_modes_are_found_as_long_as_neighbours_differ_by_less_than_pi(seed, steepness, passes, piston_rad):
    rng = numbers(seed)
    solver, modes, weights = unwrapper(passes)
    coefficients = rng.normal(size=20)
    phase_rad = np.tensordot(coefficients, modes, axes=1)
    scale = steepness * np.pi / largest_difference(phase_rad, weights > 0)
    given_rad = scale * phase_rad + piston_rad + 2 * np.pi * rng.integers(-3, 4, phase_rad.shape)
    given_rad = np.where(weights > 0, given_rad, rng.normal(0, 50, phase_rad.shape))  # nobody looks there
    found = np.asarray(solver.coefficients(jnp.asarray(given_rad)))
    np.testing.assert_allclose(found, scale * coefficients, atol=1e-9 * scale)
    opened = np.asarray(solver.unwrapped(jnp.asarray(given_rad)))
    np.testing.assert_allclose(opened[weights > 0], scale * phase_rad[weights > 0], atol=1e-8 * scale)


def test_steeper_than_pi_between_neighbours_is_beyond_slopes():
    solver, modes, weights = unwrapper(2)
    steep = 1.1 * np.pi / largest_difference(modes[0], weights > 0)
    found = np.asarray(solver.coefficients(jnp.asarray(steep * modes[0])))
    assert abs(found[0] - steep) > 0.1 * steep


def tilt_noise(passes: int, size: int, draws: int = 1500) -> float:
    """Variance of the slope found in white phase noise on a square pupil, with tip and tilt alone."""
    grid = Grid((size, size), 1.0)
    basis = modal_basis(np.ones(grid.shape), grid, diameter_m=float(size), count=2, kind="disc-harmonics")
    solver = SlopeUnwrapper.build(basis, passes=passes, dtype="float64")
    noise_rad = jnp.asarray(numbers(5).normal(0, 0.05, (draws, *grid.shape)))
    found = np.asarray(jax.vmap(solver.coefficients)(noise_rad))
    return float(np.mean(found**2) / 0.05**2)


def test_the_remainder_takes_the_noise_of_slopes_away():
    """On N x N pixels with two tilts, from sums over edges and over positions, in units of the variance of a pixel.

    Slopes: the mean difference of neighbours is the difference of two edges, of variance 2 / (N (N - 1)^2), and a
    tilt of unit rms has slope s with s^2 (N^2 - 1) / 12 = 1: (N + 1) / (6 N (N - 1)). A projection has 1 / N^2.
    """
    size = 24
    by_slopes, with_remainder = tilt_noise(0, size), tilt_noise(1, size)
    spread = 5 / np.sqrt(1500)  # 5 sigma of a variance from 2 x 1500 numbers
    assert by_slopes == pytest.approx((size + 1) / (6 * size * (size - 1)), rel=spread)
    assert with_remainder == pytest.approx(1 / size**2, rel=spread)


# --------------------------------------------------------------------------------------------- tilts

WIDE = Grid((96, 108), 0.15)  # the whole light, tails included, at the distances below
PLANES_M = np.array([-9e5, 4e5, 1.2e6])


def smooth_light(slope, bend, centre_m) -> tuple[np.ndarray, np.ndarray]:
    """Images of a Gaussian pupil with tilt, astigmatism, defocus and coma; and the mean slope over its light."""
    y_m, x_m = (axis - at for axis, at in zip((WIDE.y_m, WIDE.x_m), centre_m, strict=True))
    width_m = 1.1
    amplitude = np.exp(-(y_m**2 + x_m**2) / (2 * width_m**2))
    opd_m = slope[0] * y_m + slope[1] * x_m
    opd_m = opd_m + bend[0] * x_m * y_m + bend[1] * (x_m**2 + 0.5 * y_m**2) + bend[2] * (y_m**3 + 2 * x_m * y_m**2)
    # Means over the light: <y^2> = <x^2> = width^2 / 2, odd moments vanish; d(y^3 + 2 x y^2) = (3 y^2, 2 y^2).
    mean = np.array(slope) + bend[2] * width_m**2 / 2 * np.array([3.0, 2.0])
    spectrum = np.fft.fft2(amplitude * np.exp(2j * np.pi / WAVELENGTH_M * opd_m))
    squared = WIDE.fy_per_m**2 + WIDE.fx_per_m**2
    far = [np.fft.ifft2(spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * z * squared)) for z in PLANES_M]
    return abs(np.array(far)) ** 2, mean


@few
@given(
    slope=st.tuples(*2 * [st.floats(-5e-7, 5e-7)]),
    bend=st.tuples(*2 * [st.floats(-1e-7, 1e-7)], st.floats(-1e-8, 1e-8)),
    centre_m=st.tuples(*2 * [st.floats(-0.5, 0.5)]),
)
def test_images_move_by_the_mean_slope_times_the_distance(slope, bend, centre_m):
    """Ehrenfest's theorem for the paraxial wave; y and x are separate, so a swap or a sign fails."""
    images, mean = smooth_light(slope, bend, centre_m)
    ones = jnp.ones(images.shape)
    found = np.asarray(centroid_tilt(jnp.asarray(images), ones, PLANES_M, pixel_m=WIDE.pixel_m))
    np.testing.assert_allclose(found, mean, atol=1e-12)  # 2e-6 of the largest slope: what the tails at the rim move


@few
@given(slope=st.tuples(*2 * [st.floats(-5e-7, 5e-7)]), rows=st.integers(-6, 6), columns=st.integers(-6, 6))
def test_a_shifted_detector_or_a_brighter_plane_does_not_tilt(slope, rows, columns):
    images, _ = smooth_light(slope, (1e-7, -5e-8, 1e-8), (0.2, -0.3))
    moved = np.roll(images, (rows, columns), axis=(1, 2)) * np.array([1.0, 5.0, 0.2])[:, None, None]
    found, expected = (
        np.asarray(centroid_tilt(jnp.asarray(i), jnp.ones(i.shape), PLANES_M, pixel_m=WIDE.pixel_m))
        for i in (moved, images)
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


@few
@given(slope=st.tuples(*2 * [st.floats(-5e-7, 5e-7)]), piston_m=st.floats(-1e-6, 1e-6), seed=seeds)
def test_the_mean_slope_of_a_wavefront_is_its_plane(slope, piston_m, seed):
    rng = numbers(seed)
    grid = Grid((11, 14), 0.3)
    light = rng.uniform(size=grid.shape) * (rng.uniform(size=grid.shape) > 0.4)
    plane_m = slope[0] * grid.y_m + slope[1] * grid.x_m + piston_m
    wild = rng.normal(size=grid.shape) * 1e-6
    design = np.stack([np.ones(grid.shape), grid.y_m + 0 * grid.x_m, grid.x_m + 0 * grid.y_m]).reshape(3, -1)
    root = np.sqrt(light.ravel())
    fitted = np.linalg.lstsq((design * root).T, wild.ravel() * root, rcond=None)[0]
    found = np.asarray(mean_slope(jnp.asarray(plane_m + wild), jnp.asarray(light), grid))
    np.testing.assert_allclose(found, np.array(slope) + fitted[1:], atol=1e-16)


@few
@given(slope=st.tuples(*2 * [st.floats(-5e-7, 5e-7)]))
def test_the_phase_of_a_tilt_is_path_over_wavelength(slope):
    phase_rad = np.asarray(tilt_phase(jnp.asarray(slope), WIDE, WAVELENGTH_M))
    expected = 2 * np.pi / WAVELENGTH_M * (slope[0] * WIDE.y_m + slope[1] * WIDE.x_m)
    np.testing.assert_allclose(phase_rad, expected, atol=ROUNDING * 10)


# ------------------------------------------------------------------------------------ from grid to grid


@few
@given(seed=seeds, factor=st.integers(1, 4))
def test_blocks_keep_every_photon_where_it_was(seed, factor):
    fine = numbers(seed).poisson(3.0, (2, 3 * factor, 5 * factor)).astype(float)
    coarse = np.asarray(sum_blocks(jnp.asarray(fine), factor))
    for plane, row, column in np.ndindex(2, 3, 5):
        block = fine[plane, row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
        assert coarse[plane, row, column] == block.sum()


@few
@given(steps=st.tuples(*2 * [st.floats(-0.5, 0.5)]), wrapped=st.booleans(), finer=st.booleans())
def test_a_resampled_slope_is_the_same_slope(steps, wrapped, finer):
    coarse, fine = Grid((12, 15), 2.0), Grid((24, 30), 1.0)
    here, there = (coarse, fine) if finer else (fine, coarse)
    phase_rad = (steps[0] * here.y_m + steps[1] * here.x_m) / here.pixel_m
    expected = (steps[0] * there.y_m + steps[1] * there.x_m) / here.pixel_m
    found = np.asarray(resample_phase(jnp.asarray(phase_rad), there.shape, wrapped=wrapped))
    inner = (found - expected)[6:-6, 6:-6] if finer else (found - expected)[3:-3, 3:-3]
    turns = np.round(inner / (2 * np.pi)) if wrapped else 0.0
    # Wrapped: a chord between two phasors 1 rad apart, at its quarter, is 0.01 rad off; else cubics are exact.
    np.testing.assert_allclose(inner - 2 * np.pi * turns, 0, atol=0.02 if wrapped else 1e-9)


def test_binned_counts_fill_masked_pixels_with_their_neighbours():
    counts = np.full((1, 6, 8), 3.0)
    usable = np.ones(counts.shape, bool)
    usable[0, 2, 3], counts[0, 2, 3] = False, 1e6
    measured = Measurement(jnp.asarray(counts), jnp.asarray(usable), jnp.asarray(2.0)).binned(2)
    np.testing.assert_allclose(measured.counts, 12.0)
    assert bool(measured.usable.all())
    assert float(measured.read_variance) == 8.0  # four pixels read independently


# ------------------------------------------------------------------------------------ turbulence strength


def drawn_phase(rng: np.random.Generator, power: np.ndarray) -> np.ndarray:
    """Periodic Gaussian phase whose Fourier coefficients have `power` where white noise of variance 1 has 1."""
    white = np.fft.fft2(rng.normal(size=power.shape))
    return np.fft.ifft2(white * np.sqrt(power)).real


@pytest.mark.parametrize("shape", [(20, 23), (17, 24)])
def test_the_true_strength_is_a_fixed_point_on_average(shape):
    rng = numbers(11)
    half, noise, truth = shape[1] // 2 + 1, 0.05, 1.7
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None, :]
    power = 0.02 * np.maximum(np.hypot(fy, fx), 0.02) ** (-11 / 3) / 100
    light = jnp.asarray((rng.uniform(size=shape) > 0.3).astype(float))
    weights = jnp.asarray(slope_weights(Grid(shape, 0.3)))
    update = jax.jit(
        lambda strength, phase: updated_strength(
            strength, phase, light, jnp.asarray(power[:, :half]), weights, jnp.asarray(noise)
        )
    )
    ratios = []
    for _ in range(150):
        seen = drawn_phase(rng, truth * power) + rng.normal(0, np.sqrt(noise), shape)
        kept = np.fft.ifft2(np.fft.fft2(seen) * truth * power / (truth * power + noise)).real
        ratios.append(float(update(jnp.asarray(truth), jnp.asarray(kept))) / truth)
    assert np.mean(ratios) == pytest.approx(1, abs=5 * np.std(ratios) / np.sqrt(len(ratios)))
    assert np.std(ratios) < 0.25  # else five sigma would hide a wrong weight
    weak, strong = (float(update(jnp.asarray(s), jnp.asarray(kept))) / s for s in (0.01, 100.0))
    assert (weak, strong) == (pytest.approx(LARGEST_STEP), pytest.approx(1 / LARGEST_STEP))
