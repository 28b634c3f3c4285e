"""The waves that a loop meets: the modes that it drives, those beyond them, and how strong both are in its air."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.modes import KOLMOGOROV_SPECTRUM
from nlcwfs.config import Config
from nlcwfs.simulation.closed_loop.driven_modes import DrivenModes, strength_m2
from nlcwfs.simulation.closed_loop.light import LoopLight

BEYOND = 1.5
"""Waves up to so many times the highest driven frequency are told apart from the driven modes ..."""

MOST_BEYOND = 8.0
"""... but not more than so many cycles per aperture above it: their number grows with the square."""

PERIOD = 1.2
"""Of the series of waves, in diameters of the telescope; at 1 they would repeat at opposite rims."""


class LoopWaves(NamedTuple):
    """Waves on the lit cells of the light, driven ones first.

    Attributes:
        drive: The modes, of which the first are driven.
        shapes: Wavefront of a metre of each wave; waves beyond the modes without what these hold of them.
        cycles: Cycles per aperture of each.
        open_m2: Variance of each in the air.
    """

    drive: DrivenModes
    shapes: Float[np.ndarray, "mode lit"]
    cycles: Float[np.ndarray, " mode"]
    open_m2: Float[np.ndarray, " mode"]

    @property
    def driven(self) -> int:
        """How many waves are driven."""
        return self.drive.driven

    @property
    def moved_m2(self) -> Float[np.ndarray, " driven"]:
        """How much each driven one changes from an exposure to the next."""
        return self.drive.moved_m2


def loop_waves(
    config: Config, light: LoopLight, *, cutoff_cpa: float = math.inf, setting: str = "mirror.cutoff_cpa"
) -> LoopWaves:
    """The modes of a loop up to a frequency, and the waves beyond.

    Args:
        config: The settings.
        light: Mirror and pupil.
        cutoff_cpa: Highest frequency that is driven, cycles per aperture.
        setting: Where that comes from.

    Raises:
        SettingsError: If no mode is slow enough to be driven.
    """
    drive = DrivenModes.build(config, light, cutoff_cpa=cutoff_cpa, setting=setting)
    cycles, shapes = np.asarray(drive.modes.cycles_per_aperture, float), np.asarray(drive.modes.shapes, float)
    fastest = cycles[drive.driven - 1]
    waves, frequency = waves_between(cycles[-1], min(BEYOND * fastest, fastest + MOST_BEYOND), light)
    if not len(frequency):
        return LoopWaves(drive, shapes, cycles, drive.open_m2)
    fit = np.asarray(drive.modes.fit, float)
    beyond_m2 = KOLMOGOROV_SPECTRUM * frequency ** (-11 / 3) * strength_m2(config, light) * 2 / PERIOD**2
    return LoopWaves(
        drive,
        shapes=np.concatenate([shapes, waves.T - (fit @ waves).T @ shapes]),  # what the modes do not hold
        cycles=np.concatenate([cycles, frequency]),
        open_m2=np.concatenate([drive.open_m2, beyond_m2]),
    )


def waves_between(
    lowest: float, highest: float, light: LoopLight
) -> tuple[Float[np.ndarray, "lit wave"], Float[np.ndarray, " wave"]]:
    """Cosines and sines of a Fourier series on the lit cells, and the cycles per aperture of each."""
    most = math.ceil(highest * PERIOD)
    fy, fx = (axis.ravel() / PERIOD for axis in np.mgrid[0 : most + 1, -most : most + 1])
    frequency = np.hypot(fy, fx)
    half = ((fy > 0) | (fx > 0)) & (frequency > lowest) & (frequency <= highest)
    fy, fx, frequency = fy[half], fx[half], frequency[half]
    grid = light.part
    y, x = np.broadcast_arrays(grid.y_m / light.still.shape.diameter_m, grid.x_m / light.still.shape.diameter_m)
    lit = np.asarray(light.weights) > 0
    angle = 2 * np.pi * (y[lit][:, None] * fy + x[lit][:, None] * fx)
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=1), np.concatenate([frequency, frequency])
