"""The air of a loop as the wind carries it: what its modes are an exposure later, and what the mirror makes of them.

The wind is found in what the loop has recorded. Whatever the sensor, Kalman's filter starts from here.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.moving_modes import DIRECTIONS, Step, carried, displaced_covariance
from nlcwfs.estimation.phase_prior import expected_air
from nlcwfs.estimation.reconstructor import TYPICAL_SEEING_ARCSEC
from nlcwfs.estimation.wind import Wind, found_wind
from nlcwfs.feedback.controller import Telemetry

UNSTEADY = 0.1
"""Share of its speed by which the wind may blow otherwise than it was found: with none a filter is too sure, and a
wavefront once wrong stays so until the wind has carried it off."""

ROUGHNESS_M = 0.3e-9
"""Rms of new air in each mode of each exposure beside: no model is perfect."""

WORTH_FITTING = 0.02
"""Combinations of commands that move the modes less than this part of the strongest are left alone."""

SLOW = 10
"""Modes that come before say little about the strength of the turbulence: they hardly change in a second."""


class MovingAir(NamedTuple):
    """Modes of the air over the pupil, in metres, from one exposure to the next.

    Attributes:
        basis: The modes.
        turbulence: Told, or as strong as the modes show.
        wind: As it was found.
        now_m2: Covariance of one moment.
        step: From exposure to exposure.
        ahead: From the modes of an exposure to those of the one in which its command acts.
        shapes: Modes of each command of the mirror.
        commands: Commands of each mode, by least squares.
        beyond_m2: Variance of the air that is finer than the modes.
    """

    basis: ModalBasis
    turbulence: Turbulence
    wind: Wind
    now_m2: Float[np.ndarray, "mode mode"]
    step: Step
    ahead: Float[np.ndarray, "mode mode"]
    shapes: Float[np.ndarray, "mode command"]
    commands: Float[np.ndarray, "command mode"]
    beyond_m2: float


def learnt_air(
    config: Config,
    basis: ModalBasis,
    grid: Grid,
    shapes: Float[np.ndarray, "mode command"],
    telemetry: Telemetry | None,
) -> MovingAir | None:
    """The air that a loop has seen; None if no wind is clear.

    Args:
        config: The settings; what they tell of wind and turbulence is not looked for.
        basis: Modes of the pupil.
        grid: Their pixels.
        shapes: Modes of each command.
        telemetry: What was recorded; None where wind and turbulence are told.

    Raises:
        SettingsError: If nothing was recorded, and something is not told.
    """
    modes_m, diameter_m = np.zeros((0, basis.count)), config.beam.diameter_m
    if telemetry is not None:
        modes_m = telemetry.open_loop_m @ shapes.T
    elif _told_air(config) is None:
        rule = "must be told (or fried_m) with estimation.prior.wind_direction_deg and feedback.controller = kalman"
        raise SettingsError("estimation.seeing_arcsec", rule, None)
    wind = _told_wind(config) or _seen_wind(basis, grid, modes_m, interval_s=1 / config.loop.rate_hz)
    if wind is None:
        return None
    air = _told_air(config) or _seen_air(config, basis, modes_m, commands=shapes.shape[1])
    moved_m = wind.y_m_per_s / config.loop.rate_hz, wind.x_m_per_s / config.loop.rate_hz

    def after(frames: float) -> np.ndarray:
        return displaced_covariance(basis, grid.pixel_m, air, [(moved_m[0] * frames, moved_m[1] * frames)])

    now_m2, late = after(0.0), config.feedback.latency_frames
    step = carried(now_m2, after(1.0))
    ahead = step.again if late == 0 else carried(now_m2, after(1 + late)).again
    step = Step(step.again, step.new + _doubt(basis, grid, air, now_m2, float(np.hypot(*moved_m))))
    left, size, right = np.linalg.svd(shapes, full_matrices=False)
    kept = size > WORTH_FITTING * size[0]
    commands = (right[kept].T / size[kept]) @ left[:, kept].T
    finer = max(basis.kolmogorov_total_rad2 - float(np.sum(basis.kolmogorov_rad2)), 0.0)
    return MovingAir(basis, air, wind, now_m2, step, ahead, shapes, commands, finer * unit_variance_m2(air, diameter_m))


def unit_variance_m2(air: Turbulence, diameter_m: float) -> float:
    """Variance in the OPD of what has 1 rad^2 where D / r0 = 1.

    Examples:
        >>> round(1e9 * unit_variance_m2(Turbulence.from_seeing(seeing_arcsec=0.6), 8.0) ** 0.5)
        1993
    """
    return (diameter_m / air.fried_m) ** (5 / 3) * (air.wavelength_m / (2 * np.pi)) ** 2


def _doubt(
    basis: ModalBasis, grid: Grid, air: Turbulence, now_m2: Float[np.ndarray, "mode mode"], moved_m: float
) -> Float[np.ndarray, "mode mode"]:
    """Covariance of what is new because neither the wind nor the model is what it is taken for."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    moves_m = [(moved_m * float(np.sin(angle)), moved_m * float(np.cos(angle))) for angle in angles]
    around_m2 = displaced_covariance(basis, grid.pixel_m, air, moves_m)
    unsteady_m2 = carried(now_m2, (around_m2 + around_m2.T) / 2).new
    return UNSTEADY**2 * unsteady_m2 + ROUGHNESS_M**2 * np.eye(basis.count)


def _told_wind(config: Config) -> Wind | None:
    """The wind that the settings tell, speed and direction."""
    prior = config.estimation.prior
    if prior.wind_direction_deg is None:
        return None
    angle, speed = np.deg2rad(prior.wind_direction_deg), prior.wind_speed_m_per_s
    return Wind(float(speed * np.sin(angle)), float(speed * np.cos(angle)), 1.0)


def _seen_wind(
    basis: ModalBasis, grid: Grid, modes_m: Float[np.ndarray, "frame mode"], *, interval_s: float
) -> Wind | None:
    """The wind in the modes of a loop."""
    lit = np.asarray(basis.weights) > 0
    rows, columns = (slice(np.flatnonzero(line)[0], np.flatnonzero(line)[-1] + 1) for line in (lit.any(1), lit.any(0)))
    inner = np.asarray(basis.modes, np.float32)[:, rows, columns]
    opd_m = np.tensordot(modes_m.astype(np.float32), inner, axes=1)
    return found_wind(opd_m, lit[rows, columns], pixel_m=grid.pixel_m, interval_s=interval_s)


def prior_air(config: Config) -> Turbulence:
    """The turbulence behind the prior of a solver: what the settings tell of it, or typical.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> round(prior_air(load_config(None, ["estimation.seeing_arcsec=0.6"])).fried_m, 3)
        0.168
    """
    settings, diameter_m = config.estimation, config.beam.diameter_m
    told = settings.seeing_arcsec or TYPICAL_SEEING_ARCSEC  # not looked at where Fried's parameter is told
    return expected_air(settings.prior, seeing_arcsec=told, diameter_m=diameter_m)


def _told_air(config: Config) -> Turbulence | None:
    """The turbulence that the settings tell."""
    settings = config.estimation
    if settings.seeing_arcsec is None and settings.prior.fried_m is None:
        return None
    return prior_air(config)


def _seen_air(
    config: Config, basis: ModalBasis, modes_m: Float[np.ndarray, "frame mode"], *, commands: int
) -> Turbulence:
    """The turbulence whose modes vary as much as those that the mirror has followed."""
    diameter_m, far_m = config.beam.diameter_m, config.estimation.prior.outer_scale_m or np.inf
    judged = slice(min(SLOW, commands - 1), commands)
    unit_m2 = unit_variance_m2(Turbulence(diameter_m), diameter_m)
    expected_m2 = np.asarray(basis.kolmogorov_rad2)[judged] * unit_m2
    strength = float(np.median(np.var(modes_m[:, judged], axis=0) / expected_m2))
    return Turbulence(diameter_m * strength ** (-3 / 5), outer_scale_m=far_m)
