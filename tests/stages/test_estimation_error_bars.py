"""Error bars from a few products, against the whole posterior matrix of the same model."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.beam.zernike import zernike_fit
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.error_bars import ErrorBars, ModesInBands, error_bars, projected_sigma, quantum_sigma
from nlcwfs.estimation.photon_bound import fisher_information

WAVELENGTH_M = 0.65e-6
RADIAN_M = WAVELENGTH_M / (2 * np.pi)
DISTANCES_M = (-3.5e6, -2.5e6, 2.5e6, 3.5e6)
PHOTONS = 2e4
GRID = Grid((60, 66), 8.0 / 32)
COUNT = 600

# D / r0 of the turbulence, rms of the wavefront that is there if it is not the turbulence, read noise squared
CASES = {"speckles": (8.2, None, 0.0), "strong": (15.0, None, 2.0), "flat": (8.2, 0.1, 0.0)}


@functools.cache
def telescope() -> tuple[ModalBasis, CurvatureSensor]:
    pupil = np.asarray(PupilShape(8.0).on(GRID))
    colour = Spectrum.monochromatic(WAVELENGTH_M)
    optics = CurvatureSensor.build(pupil, GRID, distances_m=DISTANCES_M, spectrum=colour, dtype="float64")
    return modal_basis(pupil, GRID, diameter_m=8.0, count=COUNT), optics


def model(phase_rad):
    return telescope()[1].images(phase_rad * RADIAN_M, PHOTONS).photons


@functools.cache
def whole(case: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """A wavefront, the information about all modes, their turbulent variances, and (D / r0)^(5/3)."""
    over_fried, rms_rad, read_variance = CASES[case]
    basis, strength = telescope()[0], over_fried ** (5 / 3)
    prior = np.asarray(basis.kolmogorov_rad2) * strength
    coefficients = np.random.default_rng(1).normal(size=COUNT) * np.sqrt(prior)
    if rms_rad is not None:
        coefficients *= rms_rad / np.linalg.norm(coefficients)
    phase_rad = np.tensordot(coefficients, np.asarray(basis.modes), axes=1)
    found = fisher_information(model, jnp.asarray(phase_rad), jnp.asarray(basis.modes), read_variance=read_variance)
    return phase_rad, found, prior, strength


@eqx.filter_jit
def compiled(phase_rad, modes: ModesInBands, read_variance, strength, key) -> ErrorBars:
    mean, along = jax.linearize(lambda one: model(one.astype(float)).astype(one.dtype), phase_rad)
    return error_bars(along, mean + read_variance, modes, strength=strength, photons=PHOTONS, key=key)


@functools.cache
def found(case: str, *, seed: int = 0, dtype: str = "float64", **options) -> ErrorBars:
    phase_rad, _, _, strength = whole(case)
    modes = ModesInBands.build(telescope()[0], dtype=dtype, **options)
    numbers = (jnp.asarray(one, dtype) for one in (CASES[case][2], strength))
    return compiled(jnp.asarray(phase_rad, dtype), modes, *numbers, jax.random.key(seed))


def posterior(case: str) -> np.ndarray:
    _, information, prior, _ = whole(case)
    return np.linalg.inv(information + np.diag(1 / prior))


def beyond(case: str) -> float:
    basis = telescope()[0]
    return (basis.kolmogorov_total_rad2 - np.sum(basis.kolmogorov_rad2)) * whole(case)[3]


# Band and tolerance. Random signs scatter the errors of narrow bands by 1 to 2 %; the series leaves out 1 %.
# The slowest modes know no signs but those of their coupling to others: 0.3 %.
BANDS_CPA = {"slowest": (0, 2, 0.008), "2 to 4": (2, 4, 0.05), "middle": (4, 12, 0.02), "high": (12, 99, 0.02)}


@pytest.mark.parametrize("options", [{}, {"slow_below_cpa": 2.3, "probes": 3}], ids=["default", "other"])
@pytest.mark.parametrize("case", CASES)
def test_the_errors_in_bands_are_those_of_the_whole_matrix(case, options):
    cycles, exact = np.asarray(telescope()[0].cycles_per_aperture), np.diag(posterior(case))
    mode_rad2 = np.asarray(found(case, **options).mode_rad2)
    for low, high, tolerance in BANDS_CPA.values():
        here = (cycles >= low) & (cycles < high)
        assert here.sum() >= 10
        assert math.sqrt(mode_rad2[here].sum() / exact[here].sum()) == pytest.approx(1, abs=tolerance)
    total = math.sqrt(exact.sum() + beyond(case))
    assert found(case, **options).wavefront_rad == pytest.approx(total, rel=0.01)


@pytest.mark.parametrize(("case", "worst"), [("speckles", 0.2), ("strong", 0.2), ("flat", 0.4)])
def test_no_single_mode_is_told_far_too_well_or_too_badly_known(case, worst):
    """Within a band of flat light the information of modes differs by a factor two, and its mean is told."""
    share = np.sqrt(np.asarray(found(case).mode_rad2) / np.diag(posterior(case)))
    assert share.max() < 1 + worst
    assert share.min() > 1 - worst
    assert np.median(share) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("case", ["speckles", "flat"])
def test_modes_that_look_alike_take_from_each_other(case):
    """The diagonal alone, 1 / (F_kk + 1 / lambda_k), misses this: by a third on flat light."""
    exact, slow = posterior(case), found(case).slow_rad2.shape[0]
    _, information, prior, _ = whole(case)
    diagonal = 1 / (np.diag(information) + 1 / prior)
    assert np.sqrt(diagonal[:2].sum() / np.diag(exact)[:2].sum()) < (0.8 if case == "flat" else 0.97)
    scale = np.sqrt(np.diag(exact)[:slow])
    told = np.asarray(found(case).slow_rad2) / scale / scale[:, None]
    np.testing.assert_allclose(told, exact[:slow, :slow] / scale / scale[:, None], atol=0.05)


def test_the_variances_of_zernikes_are_those_of_the_whole_matrix():
    basis = telescope()[0]
    fit = zernike_fit(np.asarray(PupilShape(8.0).on(GRID)), GRID, diameter_m=8.0, count=28)
    matrix = np.einsum("zyx,kyx->zk", np.asarray(fit.matrix), np.asarray(basis.modes))[1:]
    for case in ("speckles", "flat"):
        expected = np.sqrt(np.einsum("zk,kl,zl->z", matrix, posterior(case), matrix))
        np.testing.assert_allclose(projected_sigma(found(case), jnp.asarray(matrix)), expected, rtol=0.2)
        mean = np.sqrt(np.mean(projected_sigma(found(case), jnp.asarray(matrix)) ** 2 / expected**2))
        assert mean == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize("case", CASES)
def test_the_distance_to_the_quantum_limit_is_told_in_bands(case):
    modes = ModesInBands.build(telescope()[0])
    _, information, prior, _ = whole(case)
    cycles = np.asarray(telescope()[0].cycles_per_aperture)
    for (low, high), loss in zip(modes.bands_cpa, np.asarray(found(case).sensor_loss), strict=True):
        here = (cycles >= low) & (cycles < high)
        exact = 4 * PHOTONS / np.diag(information)[here].mean()
        assert loss == pytest.approx(exact, rel=1e-6 if high <= 2 else 0.15)  # few modes: 5 % of scatter
    quantum = math.sqrt(np.sum(1 / (4 * PHOTONS + 1 / prior)) + beyond(case))
    assert found(case).quantum_rad == pytest.approx(quantum, rel=1e-9)
    assert found(case).quantum_rad < found(case).wavefront_rad
    assert quantum_sigma(PHOTONS) == pytest.approx(1 / math.sqrt(4 * PHOTONS))


def test_when_every_mode_is_slow_the_matrix_is_whole():
    """Eight modes, none at random: an inverse of NumPy, to rounding."""
    phase_rad, information, prior, strength = whole("flat")
    modes = ModesInBands.build(telescope()[0].first(8), dtype="float64")
    mean, along = jax.linearize(model, jnp.asarray(phase_rad))
    told = {"strength": strength, "photons": PHOTONS, "key": jax.random.key(0)}
    bars = error_bars(along, mean, modes, **told)
    expected = np.linalg.inv(information[:8, :8] + np.diag(1 / prior[:8]))
    np.testing.assert_allclose(bars.slow_rad2, expected, rtol=1e-6, atol=1e-8 * expected.max())


def test_other_signs_tell_the_same_and_equal_keys_the_very_same():
    first, second = found("strong", seed=1), found("strong", seed=2)
    assert float(first.wavefront_rad) == pytest.approx(float(second.wavefront_rad), rel=0.01)
    assert not np.array_equal(first.mode_rad2, second.mode_rad2)
    found.cache_clear()
    np.testing.assert_array_equal(first.mode_rad2, found("strong", seed=1).mode_rad2)


def test_single_precision_is_enough():
    single = found("flat", dtype="float32")
    assert single.mode_rad2.dtype == jnp.float32
    np.testing.assert_allclose(single.mode_rad2, found("flat").mode_rad2, rtol=2e-3)  # 1e-7 times the conditions


# ---------------------------------------------------------------------------------------------- closed forms


@functools.cache
def small_telescope() -> tuple[np.ndarray, ModesInBands]:
    """Amplitude of a pupil of no symmetry, and modes that are orthonormal on its light."""
    grid = Grid((18, 21), 0.5)
    pupil = np.array(PupilShape(7.5, obstruction_ratio=0.3).on(grid))
    pupil[:7, 13:] *= 0.5
    pupil[pupil < 0.2] = 0
    basis = modal_basis(pupil, grid, diameter_m=7.5, count=40)
    return pupil, ModesInBands.build(basis, dtype="float64")


def bars_of(responses, variance, strength: float) -> ErrorBars:
    """For counts that are each pixel's phase times its amplitude and a number, on each plane."""
    pupil, modes = small_telescope()

    def counts(phase_rad):
        return jnp.asarray(responses)[:, None, None] * (jnp.asarray(pupil) * phase_rad)[None]

    told = {"strength": strength, "photons": 10.0, "key": jax.random.key(3)}
    return error_bars(counts, jnp.asarray(variance), modes, **told)


@pytest.mark.parametrize("strength", [1e-3, 1.0, 1e4])
def test_planes_that_are_unused_or_dark_tell_nothing(strength):
    """Two planes see the phase, one is masked, one is dark; a mode of unit rms is seen by all the light."""
    pupil, modes = small_telescope()
    variance = np.ones((4, 18, 21)) * np.array([0.5, 2.0, np.inf, 0.0])[:, None, None]
    bars = bars_of([1.0, 3.0, 7.0, 7.0], variance, strength)
    information = (1 / 0.5 + 9 / 2.0) * np.sum(pupil**2)
    expected = 1 / (information + 1 / (strength * np.asarray(modes.turbulent_rad2)))
    np.testing.assert_allclose(bars.mode_rad2, expected, rtol=1e-9)
    np.testing.assert_allclose(bars.sensor_loss, 4 * 10 / information, rtol=1e-9)


def test_one_number_makes_nothing_less_known_than_it_was():
    """All modes look alike, which the series of nearly independent modes cannot follow: then the turbulence bounds."""
    pupil, modes = small_telescope()
    pattern = jnp.asarray(np.random.default_rng(2).normal(size=pupil.shape) * pupil)
    prior = 100 * np.asarray(modes.turbulent_rad2)
    told = {"strength": 100.0, "photons": 10.0, "key": jax.random.key(4)}
    for noise in (1e-6, 1e-2, 1e2):
        bars = error_bars(
            lambda phase_rad: jnp.sum(pattern * phase_rad).reshape(1, 1, 1), jnp.full((1, 1, 1), noise), modes, **told
        )
        assert np.all(bars.mode_rad2 <= prior * (1 + 1e-12))
        assert np.all(bars.mode_rad2 > 0)


def test_without_light_the_turbulence_is_what_is_left():
    modes = small_telescope()[1]
    bars = bars_of([1.0], np.full((1, 18, 21), np.inf), 5.0)
    np.testing.assert_allclose(bars.mode_rad2, 5 * np.asarray(modes.turbulent_rad2), rtol=1e-12)
    np.testing.assert_allclose(bars.wavefront_rad**2, 5 * (np.sum(modes.turbulent_rad2) + modes.beyond_rad2))
    assert np.all(np.isinf(bars.sensor_loss))


def transforms(jaxpr) -> int:
    """Two-dimensional Fourier transforms of a program, those in loops as often as they run."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "fft":
            total += math.prod(equation.invars[0].aval.shape[:-2])
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", None)
            if inner is not None:
                total += equation.params.get("length", 1) * transforms(getattr(inner, "jaxpr", inner))
    return total


def test_the_ffts_are_those_that_run():
    phase_rad = jnp.asarray(whole("flat")[0])
    modes = ModesInBands.build(telescope()[0].first(60), probes=2, dtype="float64")
    mean, along = jax.linearize(model, phase_rad)

    def told(key):
        return error_bars(along, mean, modes, strength=1.0, photons=PHOTONS, key=key)

    program = jax.make_jaxpr(lambda key: told(key).mode_rad2)(jax.random.key(0))
    assert transforms(program.jaxpr) == told(jax.random.key(0)).ffts == 5 * (1 + 2 * (11 + 2))


def test_no_probe_is_refused():
    with pytest.raises(SettingsError, match=r"^estimation\.probes: must be at least 1, got 0$"):
        ModesInBands.build(telescope()[0].first(20), probes=0)
