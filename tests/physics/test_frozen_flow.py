"""Moving air: it keeps its shape, goes where the wind blows, and is Kolmogorov's in space and in time."""

import math

import aotools
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import jv

from nlcwfs.atmosphere.frozen_flow import FINEST, FrozenFlow, WindLayer, unrepeated_s
from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.errors import SettingsError

WAVELENGTH_M = 0.5e-6
TO_RAD = 2 * np.pi / WAVELENGTH_M
SHAPE, PIXEL_M, PERIOD = (18, 25), 0.25, 210
GRID = {"shape": SHAPE, "pixel_m": PIXEL_M, "period": PERIOD}
KOLMOGOROV = Turbulence(1.0, WAVELENGTH_M)
SKEW = WindLayer(1.0, 11.0, 130.0)
"""Towards -x and more towards +y: no symmetry hides a sign."""

VELOCITY = 11.0 * np.array([math.sin(math.radians(130)), math.cos(math.radians(130))])


def screens_of(turbulence=KOLMOGOROV, *, shape=SHAPE, period=PERIOD, dtype="float64"):
    return PhaseScreens.build(turbulence, shape=shape, pixel_m=PIXEL_M, period=period, dtype=dtype)


def watched_rad(screens, layers, times_s, *, count, seed):
    """Phase of independent airs at some moments, `[air, time, y, x]`."""
    times = jnp.asarray(times_s, screens.amplitude_m.dtype)

    def watch(key):
        flow = FrozenFlow.build(screens, layers, key)
        return jax.lax.map(flow.opd_m, times)

    keys = jax.random.split(jax.random.key(seed), count)
    return TO_RAD * np.asarray(jax.jit(lambda keys: jax.lax.map(watch, keys))(keys), float)


def structure(phase_rad, rows, columns):
    """Mean square difference over a separation, for every screen."""
    height, width = phase_rad.shape[1:]
    first = phase_rad[:, max(0, -rows) : height - max(0, rows), max(0, -columns) : width - max(0, columns)]
    second = phase_rad[:, max(0, rows) : height + min(0, rows), max(0, columns) : width + min(0, columns)]
    return np.mean((second - first) ** 2, axis=(1, 2))


def agrees(sample, expected, *, share, most=0.25):
    """The mean of independent numbers is what it should be: within 5 sigma and a share for what is finite."""
    error = 5 * sample.std() / np.sqrt(sample.size)
    assert error < most * expected  # else the test could not tell
    np.testing.assert_allclose(sample.mean(), expected, atol=error + share * expected)


# ------------------------------------------------------------------------------- it moves, and keeps its shape


def lonely(flow, fine_m=None, *, wave=None):
    """A flow of one layer that holds a given pattern alone, or one of its long waves alone."""
    layer = flow.layers[0]
    fine = jnp.zeros_like(layer.fine_m) if fine_m is None else jnp.asarray(fine_m)
    low = jnp.zeros_like(layer.low_m) if wave is None else jnp.zeros_like(layer.low_m).at[wave].set(1.0 - 0.7j)
    return eqx.tree_at(lambda one: (one.layers[0].fine_m, one.layers[0].low_m), flow, (fine, low))


@pytest.mark.parametrize("time_s", [0.0, 0.003, 0.37, 4.9])  # the last one is beyond the seam of the period
@pytest.mark.parametrize("cycles", [(1, 0), (-17, 30), (84, -84), (84, 3)])  # up to 0.8 of 105, the finest that fits
def test_every_wave_of_the_fine_structure_is_where_the_wind_took_it(cycles, time_s):
    y, x = np.indices((PERIOD, PERIOD))
    waves = np.array(cycles) / PERIOD  # cycles per pixel
    flow = FrozenFlow.build(screens_of(), [SKEW], jax.random.key(0))
    moved = lonely(flow, np.cos(2 * np.pi * (waves[0] * y + waves[1] * x) + 0.4)).opd_m(time_s)
    y, x = np.indices(SHAPE)
    way = VELOCITY / PIXEL_M * time_s
    expected = np.cos(2 * np.pi * (waves[0] * (y - way[0]) + waves[1] * (x - way[1])) + 0.4)
    # An interpolation of 32 taps is off by 2.1e-5 along each axis for the finest wave.
    np.testing.assert_allclose(moved, expected, atol=4.5e-5)
    assert max(np.abs(cycles)) <= FINEST * PERIOD / 2


@pytest.mark.parametrize("wave", [0, 21, 100, 440])
def test_every_long_wave_is_where_the_wind_took_it(wave):
    screens = screens_of()
    flow = lonely(FrozenFlow.build(screens, [SKEW], jax.random.key(0)), wave=wave)
    frequency = np.array(screens.low_frequency_per_m[wave])
    y, x = ((np.arange(n) - (n - 1) / 2) * PIXEL_M for n in SHAPE)
    y, x = np.meshgrid(y, x, indexing="ij")

    def at(time_s):
        way = VELOCITY * time_s
        return ((1 - 0.7j) * np.exp(2j * np.pi * (frequency[0] * (y - way[0]) + frequency[1] * (x - way[1])))).real

    for time_s in (0.0, 0.05, 30.0):
        # Less 1, its value in the middle at time 0. Rounding of the 1 that NumPy's wave carries along.
        np.testing.assert_allclose(flow.opd_m(time_s), at(time_s) - 1.0, rtol=1e-6, atol=1e-13)


def test_the_air_moves_by_whole_pixels_without_a_change():
    flow = FrozenFlow.build(screens_of(), [WindLayer(1.0, 5.0, -math.degrees(math.atan2(3, 4)))], jax.random.key(1))
    before, after = np.asarray(flow.opd_m(0.1)), np.asarray(flow.opd_m(0.1 + 0.25))  # 3 pixels to -y and 4 to +x
    np.testing.assert_allclose(after[:-3, 4:], before[3:, :-4], atol=1e-10 * before.std())
    assert np.abs(after[:-3, :-4] - before[3:, 4:]).max() > 0.1 * before.std()  # the other way it does not fit


def test_the_air_between_pixels_is_its_fourier_series():
    flow = FrozenFlow.build(screens_of(), [SKEW], jax.random.key(2))
    layer, time_s = flow.layers[0], 0.7345
    frequency = np.fft.fftfreq(PERIOD)
    turn = np.exp(-2j * np.pi * np.add.outer(frequency * VELOCITY[0], frequency * VELOCITY[1]) * time_s / PIXEL_M)
    series = np.fft.ifft2(np.fft.fft2(np.asarray(layer.fine_m)) * turn).real[: SHAPE[0], : SHAPE[1]]
    moved = np.asarray(lonely(flow, layer.fine_m).opd_m(time_s))
    # 5e-6 of waves up to half the finest, which hold nearly all; values reach four times their rms.
    np.testing.assert_allclose(moved, series, atol=3e-5 * np.asarray(layer.fine_m).std())
    finest = np.abs(np.fft.fft2(np.asarray(layer.fine_m)))[np.abs(frequency) > FINEST / 2]
    assert finest.max() < 1e-9 * np.abs(np.fft.fft2(np.asarray(layer.fine_m))).max()  # nothing it could not move


@pytest.mark.parametrize(("direction_deg", "moved"), [(0, (0, 3)), (90, (3, 0)), (180, (0, -3)), (-90, (-3, 0))])
def test_the_wind_carries_a_hill_to_where_it_blows(direction_deg, moved):
    y, x = np.indices((PERIOD, PERIOD))
    flow = FrozenFlow.build(screens_of(), [WindLayer(1.0, 7.5, float(direction_deg))], jax.random.key(0))
    flow = lonely(flow, np.exp(-((y - 8) ** 2 + (x - 11) ** 2) / 4.5))
    hill = np.asarray(flow.opd_m(0.1))  # 0.75 m
    assert np.unravel_index(hill.argmax(), SHAPE) == (8 + moved[0], 11 + moved[1])


# --------------------------------------------------------------------------------------- its statistics


@pytest.mark.parametrize("outer_scale_m", [math.inf, 6.0])
def test_differences_across_moving_air_follow_the_law(outer_scale_m):
    screens = screens_of(Turbulence(1.0, WAVELENGTH_M, outer_scale_m), period=100, dtype="float32")
    phase = watched_rad(screens, [SKEW], [1.234], count=1000, seed=3)[:, 0]  # between pixels
    for steps in (4, 8, 16):
        distance_m = steps * PIXEL_M
        if math.isinf(outer_scale_m):
            expected = 6.88 * distance_m ** (5 / 3)
        else:
            near, far = aotools.phase_covariance(np.array([1e-9, distance_m]), 1.0, outer_scale_m)
            expected = 2 * (near - far)
        # 2 % for the finite cells of the low frequencies, 1 % for what is finer than the pixels.
        agrees(structure(phase, 0, steps), expected, share=0.03)


def test_differences_in_time_are_those_over_the_way_of_the_wind():
    # Taylor: D(t) = 6.88 (v t / r0)^(5/3), from a few pixels to far beyond the grid, which is 6 m wide.
    ways_m = np.array([1.1, 3.3, 9.9, 24.0])
    phase = watched_rad(screens_of(dtype="float32"), [SKEW], [0.0, *(ways_m / 11.0)], count=900, seed=4)
    for number, way_m in enumerate(ways_m, 1):
        sample = np.mean((phase[:, number] - phase[:, 0]) ** 2, axis=(1, 2))
        agrees(sample, 6.88 * way_m ** (5 / 3), share=0.03, most=0.3)


def tilt_change(way_m: float, diameter_m: float, *, along: bool) -> float:
    """Mean square change of a Zernike tilt (Noll 1976, eqs. 8 and 21) while Kolmogorov's air with r0 = 1 moves."""

    def per_log(log_frequency: float) -> float:
        frequency = math.exp(log_frequency)
        angle = np.pi * diameter_m * frequency
        seen = 4 * (2 * jv(2, angle) / angle) ** 2
        theta = (np.arange(400) + 0.5) * np.pi / 400
        share = np.cos(theta) ** 2 if along else np.sin(theta) ** 2
        change = 4 * np.sin(np.pi * frequency * way_m * np.cos(theta)) ** 2  # |1 - exp(2 pi i f way)|^2
        return 0.0229 * frequency ** (2 - 11 / 3) * seen * 2 * np.pi * np.mean(share * change)

    return quad(per_log, math.log(1e-5), math.log(20), limit=400)[0]


def test_the_tilt_wanders_as_the_aperture_averages_it():
    size, way_m = 32, 3.0
    screens = screens_of(shape=(size, size), period=100, dtype="float32")
    wind = WindLayer(1.0, 10.0, 0.0)
    phase = watched_rad(screens, [wind], [0.0, way_m / 10.0, 1.7], count=1200, seed=5)
    y, x = np.indices((size, size)) - (size - 1) / 2
    disc = np.hypot(y, x) <= size / 2
    diameter_m = 2 * np.sqrt(disc.sum() / np.pi) * PIXEL_M
    radius = diameter_m / 2 / PIXEL_M
    shapes = np.array([np.ones(disc.sum()), 2 * x[disc] / radius, 2 * y[disc] / radius])
    tilts = phase[:, :, disc] @ np.linalg.pinv(shapes)
    # Noll's variance of a tilt, 0.449 (D/r0)^(5/3), does not change with time; the edge's pixels cost 3 %.
    for moment in range(3):
        for axis in (1, 2):
            agrees(tilts[:, moment, axis] ** 2, 0.449 * diameter_m ** (5 / 3), share=0.03)
    # Its change depends on the direction, too.
    changes = {axis: tilt_change(way_m, diameter_m, along=axis == 1) for axis in (1, 2)}
    assert changes[1] > 1.3 * changes[2]
    for axis, expected in changes.items():
        agrees((tilts[:, 1, axis] - tilts[:, 0, axis]) ** 2, expected, share=0.03)


def test_layers_are_unrelated_and_share_the_turbulence():
    layers = [WindLayer(0.7, 8.0, 0.0), WindLayer(0.3, 20.0, 90.0)]
    screens = screens_of(period=100, dtype="float32")

    def watch(key):
        flow = FrozenFlow.build(screens, layers, key)
        return jnp.stack([*(layer.opd_m(0.321) for layer in flow.layers), flow.opd_m(0.321)])

    keys = jax.random.split(jax.random.key(6), 600)
    phase = TO_RAD * np.asarray(jax.jit(lambda keys: jax.lax.map(watch, keys))(keys), float)
    np.testing.assert_allclose(phase[:, 2], phase[:, 0] + phase[:, 1], atol=1e-5 * phase.std())
    law = 6.88 * (8 * PIXEL_M) ** (5 / 3)
    for number, share in enumerate((0.7, 0.3, 1.0)):
        agrees(structure(phase[:, number], 0, 8), share * law, share=0.03)
    slopes = [(phase[:, number, :, 8:] - phase[:, number, :, :-8]).mean(axis=(1, 2)) for number in (0, 1)]
    product = slopes[0] * slopes[1] / (slopes[0].std() * slopes[1].std())
    assert abs(product.mean()) < 5 / np.sqrt(600)


def test_each_layer_has_its_own_wind():
    layers = [WindLayer(0.7, 8.0, 0.0), WindLayer(0.3, 20.0, 90.0)]
    flow = FrozenFlow.build(screens_of(), layers, jax.random.key(7))
    slow, fast = ((np.asarray(layer.opd_m(0.0)), np.asarray(layer.opd_m(0.125))) for layer in flow.layers)
    np.testing.assert_allclose(slow[1][:, 4:], slow[0][:, :-4], atol=1e-10 * slow[0].std())
    np.testing.assert_allclose(fast[1][10:], fast[0][:-10], atol=1e-10 * fast[0].std())


# ------------------------------------------------------------------------------- how long, and how often


@pytest.mark.parametrize("direction_deg", [0, 90, 180, 45, 60, -101, 153, 12])
def test_no_air_is_seen_twice_before_it_is_said(direction_deg):
    wind = WindLayer(1.0, 10.0, float(direction_deg))
    longest_s = unrepeated_s([wind], **GRID)
    turn = math.radians(direction_deg)
    reach = np.array(SHAPE) + 31  # 32 taps
    # By brute force: the first moment, after it has left its place, when the window meets the first one again.
    times = np.arange(0, 1.02 * longest_s, 0.02)
    way = np.abs(times[:, None] * 10.0 / PIXEL_M * np.array([math.sin(turn), math.cos(turn)]))
    whole = np.round(way / PERIOD)
    meets = (np.abs(way - whole * PERIOD) < reach).all(axis=1) & whole.any(axis=1)
    # Steps of 0.02 s are 0.8 of a pixel.
    np.testing.assert_allclose(times[meets.argmax()], longest_s, atol=0.021)
    assert meets.any()


def test_a_run_that_is_too_long_is_refused_and_calm_air_never_ends():
    screens, wind = screens_of(), WindLayer(1.0, 10.0, 0.0)
    longest_s = (PERIOD - SHAPE[1] - 31) * PIXEL_M / 10.0
    np.testing.assert_allclose(unrepeated_s([wind], **GRID), longest_s, rtol=1e-12)
    FrozenFlow.build(screens, [wind], jax.random.key(0), duration_s=0.999 * longest_s)
    with pytest.raises(SettingsError, match=r"^duration_s: must be at most 3.85 s, .* got 3.9 s$"):
        FrozenFlow.build(screens, [wind], jax.random.key(0), duration_s=3.9)
    with pytest.raises(SettingsError, match="layers: must be at least one"):
        FrozenFlow.build(screens, [], jax.random.key(0))
    assert unrepeated_s([WindLayer(1.0, 0.0, 0.0)], **GRID) == math.inf
    assert unrepeated_s([WindLayer(0.5, 0.0, 0.0), wind], **GRID) == unrepeated_s([wind], **GRID)


def test_the_same_key_gives_the_same_air_however_long_it_is_watched():
    screens = screens_of()
    short = FrozenFlow.build(screens, [SKEW], jax.random.key(3), duration_s=0.1)
    long = FrozenFlow.build(screens, [SKEW], jax.random.key(3), duration_s=3.0)
    other = FrozenFlow.build(screens, [SKEW], jax.random.key(4))
    one, again, unrelated = (np.asarray(flow.opd_m(0.05)) for flow in (short, long, other))
    np.testing.assert_array_equal(one, again)
    assert np.abs(unrelated - one).max() > 0.5 * one.std()
    compiled = np.asarray(eqx.filter_jit(lambda flow, time_s: flow.opd_m(time_s))(short, jnp.asarray(0.05)))
    np.testing.assert_allclose(compiled, one, atol=1e-12 * one.std())


def test_single_precision_is_good_to_a_hundredth_of_a_nanometre():
    # Long waves are a metre high: what matters is that only their slopes are computed.
    screens = screens_of(Turbulence(0.16, WAVELENGTH_M), dtype="float32")
    flow = FrozenFlow.build(screens, [WindLayer(1.0, 10.0, 0.0)], jax.random.key(8))
    before, after = np.asarray(flow.opd_m(1.0)), np.asarray(flow.opd_m(1.25))  # ten pixels
    assert before.std() > 500e-9
    np.testing.assert_allclose(after[:, 10:], before[:, :-10], atol=1e-11)
