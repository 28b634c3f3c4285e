"""Is a right wavefront believed, and a wrong one not? The share of the speckles that is left unexplained."""

import itertools

import defocused_light
import jax.numpy as jnp
import numpy as np
import pytest
from defocused_light import DIAMETER_M, PIXEL_M, disc, images

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.fit_quality import BELIEVED, FINEST, _whole_plane, speckle_band, unexplained_share, verdict
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.resolution_level import Measurement

WINDOW = (64, 70)  # not square, so that a swap of the axes fails
GRID = Grid(WINDOW, PIXEL_M)
OVER_FRIED = 8.2
DRAWS = 12


def turbulent_opd_m(seed: int) -> np.ndarray:
    """Kolmogorov on a periodic window four times wider; long waves are missing, speckles are all there."""
    rng, (rows, columns) = np.random.default_rng(seed), WINDOW
    shape = (4 * rows, 4 * columns)
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(n, PIXEL_M) for n in shape], indexing="ij"))
    frequency[0, 0] = np.inf
    power = 0.0229 * (DIAMETER_M / OVER_FRIED) ** (-5 / 3) * frequency ** (-11 / 3) / PIXEL_M**2  # Noll 1976, eq. 21
    phase_rad = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * np.sqrt(power)).real
    return phase_rad[:rows, :columns] * defocused_light.WAVELENGTH_M / (2 * np.pi)


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    """Two wavefronts of the same turbulence: shares of the photons, (wavefront, plane, y, x)."""
    pupil = disc(WINDOW, PIXEL_M)
    return np.array([images(pupil, turbulent_opd_m(seed), pixel_m=PIXEL_M) for seed in (1, 2)])


def share(counts, model, *, usable=True, read_variance=0.0, grid=GRID) -> float:
    usable = np.broadcast_to(usable, counts.shape)
    measured = Measurement(jnp.asarray(counts), jnp.asarray(usable), jnp.asarray(read_variance))
    band = jnp.asarray(speckle_band(grid, diameter_m=DIAMETER_M))
    return float(unexplained_share(measured, jnp.asarray(model), band))


def drawn(mean, seed: int, *, read_noise: float = 0.0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.poisson(mean) + rng.normal(0, 1, mean.shape) * read_noise for _ in range(DRAWS)]


def without_noise(seen, model) -> float:
    """The same share of noiseless images, in NumPy: over the whole plane of frequencies, mean over the planes."""
    squared = np.fft.fftfreq(WINDOW[0], PIXEL_M)[:, None] ** 2 + np.fft.fftfreq(WINDOW[1], PIXEL_M) ** 2
    narrow, wide = (np.exp(-2 * (np.pi * width * FINEST * DIAMETER_M) ** 2 * squared) for width in (1, 3))
    left, all_ = (
        np.sum(abs(np.fft.fft2(each)) ** 2 * (narrow - wide) ** 2, axis=(1, 2)) for each in (seen - model, seen)
    )
    return float(np.mean(left / all_))


# ------------------------------------------------------------------------------------- right and wrong

NOISES = [(0.5, 0.0), (0.5, 1.0), (5.0, 3.0), (100.0, 0.0)]  # photons a pixel, electrons


@pytest.mark.parametrize(("per_pixel", "read_noise"), NOISES)
def test_the_truth_leaves_nothing_unexplained(light, per_pixel, read_noise):
    """Half a photon a pixel and as much read noise as signal included: negative pixels are noise, too."""
    model = per_pixel * light[0] * light[0].size
    shares = [share(one, model, read_variance=read_noise**2) for one in drawn(model, 3, read_noise=read_noise)]
    assert abs(np.mean(shares)) < 5 * np.std(shares) / np.sqrt(DRAWS)
    assert np.std(shares) < 0.03  # else five sigma would hide a noise that is wrong by as much
    assert np.max(shares) < BELIEVED["low-pass"]


@pytest.mark.parametrize(("per_pixel", "read_noise"), NOISES)
def test_another_wavefront_of_the_same_air_leaves_more_than_all(light, per_pixel, read_noise):
    """Unrelated speckles leave their own variance and that of the model: about 2, as without noise."""
    model = per_pixel * light * light[0].size
    shares = [share(one, model[1], read_variance=read_noise**2) for one in drawn(model[0], 4, read_noise=read_noise)]
    expected = without_noise(*light)
    assert 1.5 < expected < 3
    # A ratio of two noisy numbers is biased by their relative variance.
    spread = np.std(shares) / np.sqrt(DRAWS)
    assert np.mean(shares) == pytest.approx(expected, abs=5 * spread + 2 * np.var(shares))
    assert np.min(shares) > 0.5


def test_a_wavefront_half_way_leaves_a_share_in_between(light):
    model = 50 * light * light[0].size
    mixed = 0.7 * model[0] + 0.3 * model[1]
    shares = [share(one, mixed) for one in drawn(model[0], 5)]
    assert np.mean(shares) == pytest.approx(without_noise(model[0], mixed), rel=0.03)
    assert np.mean(shares) == pytest.approx(0.09 * without_noise(*light), rel=0.03)
    assert np.min(shares) > max(BELIEVED.values())


@pytest.mark.parametrize("per_pixel", [0.5, 100.0])
def test_an_even_glow_has_nothing_to_believe(light, per_pixel):
    glow = np.full(light[0].shape, per_pixel)
    for one in drawn(glow, 6)[:4]:
        assert share(one, glow) == 1
        assert share(one, per_pixel * light[0] * light[0].size) == 1
    assert share(0 * glow, 0 * glow) == 1


# --------------------------------------------------------------------------------- waves of which all is known

SQUARE = Grid((48, 60), 0.2)


def wave(cycles: tuple[int, int], contrast: float) -> np.ndarray:
    """Many photons on one plane, with a ripple of whole cycles along y and x."""
    y, x = (np.arange(n) / n for n in SQUARE.shape)
    return 1e9 * (1 + contrast * np.sin(2 * np.pi * (cycles[0] * y[:, None] + cycles[1] * x) + 0.4))[None]


@pytest.mark.parametrize("missed", [0.0, 0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("cycles", [(6, 0), (3, -7)])
def test_a_ripple_that_is_missed_in_part_leaves_the_square_of_that_part(missed, cycles):
    found = share(wave(cycles, 0.2), wave(cycles, 0.2 * (1 - missed)), grid=SQUARE)
    assert found == pytest.approx(missed**2, abs=1e-5)  # photon noise that is not there is still taken off


def test_planes_count_alike_and_one_without_speckles_is_not_explained():
    ripple, flat = wave((6, 0), 0.2), wave((6, 0), 0.0)
    seen = np.concatenate([ripple, ripple, flat])
    model = np.concatenate([ripple, wave((6, 0), 0.1), flat])
    assert share(seen, model, grid=SQUARE) == pytest.approx((0 + 0.25 + 1) / 3, abs=1e-5)


@pytest.mark.parametrize(("cycles", "error"), [((0, 0), 0.3), ((1, 0), 0.2), ((24, 30), 0.2)])
def test_what_is_wider_or_finer_than_speckles_is_not_judged(cycles, error):
    """Brightness, a slope over the window, and the finest chequerboard."""
    ripple = wave((6, 0), 0.2)
    assert abs(share(ripple, ripple + wave(cycles, error) - wave((0, 0), 0.0), grid=SQUARE)) < 0.03


# ------------------------------------------------------------------------------------------ masked pixels


def test_masked_pixels_may_hold_anything(light):
    model, rng = 5 * light[0] * light[0].size, np.random.default_rng(8)
    usable = rng.uniform(size=model.shape) > 0.1
    counts = drawn(model, 9)[0].astype(float)
    wild = np.where(usable, counts, rng.choice([np.nan, np.inf, -1e9], counts.shape))
    assert share(wild, model, usable=usable) == share(counts, model, usable=usable)
    assert share(counts, np.where(usable, model, 1e6), usable=usable) == share(counts, model, usable=usable)


def test_the_truth_leaves_nothing_around_masked_pixels_either(light):
    model = 5 * light[0] * light[0].size
    usable = np.random.default_rng(10).uniform(size=model.shape) > 0.1
    usable[:, :, 40] = False
    shares = [share(one, model, usable=usable) for one in drawn(model, 11)]
    assert abs(np.mean(shares)) < 5 * np.std(shares) / np.sqrt(DRAWS)
    assert np.std(shares) < 0.01


# ---------------------------------------------------------------------------------------------- the verdict


def expected_outcome(explains: bool, lit: bool, rests: bool, finite: bool) -> Outcome:
    """The gravest thing that can be said."""
    if not finite:
        return Outcome.NOT_FINITE
    if not lit:
        return Outcome.NO_LIGHT
    if not explains:
        return Outcome.NOT_EXPLAINED
    return Outcome.CONVERGED if rests else Outcome.BUDGET_SPENT


@pytest.mark.parametrize(("explains", "lit", "rests", "finite"), itertools.product([True, False], repeat=4))
def test_the_gravest_finding_is_the_outcome(explains, lit, rests, finite):
    code = verdict(
        unexplained=jnp.asarray(0.03 if explains else 0.031),
        believed=0.03,
        plane_counts=jnp.asarray([5.0, 1e-9 if lit else 0.0, 7.0]),
        rests=jnp.asarray(rests),
        finite=jnp.asarray(finite),
    )
    assert Outcome(int(code)) is expected_outcome(explains, lit, rests, finite)


# ----------------------------------------------------------------------------------------------- Parseval


@pytest.mark.parametrize("shape", [(6, 8), (7, 8), (6, 9), (7, 9), (1, 5), (5, 1), (2, 2)])
def test_a_half_plane_makes_the_whole_of_numpy(shape):
    """The factor of any real kernel that is the same upside down and mirrored: real, and no other symmetry."""
    kernel = np.random.default_rng(12).normal(size=shape)
    kernel = kernel + np.roll(kernel[::-1, ::-1], (1, 1), axis=(0, 1))
    whole = np.fft.fft2(kernel)
    np.testing.assert_allclose(whole.imag, 0, atol=1e-13)
    found = _whole_plane(jnp.asarray(whole.real[:, : shape[1] // 2 + 1]), shape[1])
    np.testing.assert_allclose(found, whole.real, atol=1e-13)
