"""Frames in a row: air that the wind moves is followed in few FFTs as well as each frame alone in many.

The air is periodic and moves by whole cells, so it is moved exactly; the light is made in NumPy on cells three times
finer than the detector's pixels.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.errors import SettingsError
from nlcwfs.estimation import second_look
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.second_look import SecondLook
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sequence_budget import fixed_ffts, inner_steps
from nlcwfs.estimation.sequence_reconstructor import SequenceReconstructor
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.turned_regions import TurnedRegion

DIAMETER_M, PIXEL_M, WAVELENGTH_M = 8.0, 0.25, 0.65e-6
DISTANCES_M = (-3.5e6, -2.5e6, 2.6e6, 3.3e6)
FRAME, FINE, FINER = (48, 50), (288, 300), 3
PERIOD = 512  # cells of the air: five telescopes
OVER_FRIED, PHOTONS, FRAMES = 5.0, 2e4, 7
SPEED_M_PER_S, INTERVAL_S = 10.0, PIXEL_M / FINER / 10.0  # the air moves by one fine cell from frame to frame
METRES = WAVELENGTH_M / (2 * np.pi)


def centres(count: int, pixel_m: float) -> np.ndarray:
    return (np.arange(count) - (count - 1) / 2) * pixel_m


def disc(shape: tuple[int, int], pixel_m: float) -> np.ndarray:
    y_m, x_m = (centres(5 * n, pixel_m / 5) for n in shape)
    lit = y_m[:, None] ** 2 + x_m**2 < (DIAMETER_M / 2) ** 2
    return lit.reshape(shape[0], 5, shape[1], 5).mean(axis=(1, 3))


@functools.cache
def air() -> np.ndarray:
    """Kolmogorov's phase on a period (Noll 1976, eq. 21), rad."""
    fine_m = PIXEL_M / FINER
    frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(PERIOD, fine_m)], indexing="ij"))
    power = 0.0229 * (OVER_FRIED / DIAMETER_M) ** (5 / 3) * np.maximum(frequency, 0.02) ** (-11 / 3)
    white = np.fft.fft2(np.random.default_rng(21).normal(size=(PERIOD, PERIOD)))
    return np.fft.ifft2(white * np.sqrt(power) / fine_m).real


def truth_rad(number: int) -> np.ndarray:
    """What is above the telescope at a frame: the wind goes towards +x."""
    return np.roll(air(), number, axis=1)[: FINE[0], : FINE[1]]


def on_pixels(fine: np.ndarray) -> np.ndarray:
    summed = fine.reshape(FINE[0] // FINER, FINER, FINE[1] // FINER, FINER).sum(axis=(1, 3))
    top, left = ((have - want) // 2 for have, want in zip(summed.shape, FRAME, strict=True))
    return summed[top : top + FRAME[0], left : left + FRAME[1]]


def exposure(phase_rad: np.ndarray, seed: int) -> np.ndarray:
    """Photons on the four planes; z > 0 is downstream."""
    pupil = disc(FINE, PIXEL_M / FINER)
    fy, fx = (np.fft.fftfreq(n, PIXEL_M / FINER) for n in FINE)
    squared = fy[:, None] ** 2 + fx**2
    spectrum = np.fft.fft2(pupil / np.sqrt(np.sum(pupil**2)) * np.exp(1j * phase_rad))
    far = [np.fft.ifft2(spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * z * squared)) for z in DISTANCES_M]
    light = np.array([on_pixels(abs(one) ** 2) / len(DISTANCES_M) for one in far])
    return np.random.default_rng(seed).poisson(PHOTONS * light).astype(float)


WEIGHT = disc(FRAME, PIXEL_M) ** 2 / np.sum(disc(FRAME, PIXEL_M) ** 2)


def error_nm(estimate_m, phase_rad: np.ndarray) -> float:
    """Rms over the light, piston removed, of means over pixels."""
    off = np.asarray(estimate_m, float) - on_pixels(phase_rad) / FINER**2 * METRES
    off = off - np.sum(WEIGHT * off)
    return float(1e9 * np.sqrt(np.sum(WEIGHT * off**2)))


MAP = MapSettings(oversampling=1, window=1.4, ffts_per_frame=103)  # three conjugate gradients, as by default


def sensor(**options) -> SequenceReconstructor:
    geometry = SensorGeometry(PupilShape(DIAMETER_M), Grid(FRAME, PIXEL_M), WAVELENGTH_M, DISTANCES_M)
    settings = EstimationSettings(modes=200, map=MAP.model_copy(update=options))
    return SequenceReconstructor.build(geometry, settings, interval_s=INTERVAL_S, photons=PHOTONS)


USABLE = jnp.ones((4, *FRAME), bool)


class Stream:
    """Compiled, with the light of every frame."""

    def __init__(self):
        self.sequence = sensor()
        assert self.sequence.solver.level.grid.shape == FRAME
        self.start = eqx.filter_jit(lambda counts: self.sequence.start(counts, USABLE))
        self.follow = eqx.filter_jit(
            lambda counts, memory, known_m: self.sequence.follow(counts, USABLE, memory, known_m=known_m)
        )
        self.frames = [jnp.asarray(exposure(truth_rad(number), seed=number)) for number in range(FRAMES)]
        self.alone = [self.start(counts) for counts in self.frames]
        self.flat_m = jnp.zeros(FRAME)

    def errors_nm(self, estimates, first: int = 0) -> np.ndarray:
        return np.array([error_nm(one.opd_m, truth_rad(first + n)) for n, one in enumerate(estimates)])


@pytest.fixture(scope="module")
def stream() -> Stream:
    return Stream()


@pytest.fixture(scope="module")
def followed(stream) -> list:
    """All frames but the first, each after the other."""
    memory, estimates = stream.alone[0][1], []
    for counts in stream.frames[1:]:
        estimate, memory = stream.follow(counts, memory, stream.flat_m)
        estimates.append(estimate)
    return estimates


def test_followed_frames_are_as_good_as_each_alone_and_better_than_the_last_one(stream, followed):
    cold = stream.errors_nm([estimate for estimate, _ in stream.alone])
    warm = stream.errors_nm(followed, first=1)
    assert 10 < np.median(cold) < 18  # measured 13.8
    assert np.all(warm < 1.1 * np.median(cold))
    stale = np.array([error_nm(stream.alone[0][0].opd_m, truth_rad(n)) for n in range(1, FRAMES)])
    assert np.all(warm[2:] < stale[2:])  # the air of the first frame is gone
    assert all(Outcome(int(one.outcome_code)).succeeded for one in followed)


def test_the_error_told_of_a_followed_frame_is_near_the_error(stream, followed):
    told = 1e9 * np.array([float(one.predicted_error_m) for one in followed])
    ratio = stream.errors_nm(followed, first=1) / told
    assert np.all((ratio > 0.6) & (ratio < 1.1))  # measured 0.73 to 0.83: turbulence within a pixel is counted as error


def test_what_is_remembered_is_what_was_told(stream):
    """Phase and slope in memory are the wavefront, when no mirror is known: light with a tilt of its own shows it."""
    y_m, x_m = (centres(n, PIXEL_M / FINER) for n in FINE)
    tilted_rad = truth_rad(1) + (4e-8 * y_m[:, None] - 3e-8 * x_m) / METRES
    estimate, memory = stream.follow(jnp.asarray(exposure(tilted_rad, seed=72)), stream.alone[0][1], stream.flat_m)
    slope_y, slope_x = np.asarray(memory.slope, float)
    y_m, x_m = (centres(n, PIXEL_M) for n in FRAME)
    remembered_m = np.asarray(memory.phase_rad, float) * METRES + slope_y * y_m[:, None] + slope_x * x_m
    off_m = np.asarray(estimate.opd_m, float) - remembered_m
    assert 1e9 * np.std(off_m[WEIGHT > 0]) < 0.01  # single precision
    assert np.all(abs(np.asarray(memory.slope - stream.alone[0][1].slope)) > 1e-10)  # else its sign is not seen


def test_a_missing_frame_does_not_lose_the_air(stream):
    memory = stream.alone[0][1]
    for _ in range(2):
        memory = stream.sequence.skip(memory)
    for number in (3, 4):
        estimate, memory = stream.follow(stream.frames[number], memory, stream.flat_m)
    cold = stream.errors_nm([estimate for estimate, _ in stream.alone])
    assert error_nm(estimate.opd_m, truth_rad(4)) < 1.2 * np.median(cold)


def test_room_is_left_for_air_that_no_frame_has_seen(stream):
    """A tenth of the turbulence of each wave: a loop that trusts its prediction more ends at 143 instead of 72 nm."""
    memory = stream.alone[0][1]
    whole = np.asarray(stream.sequence.solver.power * memory.strength, float)
    known = np.asarray(memory.left_open, float) / whole
    expected = np.asarray(stream.sequence.skip(memory).left_open, float) / whole
    assert known.min() < 1e-3  # slow waves are well known when they have been seen
    assert np.all((expected > 0.0999) & (expected < 1.001))
    assert np.all(expected > known)


def test_the_shape_of_the_mirror_is_known_and_has_the_right_sign(stream):
    """Light that has met the mirror, whose shape the follower is told with a minus."""
    y_m, x_m = np.meshgrid(*(centres(n, PIXEL_M / FINER) / 4 for n in FINE), indexing="ij")
    mirror_rad = 2.0 * x_m * y_m + 1.5 * (x_m**2 - 0.5 * y_m**2) + y_m**3 - 0.7 * x_m
    left_rad = truth_rad(1) - mirror_rad
    known_m = jnp.asarray(-on_pixels(mirror_rad) / FINER**2 * METRES)
    memory = stream.alone[0][1]
    estimate, then = stream.follow(jnp.asarray(exposure(left_rad, seed=70)), memory, known_m)
    cold = np.median(stream.errors_nm([one for one, _ in stream.alone]))
    assert error_nm(estimate.opd_m, left_rad) < 1.2 * cold  # what the sensor saw
    again, _ = stream.follow(stream.frames[2], then, stream.flat_m)  # what is followed is the air, without the mirror
    assert error_nm(again.opd_m, truth_rad(2)) < 1.2 * cold
    wrong, _ = stream.follow(jnp.asarray(exposure(left_rad, seed=70)), memory, -known_m)
    assert error_nm(wrong.opd_m, left_rad) > 3 * cold


def test_a_frame_without_light_is_told(stream):
    estimate, _ = stream.follow(jnp.zeros((4, *FRAME)), stream.alone[0][1], stream.flat_m)
    assert estimate.outcome is Outcome.NO_LIGHT
    assert np.all(np.isfinite(estimate.opd_m))


def test_light_of_other_air_is_not_believed(stream):
    """A bird, or a star that was changed: the last frame says nothing of it, and two steps cannot reach it."""
    other = jnp.asarray(exposure(1.5 * np.roll(air(), 256, axis=0)[: FINE[0], : FINE[1]], seed=71))
    estimate, _ = stream.follow(other, stream.alone[0][1], stream.flat_m)
    assert estimate.outcome is Outcome.NOT_EXPLAINED


# ---------------------------------------------------------------------------------------- the second look


Y_M, X_M = np.meshgrid(*(centres(n, PIXEL_M) for n in FRAME), indexing="ij")


def planted(memory, middle_m: tuple[float, float], radius_m: float, turns: float):
    """The same memory with a disc of the phase some turns off, its rim two cells wide."""
    away_m = np.hypot(Y_M - middle_m[0], X_M - middle_m[1])
    island_rad = 2 * np.pi * turns / (1 + np.exp((away_m - radius_m) / (0.4 * PIXEL_M)))
    return eqx.tree_at(
        lambda one: one.phase_rad, memory, memory.phase_rad + jnp.asarray(island_rad, memory.phase_rad.dtype)
    )


@pytest.mark.parametrize(
    ("middle_m", "radius_m", "turns"), [((1.2, -3.4), 1.1, 1), ((-3.0, 2.0), 0.9, -1), ((0.8, -0.4), 1.0, 1)]
)
def test_an_island_at_the_rim_or_within_is_brought_back(stream, middle_m, radius_m, turns):
    memory, look = stream.alone[1][1], SecondLook.build(stream.sequence)
    wrong = planted(memory, middle_m, radius_m, turns)
    looked = look.look(stream.frames[1], USABLE, wrong)
    assert looked.turned == 1
    slope_m = np.asarray(memory.slope[0]) * Y_M + np.asarray(memory.slope[1]) * X_M
    before, planted_nm, after = (
        error_nm(np.asarray(one.phase_rad) * METRES + slope_m, truth_rad(1)) for one in (memory, wrong, looked.memory)
    )
    assert planted_nm > 8 * before  # it was worth it
    assert after < 1.2 * before  # measured 1.01
    off = np.asarray(looked.memory.phase_rad - wrong.phase_rad - looked.change_rad)
    assert abs(off).max() < 1e-4


def test_two_islands_of_unlike_signs_are_brought_back_behind_a_mirror(stream):
    """The mirror's shape is part of what the light has met; told with the wrong sign nothing fits."""
    y_m, x_m = np.meshgrid(*(centres(n, PIXEL_M / FINER) / 4 for n in FINE), indexing="ij")
    mirror_rad = 1.0 * x_m * y_m + 1.5 * (x_m**2 - 0.5 * y_m**2) + y_m**3 - 0.7 * x_m
    known_m = jnp.asarray(-on_pixels(mirror_rad) / FINER**2 * METRES)
    counts = jnp.asarray(exposure(truth_rad(1) - mirror_rad, seed=70))
    memory = stream.follow(counts, stream.alone[0][1], known_m)[1]
    wrong = planted(planted(memory, (1.2, -3.4), 1.1, 1), (-3.0, 2.0), 0.9, -1)
    looked = SecondLook.build(stream.sequence).look(counts, USABLE, wrong, known_m=known_m)
    assert looked.turned == 2
    slope_m = np.asarray(memory.slope[0]) * Y_M + np.asarray(memory.slope[1]) * X_M
    before, after = (
        error_nm(np.asarray(one.phase_rad) * METRES + slope_m, truth_rad(1)) for one in (memory, looked.memory)
    )
    assert after < 1.2 * before


def test_a_wavefront_without_islands_stays_as_it_is(stream):
    look = SecondLook.build(stream.sequence)
    for number in range(1, 4):
        memory = stream.alone[number][1]
        looked = look.look(stream.frames[number], USABLE, memory)
        assert looked.turned == 0
        assert np.array_equal(looked.memory.phase_rad, memory.phase_rad)
        assert looked.ffts >= 240  # 15 iterations of 16


def test_a_region_that_the_light_does_not_want_moved_stays(stream, monkeypatch):
    """Whatever is proposed, the likelihood and the prior decide."""
    look, memory = SecondLook.build(stream.sequence), stream.alone[1][1]
    region = TurnedRegion(np.hypot(Y_M - 1.2, X_M + 2.4) < 1.0, 1)
    monkeypatch.setattr(second_look, "turned_regions", lambda *_, **__: [region])
    looked = look.look(stream.frames[1], USABLE, memory)
    assert (looked.turned, float(abs(looked.change_rad).max())) == (0, 0.0)
    assert looked.ffts > 240


# -------------------------------------------------------------------------------------------- the budget


def cells_in(jaxpr) -> float:
    """Cells that the FFTs of a program go through, those of loops as often as they run; a real FFT counts half."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "fft":
            kind = equation.params["fft_type"].name
            shape = equation.invars[0].aval.shape[:-2]
            cells = np.prod(shape, dtype=float) * np.prod(equation.params["fft_lengths"], dtype=float)
            total += cells * (0.5 if "RFFT" in kind else 1.0)
        assert equation.primitive.name != "while"  # a fixed number is what was promised
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                total += times * cells_in(inner) if hasattr(inner, "eqns") else 0
    return total


@pytest.mark.parametrize(("budget", "oversampling"), [(80, 2), (100, 2), (150, 2), (110, 1)])
def test_a_followed_frame_keeps_to_its_budget_and_uses_it(budget, oversampling):
    """With two cells of the model a pixel, as by default, FFTs of images are a quarter of one of the model."""
    sequence = sensor(ffts_per_frame=budget, oversampling=oversampling)
    memory = jax.eval_shape(lambda: sequence.start(jnp.ones((4, *FRAME)), USABLE)[1])
    program = jax.make_jaxpr(lambda counts, memory: sequence.follow(counts, USABLE, memory))(
        jnp.ones((4, *FRAME)), memory
    )
    ffts = cells_in(program.jaxpr) / np.prod(sequence.solver.level.grid.shape)
    assert ffts == sequence.ffts <= budget
    more = (*sequence.inner[:-1], sequence.inner[-1] + 1)
    assert fixed_ffts(4, inner=more, oversampling=oversampling) > budget  # not one conjugate gradient more would fit


def test_a_budget_for_nothing_is_refused_with_the_least_that_would_do():
    least = fixed_ffts(4, inner=(1,) * MAP.sequence_steps, oversampling=MAP.oversampling)
    assert inner_steps(4, budget=least, steps=3, oversampling=MAP.oversampling) == (1, 1, 1)
    with pytest.raises(SettingsError, match=rf"ffts_per_frame: must be at least {least} for 4 planes.*got {least - 1}"):
        sensor(ffts_per_frame=least - 1)


@pytest.mark.parametrize("wrong", [{"interval_s": 0.0}, {"interval_s": float("nan")}, {"photons": -1.0}])
def test_frames_that_do_not_follow_each_other_are_refused(wrong):
    geometry = SensorGeometry(PupilShape(DIAMETER_M), Grid(FRAME, PIXEL_M), WAVELENGTH_M, DISTANCES_M)
    with pytest.raises(SettingsError, match="interval_s and photons: must be positive"):
        SequenceReconstructor.build(geometry, EstimationSettings(map=MAP), **{"interval_s": 0.01} | wrong)
