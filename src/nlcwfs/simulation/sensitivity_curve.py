"""The flux factor of a sensor over frequency, behind a wavefront of a given roughness."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.zernike import zernikes
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.exposure import wavelength_m
from nlcwfs.simulation.sensitivity import (
    Optics,
    Signals,
    SignalSums,
    flux_factors,
    information,
    of_ripples,
    ripples,
    signals,
)
from nlcwfs.simulation.sensitivity_optics import optics_of
from nlcwfs.simulation.sensitivity_settings import SensitivityCase, SensitivityQuestion

MORE_WAVEFRONTS = 16
"""A mean without closed form takes so many times the wavefronts of a sensor that looks at each: it varies more."""

Progress = Callable[[int, int], None]


class Curve(NamedTuple):
    """Flux factors of the modes.

    Attributes:
        factor: Median over the wavefronts, each mode alone.
        low: 16th percentile over the wavefronts; the factor itself where there is one exact mean.
        high: 84th percentile.
        together: Where Zernikes are asked: the same when all are unknown; else NaN.
        wavefronts: How many were drawn; 0 where the mean has a closed form.
        light: Share of the photons that falls on pixels, flat wavefront.
    """

    factor: Float[np.ndarray, " mode"]
    low: Float[np.ndarray, " mode"]
    high: Float[np.ndarray, " mode"]
    together: Float[np.ndarray, " mode"]
    wavefronts: int
    light: float


def sensitivity_curve(
    case: SensitivityCase,
    config: Config,
    question: SensitivityQuestion,
    *,
    rms_rad: float,
    progress: Progress = lambda done, total: None,
) -> Curve:
    """Compute the flux factors of one sensor at one roughness.

    Args:
        case: The sensor.
        config: Its settings.
        question: Modes, cells, number of wavefronts.
        rms_rad: Rms of the Kolmogorov wavefronts, tilt included: of each that is drawn, of all where a mean is exact.
        progress: Told after every wavefront.

    Raises:
        SettingsError: If settings contradict each other.
        SamplingError: If a frequency is too high for the grid.

    Examples:
        >>> from nlcwfs.simulation.sensitivity_settings import LightCells
        >>> case = SensitivityCase(name="planes")
        >>> cells = LightCells(across_pupil=64, window=2.0)
        >>> asked = SensitivityQuestion(question="?", flat=cells, cycles_per_aperture=(4, 8))
        >>> curve = sensitivity_curve(case, case.config(None, asked.set), asked, rms_rad=0.0)
        >>> [round(float(factor), 1) for factor in curve.factor]
        [1.5, 2.4]
    """
    radian_m, diameter_m = wavelength_m(config) / (2 * np.pi), config.beam.diameter_m
    air = Turbulence.from_rms(opd_rms_m=rms_rad * radian_m, diameter_m=diameter_m) if rms_rad > 0 else None
    optics = optics_of(case, config, question, air)
    modes, flat = jnp.asarray(_modes(optics, question), jnp.float32), jnp.zeros(optics.grid.shape, jnp.float32)

    @jax.jit
    def at(opd_m: Float[Array, "Y X"]) -> Signals:
        return signals(optics.images, opd_m, modes, wavelength_m=optics.wavelength_m)

    light, linear = float(jnp.sum(optics.images(flat))), case.reconstruction == "linear"
    if air is None or (linear and optics.long_exposure is not None):
        seen = at(flat) if air is None else _averaged(at(flat), optics, air)
        several, count = [_factors(information(seen), question)], 0
        progress(1, 1)
    elif linear:
        if question.zernikes is not None:
            raise SettingsError("zernikes", "must be left out where a linear sensor's mean must be drawn", case.name)
        count = MORE_WAVEFRONTS * question.wavefronts
        drawn = _drawn(optics, air, rms_rad * radian_m, (question.seed, count), progress)
        several = [_factors(np.diag(SignalSums.of(at(opd_m) for opd_m in drawn).information()), question)]
    else:
        count = question.wavefronts
        drawn = _drawn(optics, air, rms_rad * radian_m, (question.seed, count), progress)
        several = [_factors(information(at(opd_m)), question) for opd_m in drawn]
    alone, together = (np.array(factors) for factors in zip(*several, strict=True))
    if linear and question.zernikes is None:
        alone[:, np.array(question.cycles_per_aperture) > optics.finest_cpa] = np.inf
    low, middle, high = np.percentile(alone, (16, 50, 84), axis=0, method="nearest")
    return Curve(middle, low, high, np.median(together, axis=0), count, light)


def _modes(optics: Optics, question: SensitivityQuestion) -> Float[np.ndarray, "mode Y X"]:
    """What is asked, in radians of unit rms over the pupil, without piston."""
    if question.zernikes is None:
        return ripples(optics, question.cycles_per_aperture, direction_deg=question.direction_deg)
    waves = zernikes(question.zernikes, optics.grid, diameter_m=optics.diameter_m)[1:]
    waves = waves - np.sum(optics.weights * waves, axis=(1, 2), keepdims=True)
    return waves / np.sqrt(np.sum(optics.weights * waves**2, axis=(1, 2), keepdims=True))


def _factors(
    matrix: Float[np.ndarray, "mode mode"], question: SensitivityQuestion
) -> tuple[Float[np.ndarray, " factor"], Float[np.ndarray, " factor"]]:
    """Flux factors of each mode when the others are known, and of Zernikes when all are unknown."""
    if question.zernikes is None:
        alone = of_ripples(np.diag(matrix))
        return alone, np.full(alone.shape, np.nan)
    inverse = np.diag(np.linalg.pinv(matrix, hermitian=True))
    return flux_factors(np.diag(matrix)), flux_factors(1 / np.maximum(inverse, 1e-30))


def _averaged(seen: Signals, optics: Optics, air: Turbulence) -> Signals:
    """Mean images behind turbulence, and their mean derivatives, from those of a flat wavefront."""
    fade = optics.long_exposure
    if fade is None:
        raise ValueError("optics.long_exposure: must be known, got None")
    return Signals(fade(seen.mean, air), jax.lax.map(lambda change: fade(change, air), seen.changes))


def _drawn(
    optics: Optics, air: Turbulence, rms_m: float, chosen: tuple[int, int], progress: Progress
) -> Iterator[Float[Array, "Y X"]]:
    """Independent wavefronts of exactly this rms, without piston, zero outside the pupil; a seed and how many."""
    seed, count = chosen
    lit = np.flatnonzero(optics.weights.any(axis=1))
    margin = int(min(lit[0], optics.grid.shape[0] - 1 - lit[-1]))
    inner = tuple(size - 2 * margin for size in optics.grid.shape)
    screens = PhaseScreens.build(air, shape=(inner[0], inner[1]), pixel_m=optics.grid.pixel_m)
    weights = jnp.asarray(optics.weights, jnp.float32)
    for number in range(count):
        screen_m = jnp.pad(screens.draw(jax.random.fold_in(jax.random.key(seed), number)), margin)
        opd_m = jnp.where(weights > 0, screen_m - jnp.sum(weights * screen_m), 0)
        yield opd_m * (rms_m / jnp.sqrt(jnp.sum(weights * opd_m**2)))
        progress(number + 1, count)
