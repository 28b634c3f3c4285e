"""The resolutions that a reconstruction climbs: binned images first, then ever finer waves, then everything."""

import dataclasses
import itertools

import numpy as np
import scipy.fft
from jax import numpy as jnp

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.gerchberg_saxton_settings import GerchbergSaxtonSettings
from nlcwfs.estimation.resolution_level import Level
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.speckle_blur import image_structures, smoothing_factor, unmodelled_variance
from nlcwfs.estimation.turbulence_filter import expected_power

ROOM = 1.4
"""The model's window holds at least this many pupils: the paper's 64 pixels for a pupil of 45."""

BLUR_TO_PHASE = 1.5
"""The phase may reach 1.5 times the frequency from which the images are blurred: the ends overlap."""

BINNED_NYQUIST = 0.6
"""Binned pixels serve cutoffs up to this part of half a cycle per binned pixel."""


def build_ladder(
    geometry: SensorGeometry, settings: GerchbergSaxtonSettings, turbulence: Turbulence, *, dtype: str
) -> tuple[Level, ...]:
    """The levels of a reconstruction, coarse to fine; the last is the full resolution.

    Args:
        geometry: The sensor.
        settings: Cutoffs, binning, iterations.
        turbulence: Strength of the air for the filter.
        dtype: Precision.

    Raises:
        SettingsError: If the window cannot be binned or the cutoffs do not grow.
    """
    _check_cutoffs(settings.coarse_cutoffs_cpa)
    binning = settings.binning if all(size % 2 == 0 for size in geometry.frame.shape) else 1
    shape = window_shape(geometry, binning)

    def level(factor: int, cutoffs_cpa: tuple[float, ...]) -> Level:
        measured = Grid((shape[0] // factor, shape[1] // factor), geometry.frame.pixel_m * factor)
        return _level(geometry, settings, turbulence, measured, factor, cutoffs_cpa, dtype=dtype)

    nyquist_cpa = geometry.pupil.diameter_m / (2 * binning * geometry.frame.pixel_m)
    fits = BINNED_NYQUIST * nyquist_cpa
    binned = tuple(c for c in settings.coarse_cutoffs_cpa if binning > 1 and c <= fits)
    unbinned = settings.coarse_cutoffs_cpa[len(binned) :]
    if settings.filter != "turbulence":
        # Without the filter a cutoff has no meaning: one run on binned images, as in the paper.
        binned, unbinned = binned[:1], ()
    levels = [level(binning, binned)] if binned else []
    levels += [level(1, unbinned)] if unbinned else []
    return (*levels, level(1, ()))


def finest_level(
    geometry: SensorGeometry, turbulence: Turbulence, *, oversampling: int, window: float, dtype: str
) -> Level:
    """The full resolution alone, at least so many telescopes wide, in all colours and moments of the model."""
    shape = window_shape(geometry, 1, window)
    settings = GerchbergSaxtonSettings(oversampling=oversampling)
    level = _level(geometry, settings, turbulence, Grid(shape, geometry.frame.pixel_m), 1, (), dtype=dtype)
    colours, moving = (light(level.grid, dtype=dtype) for light in (geometry.in_colour, geometry.in_motion))
    return dataclasses.replace(level, colours=colours, moving=moving)


def _check_cutoffs(cutoffs_cpa: tuple[float, ...]) -> None:
    grows = all(a < b for a, b in itertools.pairwise(cutoffs_cpa))
    if not grows or any(c <= 0 for c in cutoffs_cpa):
        where = "estimation.gerchberg_saxton.coarse_cutoffs_cpa"
        raise SettingsError(where, "must be positive and grow", list(cutoffs_cpa))


def _level(
    geometry: SensorGeometry,
    settings: GerchbergSaxtonSettings,
    turbulence: Turbulence,
    measured: Grid,
    binning: int,
    cutoffs_cpa: tuple[float, ...],
    *,
    dtype: str,
) -> Level:
    """One level; without cutoffs it is the full resolution."""
    coarse = bool(cutoffs_cpa)
    smooths = coarse and settings.filter == "turbulence"
    oversampling = 1 if coarse else settings.oversampling
    grid = measured.finer(oversampling)
    optics = geometry.model(grid, dtype=dtype)
    pupil = np.asarray(optics.pupil, float)
    diameter_m, wavelength_m = geometry.pupil.diameter_m, geometry.wavelength_m
    limits_per_m = [cutoff / diameter_m for cutoff in cutoffs_cpa] if smooths else [None]
    power = [
        expected_power(grid, turbulence, wavelength_m=wavelength_m, cutoff_per_m=limit and BLUR_TO_PHASE * limit)
        for limit in limits_per_m
    ]
    beyond = [
        unmodelled_variance(turbulence, wavelength_m=wavelength_m, cutoff_per_m=limit) if limit else 0.0
        for limit in limits_per_m
    ]
    structures = [
        image_structures(
            measured,
            turbulence,
            distances_m=geometry.distances_m,
            wavelength_m=wavelength_m,
            cutoff_per_m=limit,
        )
        for limit in limits_per_m
        if limit
    ]
    smoothing = smoothing_factor(measured, radius_m=settings.smoothing * diameter_m)
    return Level(
        optics=optics,
        modulus=jnp.asarray(pupil / np.sqrt(np.sum(pupil**2)), dtype),
        light=jnp.asarray(pupil**2 / np.max(pupil**2), dtype),
        weight=jnp.asarray(light_weights(pupil), dtype),
        power=jnp.asarray(np.array(power), dtype),
        structures=jnp.asarray(np.array(structures), dtype) if smooths else None,
        beyond=jnp.asarray(beyond, dtype),
        smoothing=jnp.asarray(smoothing, dtype),
        grid=grid,
        binning=binning,
        oversampling=oversampling,
        iterations=settings.coarse_iterations if coarse else settings.iterations,
        gain=settings.coarse_gain if smooths else settings.gain,
        fast_forward=settings.coarse_fast_forward if coarse else settings.fast_forward,
        doubt=settings.coarse_doubt if smooths else 0.0,
        tolerance_rad=0.0 if coarse else settings.tolerance_rad,
    )


def window_shape(geometry: SensorGeometry, binning: int, window: float = ROOM) -> tuple[int, int]:
    """Pixels of the model's window: it holds the frames and `window` telescopes, and suits FFT and binning.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((50, 51), 0.18), 0.65e-6, (1e6,))
        >>> window_shape(geometry, 1)
        (64, 63)
    """
    needed = window * geometry.pupil.diameter_m / geometry.frame.pixel_m

    def size(frame: int) -> int:
        count = max(frame, int(np.floor(needed)))
        while (count - frame) % 2 or count % binning or (count // binning) != scipy.fft.next_fast_len(count // binning):
            count += 1
        return count

    return size(geometry.frame.shape[0]), size(geometry.frame.shape[1])
