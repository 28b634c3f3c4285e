"""The air of a loop as the wind carries it: what its modes are an exposure later, and what the mirror makes of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.modes import ModalBasis
from nlcwfs.estimation.moving_modes import DIRECTIONS, Step, carried, displaced_covariance
from nlcwfs.estimation.wind import Wind

UNSTEADY = 0.1
"""Share of its speed by which the wind may blow otherwise than it was found: with none a filter is too sure, and a
wavefront once wrong stays so until the wind has carried it off."""

ROUGHNESS_M = 0.3e-9
"""Rms of new air in each mode of each exposure beside: no model is perfect."""

WORTH_FITTING = 0.02
"""Combinations of commands that move the modes less than this part of the strongest are left alone."""

ENOUGH = 10
"""Modes that come before say little about the strength of the turbulence: they hardly change in a second."""


class MovingAir(NamedTuple):
    """Modes of the air over the pupil, in metres, from one exposure to the next.

    Attributes:
        basis: The modes.
        now_m2: Covariance of one moment.
        step: From exposure to exposure.
        ahead: From the modes of an exposure to those of the one in which its command acts.
        shapes: Modes of each command of the mirror.
        commands: Commands of each mode, by least squares.
        beyond_m2: Variance of the air that is finer than the modes.
    """

    basis: ModalBasis
    now_m2: Float[np.ndarray, "mode mode"]
    step: Step
    ahead: Float[np.ndarray, "mode mode"]
    shapes: Float[np.ndarray, "mode command"]
    commands: Float[np.ndarray, "command mode"]
    beyond_m2: float


def moving_air(
    basis: ModalBasis,
    air: Turbulence,
    wind: Wind,
    shapes: Float[np.ndarray, "mode command"],
    *,
    pixel_m: float,
    diameter_m: float,
    interval_s: float,
    latency_frames: float,
) -> MovingAir:
    """What the wind makes of the modes.

    Args:
        basis: Modes of the pupil.
        air: Its turbulence.
        wind: As it was found.
        shapes: Modes of each command.
        pixel_m: Pixels of the modes.
        diameter_m: Of the telescope.
        interval_s: From exposure to exposure.
        latency_frames: From the end of an exposure to its command.
    """

    def after(frames: float) -> np.ndarray:
        moved = wind.y_m_per_s * interval_s * frames, wind.x_m_per_s * interval_s * frames
        return displaced_covariance(basis, pixel_m, air, [moved])

    now_m2, next_m2 = after(0.0), after(1.0)
    step = carried(now_m2, next_m2)
    ahead = step.again if latency_frames == 0 else carried(now_m2, after(1 + latency_frames)).again
    far_m = float(np.hypot(wind.y_m_per_s, wind.x_m_per_s)) * interval_s
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    around = displaced_covariance(
        basis, pixel_m, air, [(far_m * np.sin(angle), far_m * np.cos(angle)) for angle in angles]
    )
    doubt = UNSTEADY**2 * carried(now_m2, (around + around.T) / 2).new + ROUGHNESS_M**2 * np.eye(basis.count)
    left, size, right = np.linalg.svd(shapes, full_matrices=False)
    kept = size > WORTH_FITTING * size[0]
    commands = (right[kept].T / size[kept]) @ left[:, kept].T
    finer = max(basis.kolmogorov_total_rad2 - float(np.sum(basis.kolmogorov_rad2)), 0.0)
    beyond_m2 = finer * unit_variance_m2(air, diameter_m)
    return MovingAir(basis, now_m2, Step(step.again, step.new + doubt), ahead, shapes, commands, beyond_m2)


def measured_air(
    basis: ModalBasis, modes_m: Float[np.ndarray, "frame mode"], *, seen: int, diameter_m: float, outer_scale_m: float
) -> Turbulence:
    """The turbulence whose modes vary as much as those that were seen.

    Args:
        basis: The modes.
        modes_m: Of the air, one row for each exposure.
        seen: How many of them the mirror makes; the next are not judged.
        diameter_m: Of the telescope.
        outer_scale_m: Is not measured.
    """
    judged = slice(min(ENOUGH, seen - 1), seen)
    unit = Turbulence(diameter_m, outer_scale_m=outer_scale_m)  # D / r0 = 1
    expected_m2 = np.asarray(basis.kolmogorov_rad2)[judged] * unit_variance_m2(unit, diameter_m)
    strength = float(np.median(np.var(modes_m[:, judged], axis=0) / expected_m2))
    return Turbulence(diameter_m * strength ** (-3 / 5), outer_scale_m=outer_scale_m)


def unit_variance_m2(air: Turbulence, diameter_m: float) -> float:
    """Variance of the OPD where that of a unit disc of D / r0 = 1 is 1 rad^2."""
    return (diameter_m / air.fried_m) ** (5 / 3) * (air.wavelength_m / (2 * np.pi)) ** 2
