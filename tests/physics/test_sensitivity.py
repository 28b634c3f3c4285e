"""Flux factors against closed forms: what each sensor needs over the quantum limit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.simulation.sensitivity import (
    Optics,
    Signals,
    SignalSums,
    flux_factors,
    information,
    mean_information,
    of_ripples,
    ripples,
    signals,
)
from nlcwfs.simulation.sensitivity_curve import sensitivity_curve
from nlcwfs.simulation.sensitivity_optics import optics_of
from nlcwfs.simulation.sensitivity_settings import LightCells, SensitivityCase, SensitivityQuestion

CELLS = LightCells(across_pupil=64, window=2.0)
SMALL = SensitivityQuestion(question="?", flat=CELLS, rough=CELLS, cycles_per_aperture=(3.0,))
RADIAN_M = 0.85e-6 / (2 * np.pi)
FINE_SPOTS = ("shack_hartmann.field_lambda_over_d=16", "shack_hartmann.pixels=256")


def curve(case: SensitivityCase, rms_rad: float = 0.0, asked: SensitivityQuestion = SMALL):
    return sensitivity_curve(case, case.config(None, asked.set), asked, rms_rad=rms_rad)


def periodic(across: int = 24) -> Optics:
    """An endless aperture: a square of light that fills a periodic grid, on which a ripple stays one."""
    grid = Grid((across, across), 8.0 / across)
    full = jnp.full(grid.shape, 1.0 / across)

    travel = jnp.asarray(np.exp(-1j * np.pi * 0.85e-6 * 1e6 * (grid.fy_per_m**2 + grid.fx_per_m**2)))

    def images(opd_m):
        phase = opd_m / RADIAN_M
        far = jnp.fft.ifft2(jnp.fft.fft2(jax.lax.complex(full * jnp.cos(phase), full * jnp.sin(phase))) * travel)
        return (far.real**2 + far.imag**2)[None]

    return Optics(images, grid, np.full(grid.shape, 1 / across**2), 8.0, 0.85e-6)


@pytest.mark.parametrize("cycles", [1.0, 3.0, 5.0])
def test_a_ripple_on_an_endless_aperture_needs_one_over_the_sine_squared(cycles):
    """Contrast 2 a sin(pi lambda z f^2) of a ripple of amplitude a (Guyon 2010, eq. 2) has that information."""
    optics = periodic()
    modes = jnp.asarray(ripples(optics, [cycles]))
    seen = signals(optics.images, jnp.zeros(optics.grid.shape), modes, wavelength_m=0.85e-6)
    found = of_ripples(np.diag(information(seen)))
    sine = np.sin(np.pi * 0.85e-6 * 1e6 * (cycles / 8) ** 2)
    np.testing.assert_allclose(found, [1 / sine**2], rtol=1e-5)  # rounding: derivatives are exact


def test_a_sensor_of_the_pupil_itself_is_blind_and_says_infinity():
    optics = periodic()
    modes = jnp.asarray(ripples(optics, [2.0]))
    seen = signals(lambda opd_m: 1.0 + 0.0 * opd_m[None, :4, :4], jnp.zeros((24, 24)), modes, wavelength_m=1e-6)
    assert np.isinf(flux_factors(np.diag(information(seen)))).all()


@pytest.mark.parametrize("cycles", [0.5, 2.0])
def test_lenslets_see_what_varies_within_one(cycles):
    """A spot of real amplitude shows its phase at the quantum limit: of a ripple, its variance within a lenslet.

    On an endless aperture that is 12 / (2 pi f d / D)^2 times the photons of the ideal sensor.
    """
    across, catch = 8, "shack_hartmann.least_light=0.05"
    case = SensitivityCase(
        name="lenslets",
        sensor="shack-hartmann",
        reconstruction="linear",
        set=(
            f"shack_hartmann.subapertures={across}",
            catch,
            "shack_hartmann.field_lambda_over_d=16",
            "shack_hartmann.pixels=256",
        ),
    )
    asked = SMALL.model_copy(update={"cycles_per_aperture": (cycles,)})
    found = curve(case, asked=asked)
    grid = Grid((400, 400), 8.0 / 400)
    weights = np.where(np.hypot(grid.y_m, grid.x_m) <= 4.0, 1.0, 0.0)
    weights /= weights.sum()
    turns = 2 * np.pi * cycles / 8 * np.broadcast_to(grid.x_m, grid.shape)
    seen = [within_lenslets(wave, weights, across) / variance(wave, weights) for wave in (np.cos(turns), np.sin(turns))]
    closed = 1 / np.mean(seen)
    # Spots are looked at within 16 lambda/d (4 % of the tilt's information lies beyond) on pixels of a sixteenth of
    # it, which smear the zeros of a spot (6 %); a lenslet on the rim has no symmetric spot.
    assert closed / found.light <= found.factor[0] <= 1.17 * closed / found.light


def variance(wave: np.ndarray, weights: np.ndarray) -> float:
    share = weights / max(weights.sum(), 1e-30)
    return float(np.sum(share * wave**2) - np.sum(share * wave) ** 2)


def within_lenslets(wave: np.ndarray, weights: np.ndarray, across: int) -> float:
    """Variance of the phase in each lenslet, summed with its light: what spots can show of it, to the quantum limit."""
    width = wave.shape[0] // across
    parts = [
        (slice(width * row, width * (row + 1)), slice(width * column, width * (column + 1)))
        for row in range(across)
        for column in range(across)
    ]
    return sum(float(weights[part].sum()) * variance(wave[part], weights[part]) for part in parts)


def test_rough_light_needs_twice_the_photons_whatever_the_frequency():
    """Fully speckled light shows one of two quadratures: a factor of 2."""
    case = SensitivityCase(name="planes")
    asked = SMALL.model_copy(
        update={"rough": LightCells(across_pupil=64, window=4.0), "cycles_per_aperture": (3.0, 8.0), "wavefronts": 2}
    )
    found = curve(case, 12.0, asked)
    np.testing.assert_allclose(found.factor, 2.0, rtol=0.06)  # the far rim of the speckles, two wavefronts
    assert found.wavefronts == 2


def test_the_mean_of_drawn_wavefronts_is_that_of_the_closed_form():
    """The structure function's fading of images, against screens, whose finite number must leave no bias."""
    case = SensitivityCase(
        name="curvature", reconstruction="linear", set=("curvature_sensor.distances_km=[-1000, 1000]",)
    )
    asked = SMALL.model_copy(update={"rough": LightCells(across_pupil=48, window=2.0), "cycles_per_aperture": (8.0,)})
    exact = curve(case, 3.0, asked).factor[0]
    air = Turbulence.from_rms(opd_rms_m=3.0 * RADIAN_M, diameter_m=8.0)
    optics = optics_of(case, case.config(None, asked.set), asked, air)
    screens = PhaseScreens.build(air, shape=(48, 48), pixel_m=optics.grid.pixel_m)
    margin = (optics.grid.shape[0] - 48) // 2
    modes = jnp.asarray(ripples(optics, [8.0]), jnp.float32)
    at = jax.jit(lambda opd_m: signals(optics.images, opd_m, modes, wavelength_m=0.85e-6))
    seen = [at(jnp.pad(screens.draw(jax.random.key(number)), margin)) for number in range(240)]
    drawn = of_ripples(SignalSums.of(seen).information())[0]
    few = np.array([of_ripples(mean_information(seen[start : start + 8]))[0] for start in range(0, 240, 8)])
    biased = np.array([_with_bias(seen[start : start + 8]) for start in range(0, 240, 8)])
    assert exact == pytest.approx(drawn, rel=0.1)  # 5 sigma of 240 screens
    assert 1 / np.mean(1 / few) == pytest.approx(exact, rel=0.25)  # thirty means of eight
    assert np.median(biased) < 0.75 * exact  # what the product of different wavefronts removes


def _with_bias(several: list[Signals]) -> float:
    mean = np.mean([np.asarray(one.mean, float) for one in several], axis=0)
    changes = np.mean([np.asarray(one.changes, float) for one in several], axis=0)
    seen = mean > 1e-9 * mean.max()
    return float(of_ripples(np.sum(changes[:, seen] ** 2 / mean[seen], axis=1))[0])


def test_zernikes_that_are_all_unknown_need_more_than_each_alone():
    case = SensitivityCase(name="planes", set=("curvature_sensor.static_rms_nm=400",))
    asked = SMALL.model_copy(update={"zernikes": 12})
    found = curve(case, asked=asked)
    assert found.factor.shape == (11,)
    assert np.all(found.together >= found.factor * (1 - 1e-6))
    assert np.all(found.factor >= 1)  # nothing beats the quantum limit


def test_ripples_are_orthonormal_where_the_light_is():
    optics = optics_of(SensitivityCase(name="x"), SensitivityCase(name="x").config(None, ()), SMALL, None)
    waves = ripples(optics, [2.5, 7.0], direction_deg=30.0)
    gram = np.einsum("ayx,byx,yx->ab", waves, waves, optics.weights)
    np.testing.assert_allclose(np.diag(gram), 1, rtol=1e-9)
    np.testing.assert_allclose(np.einsum("ayx,yx->a", waves, optics.weights), 0, atol=1e-12)
    assert np.abs(optics.weights - light_weights(np.sqrt(optics.weights))).max() < 1e-9


def test_frequencies_beyond_the_cells_are_refused():
    case, asked = SensitivityCase(name="x"), SMALL.model_copy(update={"cycles_per_aperture": (17.0,)})
    with pytest.raises(SamplingError, match=r"at most 16 cycles per aperture .* got 17"):
        curve(case, asked=asked)


def test_linear_lenslets_are_blind_beyond_half_their_number():
    case = SensitivityCase(
        name="x", sensor="shack-hartmann", reconstruction="linear", set=("shack_hartmann.subapertures=8",)
    )
    asked = SMALL.model_copy(update={"cycles_per_aperture": (3.0, 5.0)})
    factor = curve(case, asked=asked).factor
    assert np.isfinite(factor[0])
    assert np.isinf(factor[1])


def test_a_mean_of_one_wavefront_is_refused():
    one = Signals(jnp.ones((1, 1, 1)), jnp.ones((1, 1, 1, 1)))
    with pytest.raises(SettingsError, match="wavefronts: must be two or more to average, got 1"):
        mean_information([one])
