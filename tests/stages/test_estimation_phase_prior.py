"""What is expected of a phase: Kolmogorov, von Karman, a closed loop, the frame before; against other sources."""

import math
from itertools import pairwise

import aotools
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.integrate import quad
from scipy.special import j0

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.errors import SettingsError
from nlcwfs.estimation import frame_prediction as prediction
from nlcwfs.estimation import phase_prior as prior
from nlcwfs.estimation.prior_settings import PriorSettings

WAVELENGTH_M = 0.65e-6
DIAMETER_M = 8.0
AIR = Turbulence(fried_m=0.3, wavelength_m=WAVELENGTH_M)
GRID = Grid((30, 37), 0.25)  # even and odd


def whole(grid: Grid, air: Turbulence) -> np.ndarray:
    light = {"wavelength_m": WAVELENGTH_M, "diameter_m": DIAMETER_M, "lit_pixels": 1.0}
    return prior.prior_power(grid, PriorSettings(), air, **light)


def full_plane(half: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """All waves of a real transform, from those that `rfft2` keeps."""
    rows, columns = np.indices(shape)
    mirrored = columns >= half.shape[1]
    return half[np.where(mirrored, -rows, rows) % shape[0], np.where(mirrored, -columns, columns) % shape[1]]


def frequencies(grid: Grid) -> np.ndarray:
    return np.hypot(np.fft.fftfreq(grid.shape[0], grid.pixel_m)[:, None], np.fft.fftfreq(grid.shape[1], grid.pixel_m))


# ------------------------------------------------------------------------------------------- the air alone


def test_the_outer_scale_is_von_karmans_as_another_package_has_it():
    """The Fourier sum of the power is the covariance of `aotools`, which has it in closed form (Assemat 2006)."""
    grid, outer_scale_m = Grid((512, 512), 0.25), 10.0
    air = prior.expected_air(PriorSettings(fried_m=0.2, outer_scale_m=outer_scale_m), seeing_arcsec=9.0, diameter_m=8.0)
    covariance = np.fft.irfft2(whole(grid, air), s=grid.shape)[0]
    apart_m = np.array([8, 20, 40, 80, 160])
    expected = aotools.phase_covariance(apart_m * grid.pixel_m, air.fried_at(WAVELENGTH_M), outer_scale_m)
    # 1.5 % of the variance: Noll's 0.0229 has three digits, and the window's first wave stands for all longer ones.
    np.testing.assert_allclose(covariance[apart_m], expected, atol=0.015 * expected[0])
    assert expected[0] > 5 * expected[-1]


def variance_in_telescope(pixels: int) -> tuple[float, float]:
    """Variance of tilt (one axis) and of all but piston and tilt, in units of (D / r0)^(5/3)."""
    grid = Grid((pixels, pixels), DIAMETER_M / 45)
    axis_m = (np.arange(pixels) - (pixels - 1) / 2) * grid.pixel_m
    lit = (axis_m[:, None] ** 2 + axis_m**2 < (DIAMETER_M / 2) ** 2) * 1.0
    weight = lit / lit.sum()
    tilt = np.broadcast_to(axis_m, lit.shape) / np.sqrt(np.sum(weight * axis_m**2))
    power = full_plane(whole(grid, AIR), grid.shape)
    total = power.mean() - np.mean(power * abs(np.fft.fft2(weight)) ** 2)
    tilt = np.mean(power * abs(np.fft.fft2(weight * tilt)) ** 2)
    strength = (DIAMETER_M / AIR.fried_m) ** (5 / 3)
    return tilt / strength, (total - 2 * tilt) / strength


@pytest.mark.parametrize(("pixels", "tilt_share", "rest_share"), [(64, 0.12, 0.92), (128, 0.28, 0.98), (512, 0.54, 1)])
def test_all_but_tilt_is_that_of_noll_and_the_tilt_is_short_by_what_is_stated(pixels, tilt_share, rest_share):
    tilt, rest = variance_in_telescope(pixels)
    assert tilt / 0.448 == pytest.approx(tilt_share, abs=0.01)  # Noll 1976, Table IV: 1.0299, 0.582, 0.134
    assert rest / 0.134 == pytest.approx(rest_share, abs=0.01)


def test_the_seeing_and_frieds_parameter_are_two_names_of_one_thing():
    by_seeing = prior.expected_air(PriorSettings(), seeing_arcsec=0.7, diameter_m=8.0)
    fried_m = 0.976 * 0.5e-6 / (0.7 * math.pi / 180 / 3600)
    by_fried = prior.expected_air(PriorSettings(fried_m=fried_m), seeing_arcsec=0.3, diameter_m=8.0)
    assert by_seeing.fried_m == pytest.approx(fried_m, rel=1e-12)
    assert by_fried == Turbulence(fried_m)


# ------------------------------------------------------------------------------------------ the closed loop


@pytest.mark.parametrize("angle", [1e-3, 9e-3, 1.1e-2, 0.3, 2.0, 9.0])
def test_a_delay_leaves_the_mean_over_the_winds_directions(angle):
    expected = quad(lambda theta: 4 * np.sin(angle * np.cos(theta) / 2) ** 2, 0, math.pi, epsabs=0)[0] / math.pi
    found = prior.lag_share(np.array([angle / (2 * math.pi)]), wind_m_per_s=4.0, lag_s=0.25)
    np.testing.assert_allclose(found, expected, rtol=1e-8)  # 1 - J0 of 0.01 has twelve digits


def test_all_that_a_delay_leaves_is_the_servo_lag_of_frozen_flow():
    r"""28.4 (tau f_G)^(5/3), f_G = 0.427 v / r0 for one layer (Greenwood 1977; Fried 1990); also D(v tau)."""
    wind_m_per_s, lag_s = 12.0, 0.003

    def density(log_frequency: float) -> float:
        frequency = math.exp(log_frequency)
        left = prior.lag_share(np.array([frequency]), wind_m_per_s=wind_m_per_s, lag_s=lag_s)[0]
        spectrum = 0.0229 * AIR.fried_m ** (-5 / 3) * frequency ** (-11 / 3)
        return float(left * spectrum * 2 * math.pi * frequency**2)

    waves = [math.log(frequency) for frequency in (1e-12, 1e-3, 1, 3, 10, 30, 100, 1000)]
    found = sum(quad(density, a, b, limit=500)[0] for a, b in pairwise(waves))
    closed = 28.4 * (lag_s * 0.427 * wind_m_per_s / AIR.fried_m) ** (5 / 3)
    assert found == pytest.approx(closed, rel=0.005)  # constants of three digits
    loop = prior.ClosedLoop(cutoff_per_m=1e3, lag_s=lag_s, wind_m_per_s=wind_m_per_s)
    grid = Grid((1024, 1024), 0.02)
    on_grid = full_plane(prior.closed_loop_power(grid, AIR, loop, wavelength_m=WAVELENGTH_M), grid.shape).mean()
    level = 0.0229 * AIR.fried_m ** (-5 / 3) * 2 * math.pi
    finer = 2 * level * 0.6 * 25 ** (-5 / 3)  # waves beyond 25 cycles per metre, all forgotten
    longest = 1 / (20.48 * math.sqrt(math.pi))  # a disc as large as the cell of piston
    longer = level * (2 * math.pi * wind_m_per_s * lag_s) ** 2 / 2 * 3 * longest ** (1 / 3)
    assert on_grid + finer + longer == pytest.approx(closed, rel=0.02)  # what the corners hold counts twice
    assert longer < 0.2 * closed


def test_below_the_cutoff_are_lag_and_noise_and_beyond_it_the_air():
    wind_m_per_s, lag_s, photons = 9.0, 0.004, 500.0
    told = {"cutoff_cpa": 7.0, "lag_s": lag_s, "wind_speed_m_per_s": wind_m_per_s, "beyond_share": 0.6}
    told |= {"photons": photons, "sensor_loss": 2.5}
    light = {"wavelength_m": WAVELENGTH_M, "diameter_m": DIAMETER_M, "lit_pixels": 321.0}
    found = full_plane(prior.prior_power(GRID, PriorSettings(**told), AIR, **light), GRID.shape)
    frequency = frequencies(GRID)
    open_loop = 0.0229 * AIR.fried_m ** (-5 / 3) * np.maximum(frequency, 1e-9) ** (-11 / 3) / GRID.pixel_m**2
    lag = open_loop * 2 * (1 - j0(2 * np.pi * frequency * wind_m_per_s * lag_s))
    expected = np.where(frequency * DIAMETER_M <= 7.0, lag + 2.5 * 321 / (4 * photons), 0.6 * open_loop)
    seen = frequency > 0
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-9)
    assert np.isfinite(found[0, 0])
    assert 0.1 < np.mean(frequency * DIAMETER_M <= 7.0) < 0.9


def test_the_noise_of_a_mode_is_that_of_the_quantum_limit_times_the_loss():
    """White noise of this power on a pupil that is partly shaded, projected on modes of unit rms over its pixels."""
    rng = np.random.default_rng(3)
    lit = rng.uniform(size=GRID.shape) > 0.4
    power = prior.noise_power(800.0, sensor_loss=2.2, lit_pixels=float(lit.sum()))
    modes = rng.normal(size=(40, lit.sum()))
    modes /= np.sqrt(np.mean(modes**2, axis=1))[:, None]
    noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(4000, *GRID.shape))) * math.sqrt(power), s=GRID.shape)
    coefficients = noise[:, lit] @ modes.T / lit.sum()
    # 160 000 coefficients, of which 4000 by 40 are nearly independent: 5 sigma are 1.8 %.
    assert np.mean(coefficients**2) == pytest.approx(2.2 / (4 * 800), rel=0.02)


# ---------------------------------------------------------------------------------------------- bad values


@pytest.mark.parametrize(
    ("told", "seeing_arcsec", "message"),
    [
        (
            {"outer_scale_m": 2.0},
            0.6,
            "estimation.prior.outer_scale_m: must be at least the telescope's diameter (8 m), got 2",
        ),
        ({}, 0.0, "estimation.seeing_arcsec: must be a positive angle, got 0.0"),
        ({}, math.nan, "estimation.seeing_arcsec: must be a positive angle, got nan"),
        ({"fried_m": -0.1}, 0.6, "estimation.prior.fried_m: must be a positive length, got -0.1"),
    ],
)
def test_air_that_cannot_be_is_refused_in_one_sentence(told, seeing_arcsec, message):
    with pytest.raises(SettingsError) as caught:
        prior.expected_air(PriorSettings.model_construct(**told), seeing_arcsec=seeing_arcsec, diameter_m=8.0)
    assert str(caught.value) == message
    prior.expected_air(PriorSettings(outer_scale_m=8.0), seeing_arcsec=0.6, diameter_m=8.0)  # the least that may be


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"cutoff_per_m": 0.0}, "estimation.prior.cutoff_cpa: must be positive, got 0.0"),
        ({"cutoff_per_m": math.nan}, "estimation.prior.cutoff_cpa: must be positive, got nan"),
        ({"lag_s": -1e-3}, "estimation.prior.lag_s: must not be negative, got -0.001"),
        ({"wind_m_per_s": -1.0}, "estimation.prior.wind_speed_m_per_s: must not be negative, got -1.0"),
    ],
)
def test_a_loop_that_cannot_be_is_refused_in_one_sentence(told, message):
    with pytest.raises(SettingsError) as caught:
        prior.ClosedLoop(**({"cutoff_per_m": 2.0, "lag_s": 0.0, "wind_m_per_s": 0.0} | told))
    assert str(caught.value) == message


def test_noise_without_photons_or_below_the_quantum_limit_is_refused():
    with pytest.raises(SettingsError, match=r"estimation\.prior\.photons: must be positive, got 0"):
        prior.noise_power(0.0, sensor_loss=2.0, lit_pixels=10.0)
    with pytest.raises(SettingsError, match=r"estimation\.prior\.sensor_loss: must be at least 1.*, got 0\.9"):
        prior.noise_power(10.0, sensor_loss=0.9, lit_pixels=10.0)


@pytest.mark.parametrize("key", ["fried_m", "outer_scale_m", "cutoff_cpa", "lag_s", "wind_speed_m_per_s", "photons"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_settings_refuse_what_has_no_meaning(key, value):
    with pytest.raises(ValidationError, match=key):
        PriorSettings.model_validate({key: value})


# ------------------------------------------------------------------------------------------ the frame before


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), log_information=st.floats(-4, 4))
def test_the_settled_power_is_where_predictions_of_numpy_end(seed, log_information):
    rng = np.random.default_rng(seed)
    power, again = 10 ** rng.uniform(-3, 3, (3, 4)), rng.uniform(0, 0.97, (3, 4))
    information = 10 ** (log_information + rng.uniform(-1, 1, (3, 4)))
    information[0, 0], again[0, 1] = 0, 0
    expected = power.copy()
    for _ in range(800):  # the slowest forgets by 0.97^2 a frame
        expected = again**2 / (1 / expected + information) + (1 - again**2) * power
    found = prediction.settled_power(jnp.asarray(power), jnp.asarray(again), jnp.asarray(information))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_never_changes_settles_at_nothing_and_stays_unknown_without_light():
    always, power = jnp.ones((2, 3)), jnp.full((2, 3), 2.0)
    np.testing.assert_array_equal(prediction.settled_power(power, always, 3.0), 0)
    np.testing.assert_array_equal(prediction.settled_power(power, always, 0.0), 2)


@pytest.mark.parametrize("shape", [(8, 10), (9, 7), (6, 11)])
def test_a_known_wind_moves_the_phase_towards_where_it_blows(shape):
    grid, rng = Grid(shape, 0.5), np.random.default_rng(5)
    phase = rng.normal(size=shape)
    moved = [(0.75, 1.0, -0.5), (0.25, -1.5, 2.0)]  # in 1 s, whole pixels
    found, _ = prediction.predicted_mean_and_power(
        jnp.asarray(phase), *[jnp.ones((shape[0], shape[1] // 2 + 1))] * 2, carriage(grid, moved, 1.0)
    )
    expected = 0.75 * np.roll(phase, (2, -1), (0, 1)) + 0.25 * np.roll(phase, (-3, 4), (0, 1))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def carriage(grid: Grid, layers, interval_s: float):
    return jnp.asarray(prediction.wind_carriage(grid, layers, interval_s=interval_s))


def test_between_pixels_waves_are_moved_as_waves():
    grid, (fy, fx) = Grid((9, 12), 0.5), (2 / 4.5, -3 / 6.0)
    y_m, x_m = (np.arange(9) - 4)[:, None] * 0.5, (np.arange(12) - 5.5) * 0.5
    layer = (1.0, 3.0, -5.0)

    def wave(time_s: float) -> np.ndarray:
        return np.cos(2 * np.pi * (fy * (y_m - 3.0 * time_s) + fx * (x_m + 5.0 * time_s)) + 0.4)

    found, _ = prediction.predicted_mean_and_power(
        jnp.asarray(wave(0.0)), *[jnp.ones((9, 7))] * 2, carriage(grid, [layer], 0.037)
    )
    np.testing.assert_allclose(found, wave(0.037), atol=1e-12)


def test_the_finest_wave_keeps_what_the_grid_can_show_of_it():
    """Half a cycle per pixel along y, moved by a part of a pixel: a cosine; along x another wave is moved as ever."""
    grid, (down_m, left_m) = Grid((6, 9), 0.5), (0.11, 0.17)
    turn = 2 * np.pi * 2 / 4.5 * (np.arange(9)[None, :] * 0.5 + left_m)
    finest = (-1.0) ** np.arange(6)[:, None]
    found, _ = prediction.predicted_mean_and_power(
        jnp.asarray(finest * np.cos(turn - 2 * np.pi * 2 / 4.5 * left_m)),
        *[jnp.ones((6, 5))] * 2,
        carriage(grid, [(1.0, down_m, -left_m)], 1.0),
    )
    np.testing.assert_allclose(found, math.cos(math.pi * down_m / 0.5) * finest * np.cos(turn), atol=1e-12)


def frozen_flow(rng, velocities: np.ndarray, shares: np.ndarray, interval_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Two moments of layers that move on the periodic grid, NumPy phase ramps: `velocities[draw layer axis]`."""
    amplitude = np.sqrt(whole(GRID, AIR))
    fy = np.fft.fftfreq(GRID.shape[0], GRID.pixel_m)[:, None]
    fx = np.fft.rfftfreq(GRID.shape[1], GRID.pixel_m)
    first, second = np.zeros((2, len(velocities), *GRID.shape))
    for layer, share in enumerate(shares):
        air = np.fft.rfft2(rng.normal(size=first.shape)) * amplitude * math.sqrt(share)
        moved = velocities[:, layer, :, None, None] * interval_s
        first += np.fft.irfft2(air, s=GRID.shape)
        second += np.fft.irfft2(air * np.exp(-2j * np.pi * (fy * moved[:, 0] + fx * moved[:, 1])), s=GRID.shape)
    return first, second


def innovation(first, second, correlation) -> tuple[np.ndarray, np.ndarray]:
    """Mean power of what the prediction misses, and what the prediction says of it."""
    power = jnp.asarray(whole(GRID, AIR))
    missed, told = 0.0, None
    for before, after in zip(first, second, strict=True):
        mean, told = prediction.predicted_mean_and_power(jnp.asarray(before), 0 * power, power, correlation)
        missed = missed + abs(np.fft.rfft2(after - np.asarray(mean))) ** 2
    return missed / len(first) / np.prod(GRID.shape), np.asarray(told)


def in_rings(power: np.ndarray) -> np.ndarray:
    """Means over rings of waves, each held up against the air; the row of half a cycle per pixel is left out."""
    frequency = frequencies(GRID)[:, : power.shape[1]].copy()
    frequency[[0, GRID.shape[0] // 2], :] = np.inf  # fx = 0 too: its waves are stored twice
    share = power / whole(GRID, AIR)
    edges = [0.1, 0.3, 0.6, 1.0, 1.4, 1.9]
    return np.array([share[(frequency >= a) & (frequency < b)].mean() for a, b in pairwise(edges)])


@pytest.mark.parametrize("interval_s", [0.004, 0.02])
def test_the_innovation_of_frozen_flow_is_that_of_a_wind_of_unknown_direction(interval_s):
    rng, draws, wind_m_per_s = np.random.default_rng(7), 400, 10.0
    angle = rng.uniform(0, 2 * np.pi, (draws, 2))
    velocities = wind_m_per_s * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    first, second = frozen_flow(rng, velocities, np.array([0.7, 0.3]), interval_s)
    again = prediction.wind_correlation(GRID, wind_m_per_s=wind_m_per_s, interval_s=interval_s)
    missed, told = (in_rings(each) for each in innovation(first, second, jnp.asarray(again)))
    # Rings of 15 waves and more; the direction, drawn once for all waves, scatters the mean by at most 6 % (1 sigma).
    kept = in_rings(again**2 * whole(GRID, AIR)) > 0.01  # J0 that was cut at zero tells less than could be told
    np.testing.assert_allclose(missed[kept], told[kept], rtol=0.15)
    assert kept.sum() >= 3
    assert np.all(told <= 1)


def test_the_innovation_of_known_layers_is_what_their_smear_leaves():
    rng, draws = np.random.default_rng(8), 300
    layers = [(0.6, 3.0, -8.0), (0.4, -11.0, 2.0)]
    velocities = np.broadcast_to(np.array([layer[1:] for layer in layers]), (draws, 2, 2))
    first, second = frozen_flow(rng, velocities, np.array([0.6, 0.4]), 0.02)
    missed, told = (in_rings(each) for each in innovation(first, second, carriage(GRID, layers, 0.02)))
    np.testing.assert_allclose(missed, told, rtol=0.1)  # 300 draws of 15 waves and more: 1 sigma is 1.5 %
    assert told[0] < 0.5 < told[-1]


def test_one_layer_of_known_wind_leaves_nothing_new_on_a_periodic_grid():
    power = jnp.asarray(whole(GRID, AIR))
    _, told = prediction.predicted_mean_and_power(
        jnp.ones(GRID.shape), 0.3 * power, power, carriage(GRID, [(1.0, 4.0, -7.0)], 0.003)
    )
    rows = np.arange(GRID.shape[0]) != GRID.shape[0] // 2
    np.testing.assert_allclose(np.asarray(told)[rows], 0.3 * np.asarray(power)[rows], rtol=1e-9)


def test_the_filter_knows_its_error_while_it_follows_a_phase():
    """A phase that forgets as it is told to, seen through white noise by NumPy."""
    rng, noise, frames = np.random.default_rng(9), 0.5, 250
    power = jnp.asarray(whole(GRID, AIR))
    again = prediction.wind_correlation(GRID, wind_m_per_s=10.0, interval_s=0.004)
    truth = np.fft.irfft2(np.fft.rfft2(rng.normal(size=GRID.shape)) * np.sqrt(power), s=GRID.shape)
    mean, open_power = jnp.zeros(GRID.shape), power
    errors = np.zeros(power.shape)
    for frame in range(frames):
        new = np.fft.rfft2(rng.normal(size=GRID.shape)) * np.sqrt((1 - again**2) * np.asarray(power))
        truth = np.fft.irfft2(np.fft.rfft2(truth) * again + new, s=GRID.shape)
        left = prediction.posterior_power(open_power, 1 / noise)
        seen = truth + math.sqrt(noise) * rng.normal(size=GRID.shape)
        gain = np.asarray(left) / noise
        estimate = mean + np.fft.irfft2(np.fft.rfft2(seen - mean) * gain, s=GRID.shape)
        if frame >= 50:
            errors += abs(np.fft.rfft2(truth - estimate)) ** 2 / np.prod(GRID.shape) / (frames - 50)
        mean, open_power = prediction.predicted_mean_and_power(estimate, left, power, jnp.asarray(again))
    np.testing.assert_allclose(in_rings(errors), in_rings(np.asarray(left)), rtol=0.1)  # slow waves: 5 sigma
    settled = prediction.settled_power(power, jnp.asarray(again), 1 / noise)
    np.testing.assert_allclose(open_power[:, 1:], settled[:, 1:], rtol=1e-3)  # the slowest waves still settle
    assert in_rings(np.asarray(left))[0] < 0.1 * noise / in_rings(np.asarray(power))[0]


def errors_over_told(correlation: np.ndarray, *, noise: float, interval_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Three frozen layers followed by a settled filter, wave by wave in NumPy: errors over those told and over none."""
    rng, power = np.random.default_rng(11), whole(GRID, AIR)
    fy = np.fft.fftfreq(GRID.shape[0], GRID.pixel_m)[:, None]
    fx = np.fft.rfftfreq(GRID.shape[1], GRID.pixel_m)
    settled = prediction.settled_power(jnp.asarray(power), jnp.asarray(correlation), 1 / noise)
    left = np.asarray(prediction.posterior_power(settled, 1 / noise))
    size, errors = math.sqrt(np.prod(GRID.shape)), np.zeros(power.shape)
    for _ in range(4):
        angle = rng.uniform(0, 2 * np.pi, 3)
        air = [np.fft.rfft2(rng.normal(size=GRID.shape)) * np.sqrt(power * share) for share in (0.5, 0.3, 0.2)]
        turn = [
            np.exp(-2j * np.pi * interval_s * speed * (fy * np.sin(each) + fx * np.cos(each)))
            for speed, each in zip((7.0, 10.0, 15.0), angle, strict=True)
        ]
        estimate = np.zeros(power.shape)
        for frame in range(160):
            air = [layer * one for layer, one in zip(air, turn, strict=True)]
            seen = sum(air) + np.fft.rfft2(rng.normal(size=GRID.shape)) * math.sqrt(noise)
            before = correlation * estimate
            estimate = before + left / noise * (seen - before)
            if frame >= 80:
                errors += abs(estimate - sum(air)) ** 2 / size**2 / 320
    without = in_rings(power / (1 + power / noise))
    return np.sqrt(in_rings(errors) / in_rings(left)), np.sqrt(in_rings(errors) / without)


def test_a_stream_is_followed_by_a_filter_that_knows_how_long_the_wind_lets_it_remember():
    noise, wind = 0.2, {"wind_m_per_s": 10.0, "interval_s": 1e-3}
    once = prediction.wind_correlation(GRID, **wind)
    lasting = prediction.lasting_correlation(GRID, whole(GRID, AIR), information=1 / noise, **wind)
    assert np.all((lasting <= once + 1e-12) & (lasting > 0))
    told, gained = errors_over_told(lasting, noise=noise, interval_s=1e-3)
    np.testing.assert_allclose(told, 0.95, atol=0.1)  # rings of few waves scatter by 5 %
    naive_told, naive_gained = errors_over_told(once, noise=noise, interval_s=1e-3)
    assert np.all(naive_told[1:] > 1.4)  # a filter that takes each frame's news for unrelated to the last one's
    assert np.all(gained[1:] < 0.8 * naive_gained[1:])


def test_the_lasting_correlation_is_that_over_the_memory_of_its_own_filter():
    noise, power = 0.2, whole(GRID, AIR)
    lasting = prediction.lasting_correlation(GRID, power, information=1 / noise, wind_m_per_s=10.0, interval_s=1e-3)
    settled = power.copy()
    for _ in range(5000):  # Riccati's equation of NumPy
        settled = lasting**2 / (1 / settled + 1 / noise) + (1 - lasting**2) * power
    remembered = 2 * (settled + noise) / settled
    angle = 2 * np.pi * frequencies(GRID)[:, : power.shape[1]] * 10.0 * 1e-3
    expected = j0(angle * remembered) ** (1 / remembered)
    seen = (angle > 0) & (angle * remembered < 2.2)
    assert seen.mean() > 0.5
    np.testing.assert_allclose(1 - lasting[seen], 1 - expected[seen], rtol=1e-4)  # the iterations of both


def test_what_turns_too_fast_is_not_remembered_and_what_stands_still_is_kept():
    power = whole(GRID, AIR)
    gale = prediction.lasting_correlation(GRID, power, information=5.0, wind_m_per_s=400.0, interval_s=0.01)
    assert np.all(gale[frequencies(GRID)[:, : power.shape[1]] > 0.2] < 0.5)
    calm = prediction.lasting_correlation(GRID, power, information=5.0, wind_m_per_s=0.0, interval_s=0.01)
    np.testing.assert_array_equal(calm, 1)


@pytest.mark.parametrize("moved", [0.0, 0.05, 0.4, 0.99, 1.5])
def test_unseen_air_is_the_part_of_a_disc_outside_of_its_shifted_self(moved):
    axis = (np.arange(1000) - 499.5) / 1000
    y, x = axis[:, None], axis
    inside, before = y**2 + x**2 < 0.25, y**2 + (x - moved) ** 2 < 0.25
    expected = 1 - (inside & before).sum() / inside.sum()
    found = prediction.unseen_share(diameter_m=2.0, wind_m_per_s=40.0, interval_s=moved / 20)
    assert found == pytest.approx(expected, abs=3e-3)  # pixels of the rim
