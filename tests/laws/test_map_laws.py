"""What the parts of the maximum a posteriori reconstruction do whatever the pupil, the phase and the noise."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.angle import phasor
from nlcwfs.estimation.ladder import finest_level
from nlcwfs.estimation.resolution_level import Level, Measurement
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import PlaneScale, mean_counts, plane_scale
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase

WAVELENGTH_M = 0.65e-6
PIXEL_M = 0.2
DISTANCES_M = (-1.1e5, 0.6e5, 1.4e5)  # about one Fresnel number on a pupil of two metres
ROUNDING = 1e-11  # a few FFTs of some hundred pixels in float64, for numbers of order 1

few = settings(max_examples=20, deadline=None)  # the first example of a shape compiles
seeds = st.integers(0, 2**32 - 1)
shapes = st.sampled_from([(12, 15), (15, 12), (9, 14)])  # odd and even, never square


def numbers(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


# ---------------------------------------------------------------------------- the phase as white unknowns


def random_power(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Positive, the same for a wave and its conjugate, over three decades; whole spectrum."""
    log = rng.uniform(-2, 1, shape)
    conjugate = np.roll(log[::-1, ::-1], (1, 1), axis=(0, 1))
    return 10 ** ((log + conjugate) / 2)


def half(whole: np.ndarray) -> np.ndarray:
    return whole[:, : whole.shape[1] // 2 + 1]


def whitened(power: np.ndarray, *, tilt_rms_rad: float = 0.7, diameter_m: float = 2.0) -> WhitenedPhase:
    grid = Grid(power.shape, PIXEL_M)
    return WhitenedPhase.build(grid, jnp.asarray(half(power)), tilt_rms_rad=tilt_rms_rad, diameter_m=diameter_m)


def white_unknown(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[Unknown, np.ndarray]:
    """An unknown drawn from its prior, and the image of white noise whose half spectrum it is."""
    noise = rng.normal(size=shape)
    waves = half(np.fft.fft2(noise)) / np.sqrt(noise.size)
    return Unknown(jnp.asarray(waves), jnp.asarray(rng.normal(size=2))), noise


@few
@given(seed=seeds, shape=shapes, tilt_rms_rad=st.floats(0.1, 10.0))
def test_a_phase_drawn_white_has_the_power_asked_for(seed, shape, tilt_rms_rad):
    """In NumPy, on the whole spectrum: each wave of white noise times the root of its power; and 2 r / R of a tilt."""
    rng = numbers(seed)
    power = random_power(rng, shape)
    unknown, noise = white_unknown(rng, shape)
    waves = np.fft.ifft2(np.fft.fft2(noise) * np.sqrt(power))
    np.testing.assert_allclose(waves.imag, 0, atol=ROUNDING)
    y_m, x_m = ((np.arange(n) - (n - 1) / 2) * PIXEL_M for n in shape)
    tilt_y, tilt_x = np.asarray(unknown.slope) * tilt_rms_rad
    tilt = 2 * (tilt_y * y_m[:, None] + tilt_x * x_m) / 1.3  # radius 1.3 m
    found = whitened(power, tilt_rms_rad=tilt_rms_rad, diameter_m=2.6).phase_rad(unknown)
    np.testing.assert_allclose(found, waves.real + tilt, atol=ROUNDING * (1 + 10 * tilt_rms_rad))


@few
@given(seed=seeds, shape=shapes)
def test_the_energy_of_a_white_unknown_is_that_of_the_noise_in_all_its_pixels(seed, shape):
    """Parseval: as many degrees of freedom as pixels, and two for the tilt."""
    unknown, noise = white_unknown(numbers(seed), shape)
    solver = whitened(np.ones(shape))
    expected = np.sum(noise**2) + np.sum(np.asarray(unknown.slope) ** 2)
    assert float(solver.dot(unknown, unknown)) == pytest.approx(expected, rel=1e-12)


@few
@given(seed=seeds, shape=shapes)
def test_the_transpose_of_the_phase_is_its_adjoint(seed, shape):
    """For any complex numbers: those that no real phase has must count for nothing in the same way."""
    rng = numbers(seed)
    solver = whitened(random_power(rng, shape))
    size = half(np.zeros(shape)).shape
    waves = rng.normal(size=size) + 1j * rng.normal(size=size)
    unknown, image = Unknown(jnp.asarray(waves), jnp.asarray(rng.normal(size=2))), rng.normal(size=shape)
    there = float(np.sum(np.asarray(solver.phase_rad(unknown)) * image))
    back = float(solver.dot(unknown, solver.transposed(jnp.asarray(image))))
    # The sums of 200 products of size 10 cancel.
    assert there == pytest.approx(back, abs=1e-10)
    assert abs(there) > 1e-6


@few
@given(seed=seeds, shape=shapes, noise=st.floats(0, 10))
def test_a_start_is_the_phase_as_wiener_would_filter_it(seed, shape, noise):
    rng = numbers(seed)
    power, phase_rad = random_power(rng, shape), rng.normal(size=shape)
    solver = whitened(power)
    found = solver.phase_rad(solver.start(jnp.asarray(phase_rad), noise_variance=noise))
    expected = np.fft.ifft2(np.fft.fft2(phase_rad) * power / (power + noise)).real
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilt_of_unit_slope_has_the_rms_told_over_the_disc_and_one_direction(axis):
    solver = WhitenedPhase.build(Grid((120, 131), 0.02), jnp.ones((120, 66)), tilt_rms_rad=3.0, diameter_m=2.0)
    y_m, x_m = ((np.arange(n) - (n - 1) / 2) * 0.02 for n in (120, 131))
    disc = np.hypot(y_m[:, None], x_m) < 1
    slope = jnp.zeros(2).at[axis].set(1.0)
    tilt = np.asarray(solver.phase_rad(Unknown(jnp.zeros((120, 66), complex), slope)))
    assert np.std(tilt[disc]) == pytest.approx(3.0, rel=5e-3)  # the staircase of the rim
    along = np.mean(np.diff(tilt, axis=axis))
    assert along == pytest.approx(3.0 * 2 / 1.0 * 0.02, rel=1e-12)  # 2 r / R, growing with the row or column
    np.testing.assert_allclose(np.diff(tilt, axis=1 - axis), 0, atol=ROUNDING)


# ------------------------------------------------------------------------------------ the sensor's counts


@functools.cache
def level(shape: tuple[int, int], oversampling: int) -> Level:
    """Measured pixels of this shape, as many cells of the model as the oversampling says, no rim."""
    geometry = SensorGeometry(
        pupil=PupilShape(diameter_m=1.0, amplitude_map=np.ones(shape), map_pixel_m=PIXEL_M),
        frame=Grid(shape, PIXEL_M),
        wavelength_m=WAVELENGTH_M,
        distances_m=DISTANCES_M,
    )
    found = finest_level(geometry, Turbulence(0.2), oversampling=oversampling, window=1.2, dtype="float64")
    assert found.measured_shape == shape
    return found


def with_pupil(level: Level, pupil: np.ndarray) -> Level:
    """The level with another pupil, so that one compilation serves all."""
    light = pupil**2
    parts = (pupil, pupil / np.sqrt(np.sum(light)), light / np.max(light), light / np.sum(light))
    return eqx.tree_at(lambda x: (x.optics.pupil, x.modulus, x.light, x.weight), level, tuple(map(jnp.asarray, parts)))


def random_pupil(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    pupil = rng.uniform(0.1, 1, shape) * (rng.uniform(size=shape) > 1 / 3)
    assume(pupil.max() > 0)
    return pupil


def field(pupil, phase_rad) -> np.ndarray:
    """Light of unit power."""
    return pupil / np.sqrt(np.sum(pupil**2)) * np.exp(1j * phase_rad)


def travelled(near: np.ndarray, pixel_m: float) -> np.ndarray:
    """The field on every plane: Fresnel's factor, in NumPy."""
    fy, fx = (np.fft.fftfreq(n, pixel_m) for n in near.shape)
    squared = fy[:, None] ** 2 + fx**2
    factor = np.array([np.exp(-1j * np.pi * WAVELENGTH_M * z * squared) for z in DISTANCES_M])
    return np.fft.ifft2(np.fft.fft2(near) * factor)


def blocks(array: np.ndarray, factor: int) -> np.ndarray:
    planes, rows, columns = array.shape
    return array.reshape(planes, rows // factor, factor, columns // factor, factor).sum(axis=(2, 4))


class Sensor:
    """A random pupil with a random phase, counts and backgrounds; the definition of its light in NumPy."""

    def __init__(self, seed: int, shape: tuple[int, int], oversampling: int):
        self.rng, self.oversampling = numbers(seed), oversampling
        self.cells = tuple(n * oversampling for n in shape)
        self.pupil = random_pupil(self.rng, self.cells)
        self.level = with_pupil(level(shape, oversampling), self.pupil)
        self.counts, self.background = self.rng.uniform(1e3, 1e4, 3), self.rng.uniform(0, 5, 3)
        self.phase_rad = self.rng.normal(0, 2.0, self.cells)

    @property
    def scale(self) -> PlaneScale:
        return PlaneScale(jnp.asarray(self.counts)[:, None, None], jnp.asarray(self.background)[:, None, None])

    def light(self, phase_rad: np.ndarray) -> np.ndarray:
        far = travelled(field(self.pupil, phase_rad), PIXEL_M / self.oversampling)
        return blocks(abs(far) ** 2, self.oversampling)

    def seen(self, phase_rad: np.ndarray) -> np.ndarray:
        return self.counts[:, None, None] * self.light(phase_rad) + self.background[:, None, None]


@eqx.filter_jit
def _linearised(level, scale, phase_rad, change_rad, weights):
    counts, along = jax.linearize(lambda phase: mean_counts(level, scale, phase), phase_rad)
    (back,) = jax.linear_transpose(along, phase_rad)(weights)
    return counts, along(change_rad), back


def linearised(case: Sensor, change_rad: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Counts, their change, and the transpose of the change on weights."""
    given = (jnp.asarray(one) for one in (case.phase_rad, change_rad, weights))
    return [np.asarray(one) for one in _linearised(case.level, case.scale, *given)]


cases = given(seed=seeds, shape=shapes, oversampling=st.sampled_from([1, 2]))
POLYNOMIAL = 1e-8  # of the fast sine and cosine, relative to the largest: Abramowitz & Stegun 1964, 4.3.97, 4.3.99


@few
@cases
def test_mean_counts_are_the_light_of_the_planes_times_gain_plus_background(seed, shape, oversampling):
    case = Sensor(seed, shape, oversampling)
    change_rad, weights = np.zeros(case.cells), np.zeros((3, *shape))
    counts, _, _ = linearised(case, change_rad, weights)
    np.testing.assert_allclose(counts, case.seen(case.phase_rad), atol=POLYNOMIAL * counts.max())
    mirrored = case.seen(-case.phase_rad)
    assert np.max(abs(counts - mirrored)) > 0.01 * counts.max()  # the other sign is another image


@few
@cases
def test_the_jacobian_of_the_counts_is_that_of_finite_differences(seed, shape, oversampling):
    """Central differences of the light in NumPy."""
    case = Sensor(seed, shape, oversampling)
    change_rad = case.rng.normal(size=case.cells)
    _, change, _ = linearised(case, change_rad, np.zeros((3, *shape)))
    step = 1e-5  # its cube leaves 1e-10 of the change, rounding 1e-11
    ahead, behind = (case.seen(case.phase_rad + sign * step * change_rad) for sign in (1, -1))
    np.testing.assert_allclose(change, (ahead - behind) / (2 * step), atol=2 * POLYNOMIAL * abs(change).max())
    assert abs(change).max() > 1


@few
@cases
def test_the_transpose_of_the_jacobian_is_its_adjoint(seed, shape, oversampling):
    case = Sensor(seed, shape, oversampling)
    change_rad, weights = case.rng.normal(size=case.cells), case.rng.normal(size=(3, *shape))
    _, change, back = linearised(case, change_rad, weights)
    size = np.linalg.norm(change) * np.linalg.norm(weights)
    assert np.sum(change * weights) == pytest.approx(np.sum(change_rad * back), abs=1e-13 * size)
    assert size > 1
    assert np.linalg.norm(back[case.pupil == 0]) == 0  # where no light is, no count knows the phase


@few
@given(seed=seeds, size=st.floats(1e-3, 1e3))
def test_the_phasor_turns_as_the_exponential_does(seed, size):
    rng = numbers(seed)
    phase_rad, change = np.r_[size * rng.normal(size=40), np.arange(-8, 9) * np.pi / 4], rng.normal(size=57)
    value, found = jax.jvp(phasor, (jnp.asarray(phase_rad),), (jnp.asarray(change),))
    np.testing.assert_allclose(value, np.exp(1j * phase_rad), atol=5e-9)
    step = 1e-5
    difference = (np.exp(1j * (phase_rad + step * change)) - np.exp(1j * (phase_rad - step * change))) / (2 * step)
    np.testing.assert_allclose(found, difference, atol=2e-8)  # 5e-9 times changes of 3, and the cube of the step


# ----------------------------------------------------------------------------- gain and background of planes


@few
@given(seed=seeds, fits_background=st.booleans(), background=st.floats(0.0, 20.0))
def test_any_gain_of_a_plane_is_found_from_the_pixels_that_count(seed, fits_background, background):
    rng = numbers(seed)
    light = rng.exponential(1e-3, (4, 12, 15))
    gain, usable = 10 ** rng.uniform(1, 6, (4, 1, 1)), rng.uniform(size=light.shape) > 0.3
    offset = np.full((4, 1, 1), background) * rng.uniform(size=(4, 1, 1)) * fits_background
    counts = np.where(usable, gain * light + offset, rng.choice([0.0, 1e9, np.nan], light.shape))
    measured = Measurement(jnp.asarray(counts), jnp.asarray(usable), jnp.asarray(0.0))
    found = plane_scale(jnp.asarray(light), measured, fits_background=fits_background)
    # A straight line of a gain 10 that gives 0.01 counts, on a background of 20: the sums lose four digits.
    np.testing.assert_allclose(found.counts, gain, rtol=1e-8)
    np.testing.assert_allclose(found.background, offset, atol=1e-9 * (1 + np.max(gain * light)))


@few
@given(seed=seeds)
def test_told_shares_take_the_light_of_all_planes_together(seed):
    rng = numbers(seed)
    light, gain = rng.exponential(1e-3, (3, 9, 14)), rng.uniform(1e2, 1e4, (3, 1, 1))
    shares = rng.dirichlet(np.ones(3))
    measured = Measurement(jnp.asarray(gain * light), jnp.ones(light.shape, bool), jnp.asarray(0.0))
    found = plane_scale(jnp.asarray(light), measured, fits_background=False, shares=jnp.asarray(shares))
    np.testing.assert_allclose(np.ravel(found.counts), shares * gain.sum(), rtol=1e-12)


def test_noise_does_not_bias_gain_or_background():
    """A flat plane would not do: it must know bright pixels from dark ones."""
    rng = numbers(3)
    light = rng.exponential(1.0, (1, 40, 40))
    light /= light.sum()
    draws = rng.poisson(2e3 * light + 0.5, (400, 40, 40))
    found = [
        plane_scale(
            jnp.asarray(light),
            Measurement(jnp.asarray(one[None] * 1.0), jnp.ones(light.shape, bool), jnp.asarray(0.0)),
            fits_background=True,
        )
        for one in draws
    ]
    gain, background = ([float(one[part].sum()) for one in found] for part in (0, 1))
    for values, truth in ((gain, 2e3), (background, 0.5)):
        sigma = np.std(values) / np.sqrt(len(values))
        assert np.mean(values) == pytest.approx(truth, abs=5 * sigma)
        assert sigma < 0.01 * truth  # else five sigma would hide anything


# ------------------------------------------------------------------------------------------------- mirrors


def step(level: Level, counts: np.ndarray, usable: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Phase after two steps of Fisher scoring from the flat one."""
    return np.asarray(_stepped(level, *(jnp.asarray(one) for one in (counts, usable, half(power)))))


@eqx.filter_jit
def _stepped(level: Level, counts, usable, power):
    prior = WhitenedPhase.build(level.grid, power, tilt_rms_rad=0.5, diameter_m=2.5)
    scale = PlaneScale(jnp.full((3, 1, 1), 3e3), jnp.full((3, 1, 1), 0.1))
    problem = gn.Problem(
        expected=lambda phase_rad: mean_counts(level, scale, phase_rad),
        counts=counts,
        usable=usable,
        dark=jnp.full((3, 1, 1), 0.3),
        known_rad=jnp.zeros(level.grid.shape),
        prior=prior,
        information=jnp.asarray(5.0),
        shown=Unknown(jnp.ones(()), jnp.ones(2)),
    )
    state = gn.init(problem, prior.nothing())
    for _ in range(2):
        state = gn.step(problem, 4, state)
    return prior.phase_rad(state.unknown)


def turned_optics(level: Level, turn) -> Level:
    return eqx.tree_at(lambda one: one.optics.transfer, level, turn(level.optics.transfer))


@few
@given(seed=seeds, shape=shapes)
def test_light_from_the_other_side_of_the_pupil_gives_the_phase_of_the_other_sign(seed, shape):
    """I(-z, phi) = I(z, -phi): the same counts behind conjugate travel are those of the negative phase."""
    case = Sensor(seed, shape, 1)
    counts = case.rng.poisson(3e3 * case.light(0.3 * case.phase_rad)).astype(float)
    usable = case.rng.uniform(size=counts.shape) > 0.1
    power = random_power(case.rng, shape)
    here = step(case.level, counts, usable, power)
    there = step(turned_optics(case.level, jnp.conj), counts, usable, power)
    np.testing.assert_allclose(there, -here, atol=1e-8)
    assert np.std(here) > 1e-3


@few
@given(seed=seeds, shape=shapes, axes=st.sampled_from([(0,), (1,), (0, 1)]))
def test_mirrored_counts_give_the_mirrored_phase(seed, shape, axes):
    case = Sensor(seed, shape, 1)
    counts = case.rng.poisson(3e3 * case.light(0.3 * case.phase_rad)).astype(float)
    usable = case.rng.uniform(size=counts.shape) > 0.1
    power = random_power(case.rng, shape)
    of_planes = tuple(axis + 1 for axis in axes)
    frequencies = np.roll(np.flip(power, axes), [1] * len(axes), axes)
    mirrored = with_pupil(case.level, np.flip(case.pupil, axes))
    here = step(case.level, counts, usable, power)
    there = step(mirrored, np.flip(counts, of_planes), np.flip(usable, of_planes), frequencies)
    np.testing.assert_allclose(there, np.flip(here, axes), atol=1e-8)
    assert np.max(abs(there - here)) > 1e-3
