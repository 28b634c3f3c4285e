"""What the lenslets of a loop see of its mirror's modes, and of the waves beyond them."""

import math

import numpy as np
import scipy.sparse
import scipy.special
from jaxtyping import Bool, Float

from nlcwfs.beam.modes import KOLMOGOROV_SPECTRUM
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.loop_reconstructor import LoopModes
from nlcwfs.estimation.slopes_to_modes import average_gradients
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.mirror.settings import MirrorSettings
from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.exposure import wavelength_m

BEYOND = 1.5
"""Waves up to so many times the highest driven frequency are told apart from the driven modes ..."""

MOST_BEYOND = 8.0
"""... but not more than so many cycles per aperture above it: their number grows with the square."""

PERIOD = 1.2
"""Of the series of waves, in diameters of the telescope; at 1 they would repeat at opposite rims."""


class LensletModes:
    """The modes that lenslets measure, and how the mirror makes them.

    Attributes:
        known: What is known of them beforehand.
        to_command: From the driven modes to the mirror's own; None when they are its first.
        count: How many modes the mirror has.
    """

    def __init__(self, known: LoopModes, to_command: Float[np.ndarray, "mode driven"] | None, count: int) -> None:
        self.known, self.to_command, self.count = known, to_command, count

    @classmethod
    def build(cls, config: Config, light: LoopLight, optics: LensletOptics) -> "LensletModes":
        """Push all modes through the geometry of the lenslets.

        Raises:
            SettingsError: If no mode is slow enough to be driven.
        """
        still, own = light.still, light.mirror
        cutoff = config.shack_hartmann.cutoff_cpa or config.shack_hartmann.subapertures / 2
        modes = own if config.mirror.kind == "karhunen-loeve" else _ideal_modes(config, light, cutoff)
        cycles = np.asarray(modes.cycles_per_aperture, float)
        driven = int(np.sum(cycles <= cutoff))
        if not driven:
            raise SettingsError("shack_hartmann.cutoff_cpa", f"must be at least {cycles[0]:.2f}, the tilt's", cutoff)
        gradients = slopes_of_cells(optics, np.asarray(light.weights) > 0)
        shapes = np.asarray(modes.shapes, float)
        seen = [gradients @ shapes.T]
        strength = (still.shape.diameter_m / still.air.fried_at(wavelength_m(config))) ** (5 / 3)
        strength *= (wavelength_m(config) / (2 * math.pi)) ** 2
        open_m2 = [KOLMOGOROV_SPECTRUM * cycles ** (-11 / 3) * 4 / math.pi * strength]
        fastest = cycles[driven - 1]
        waves, frequency = waves_between(cycles[-1], min(BEYOND * fastest, fastest + MOST_BEYOND), light)
        if len(frequency):
            fit = np.asarray(modes.fit, float)
            seen.append(gradients @ (waves - shapes.T @ (fit @ waves)))  # what the mirror's modes do not hold
            open_m2.append(KOLMOGOROV_SPECTRUM * frequency ** (-11 / 3) * strength * 2 / PERIOD**2)
        known = LoopModes(
            interaction=np.concatenate(seen, axis=1),
            open_m2=np.concatenate(open_m2),
            moved_m2=open_m2[0][:driven] * moved_share(config, cycles[:driven]),
        )
        to_command = None if modes is own else np.asarray(own.fit, float) @ shapes[:driven].T
        return cls(known, to_command, own.count)

    def commands(self, matrix: Float[np.ndarray, "driven slope"]) -> Float[np.ndarray, "mode slope"]:
        """A reconstructor of the driven modes as one of the mirror's own; modes that are not driven rest."""
        if self.to_command is not None:
            return self.to_command @ matrix
        return np.pad(matrix, [(0, self.count - len(matrix)), (0, 0)])


def slopes_of_cells(optics: LensletOptics, lit: Bool[np.ndarray, "lit_y lit_x"]) -> scipy.sparse.csr_array:
    """Slope of every subaperture, along y and then x, for each lit cell of the loop's light: geometry alone.

    The same continuation beyond the rim and the same interpolation as of the light, then the mean gradients over the
    lenslets' cells.
    """
    sensor = optics.sensor
    kernels = average_gradients(sensor)
    row, column = np.asarray(sensor.places).T
    cells, across = kernels.shape[3], sensor.subapertures * kernels.shape[3]
    inside = np.arange(cells)
    fine = (row[:, None, None] * cells + inside[:, None]) * across + column[:, None, None] * cells + inside
    spot = np.broadcast_to(np.arange(len(row))[:, None, None], fine.shape)
    both = [(spot * 2 + axis, fine, kernels[axis]) for axis in (0, 1)]
    rows, columns, values = (np.concatenate([one[place].ravel() for one in both]) for place in range(3))
    of_fine = scipy.sparse.csr_array((values, (rows, columns)), shape=(2 * len(row), across**2))
    along = [scipy.sparse.csr_array(np.asarray(one, float)) for one in (optics.along_y, optics.along_x)]
    of_part = of_fine @ scipy.sparse.csr_array(scipy.sparse.kron(*along))
    number = np.cumsum(lit).reshape(lit.shape) - 1
    nearest = number[np.asarray(optics.nearest[0]), np.asarray(optics.nearest[1])].ravel()
    ones = np.ones(nearest.size)
    continued = scipy.sparse.csr_array((ones, (np.arange(nearest.size), nearest)), shape=(nearest.size, lit.sum()))
    return scipy.sparse.csr_array(of_part @ continued)


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
