"""What the lenslets of a loop see of its mirror's modes, and of the waves beyond them."""

import math

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from nlcwfs.beam.modes import KOLMOGOROV_SPECTRUM
from nlcwfs.config import Config
from nlcwfs.estimation.loop_reconstructor import LoopModes
from nlcwfs.estimation.slopes_to_modes import average_gradients
from nlcwfs.simulation.closed_loop.driven_modes import DrivenModes, strength_m2
from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.light import LoopLight

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
        drive: Which are driven, and how the mirror makes them.
    """

    def __init__(self, known: LoopModes, drive: DrivenModes) -> None:
        self.known, self.drive = known, drive

    @classmethod
    def build(cls, config: Config, light: LoopLight, optics: LensletOptics) -> "LensletModes":
        """Push all modes through the geometry of the lenslets.

        Raises:
            SettingsError: If no mode is slow enough to be driven.
        """
        cutoff = config.shack_hartmann.cutoff_cpa or config.shack_hartmann.subapertures / 2
        drive = DrivenModes.build(config, light, cutoff_cpa=cutoff, setting="shack_hartmann.cutoff_cpa")
        cycles = np.asarray(drive.modes.cycles_per_aperture, float)
        gradients = slopes_of_cells(optics, np.asarray(light.weights) > 0)
        shapes = np.asarray(drive.modes.shapes, float)
        seen, open_m2 = [gradients @ shapes.T], [drive.open_m2]
        fastest = cycles[drive.driven - 1]
        waves, frequency = waves_between(cycles[-1], min(BEYOND * fastest, fastest + MOST_BEYOND), light)
        if len(frequency):
            fit = np.asarray(drive.modes.fit, float)
            seen.append(gradients @ (waves - shapes.T @ (fit @ waves)))  # what the mirror's modes do not hold
            strength = strength_m2(config, light)
            open_m2.append(KOLMOGOROV_SPECTRUM * frequency ** (-11 / 3) * strength * 2 / PERIOD**2)
        known = LoopModes(
            interaction=np.concatenate(seen, axis=1), open_m2=np.concatenate(open_m2), moved_m2=drive.moved_m2
        )
        return cls(known, drive)

    @property
    def count(self) -> int:
        """How many modes the mirror has."""
        return self.drive.count

    def commands(self, matrix: Float[np.ndarray, "driven slope"]) -> Float[np.ndarray, "mode slope"]:
        """A reconstructor of the driven modes as one of the mirror's own; modes that are not driven rest."""
        return self.drive.commands(matrix)


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
