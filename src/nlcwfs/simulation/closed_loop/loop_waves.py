"""The waves that a loop meets: its mirror's modes, those beyond them, and how strong both are in its air."""

import math
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from nlcwfs.beam.modes import KOLMOGOROV_SPECTRUM
from nlcwfs.config import Config
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.mirror.settings import MirrorSettings
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.exposure import wavelength_m

BEYOND = 1.5
"""Waves up to so many times the highest driven frequency are told apart from the driven modes ..."""

MOST_BEYOND = 8.0
"""... but not more than so many cycles per aperture above it: their number grows with the square."""

PERIOD = 1.2
"""Of the series of waves, in diameters of the telescope; at 1 they would repeat at opposite rims."""


class LoopWaves(NamedTuple):
    """Waves on the lit cells of the light, driven ones first.

    Attributes:
        shapes: Wavefront of a metre of each; waves beyond the mirror without what its modes hold of them.
        driven: How many are driven.
        cycles: Cycles per aperture of each.
        open_m2: Variance of each in the air.
        moved_m2: How much it changes from an exposure to the next, of those that are driven.
        to_command: From the driven modes to the mirror's own; None when they are its first.
        count: How many modes the mirror has.
    """

    shapes: Float[np.ndarray, "mode lit"]
    driven: int
    cycles: Float[np.ndarray, " mode"]
    open_m2: Float[np.ndarray, " mode"]
    moved_m2: Float[np.ndarray, " driven"]
    to_command: Float[np.ndarray, "mode driven"] | None
    count: int

    def commands(self, matrix: Float[np.ndarray, "driven signal"]) -> Float[np.ndarray, "mode signal"]:
        """A reconstructor of the driven modes as one of the mirror's own; modes that are not driven rest."""
        if self.to_command is not None:
            return self.to_command @ matrix
        return np.pad(matrix, [(0, self.count - len(matrix)), (0, 0)])


def loop_waves(config: Config, light: LoopLight, cutoff: float = math.inf) -> LoopWaves:
    """The modes of a loop's mirror up to a frequency, and the waves beyond.

    Args:
        config: The settings.
        light: Mirror and pupil.
        cutoff: Highest frequency that is driven, cycles per aperture.
    """
    still, own = light.still, light.mirror
    modes = own if config.mirror.kind == "karhunen-loeve" else _ideal_modes(config, light, cutoff)
    cycles = np.asarray(modes.cycles_per_aperture, float)
    driven = int(np.sum(cycles <= cutoff))
    shapes = np.asarray(modes.shapes, float)
    strength = (still.shape.diameter_m / still.air.fried_at(wavelength_m(config))) ** (5 / 3)
    strength *= (wavelength_m(config) / (2 * math.pi)) ** 2
    all_shapes, all_cycles = [shapes], [cycles]
    open_m2 = [KOLMOGOROV_SPECTRUM * cycles ** (-11 / 3) * 4 / math.pi * strength]
    fastest = cycles[max(driven - 1, 0)]
    waves, frequency = waves_between(cycles[-1], min(BEYOND * fastest, fastest + MOST_BEYOND), light)
    if len(frequency):
        fit = np.asarray(modes.fit, float)
        all_shapes.append(waves.T - (fit @ waves).T @ shapes)  # what the mirror's modes do not hold
        all_cycles.append(frequency)
        open_m2.append(KOLMOGOROV_SPECTRUM * frequency ** (-11 / 3) * strength * 2 / PERIOD**2)
    return LoopWaves(
        shapes=np.concatenate(all_shapes),
        driven=driven,
        cycles=np.concatenate(all_cycles),
        open_m2=np.concatenate(open_m2),
        moved_m2=open_m2[0][:driven] * moved_share(config, cycles[:driven]),
        to_command=None if modes is own else np.asarray(own.fit, float) @ shapes[:driven].T,
        count=own.count,
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


def moved_share(config: Config, cycles: Float[np.ndarray, " mode"]) -> Float[np.ndarray, " mode"]:
    """Share of its variance by which a mode changes from an exposure to the next: wind from any side.

    A wave that wind turns by the angle a has the correlation cos a with itself, on the mean over its directions J0(a);
    it moves by twice what is missing to 1.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> moved_share(load_config(None, ["loop.rate_hz=100"]), np.array([1.0])).round(5)  # a = 0.0785
        array([0.00308])
    """
    sky = config.atmosphere
    turn = 2 * np.pi * cycles / config.beam.diameter_m / config.loop.rate_hz
    layers = zip(sky.layer_fractions, sky.wind_speeds_m_per_s, strict=True)
    moved = [share * 2 * (1 - scipy.special.j0(turn * speed)) for share, speed in layers]
    return np.sum(moved, axis=0)


def _ideal_modes(config: Config, light: LoopLight, cutoff: float) -> Mirror:
    """Karhunen-Loeve modes up to what is driven and a little beyond, for a mirror of another kind."""
    still = light.still
    fastest = float(np.max(light.mirror.cycles_per_aperture))
    settings = MirrorSettings(kind="karhunen-loeve", cutoff_cpa=min(cutoff, fastest))
    pupil = still.shape.on(light.part)
    dtype = str(light.weights.dtype)
    return Mirror.build(settings, pupil, light.part, diameter_m=still.shape.diameter_m, dtype=dtype)
