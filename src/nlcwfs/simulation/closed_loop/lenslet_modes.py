"""What the lenslets of a loop see of its mirror's modes, and of the waves beyond them."""

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from nlcwfs.config import Config
from nlcwfs.estimation.loop_reconstructor import LoopModes
from nlcwfs.estimation.slopes_to_modes import average_gradients
from nlcwfs.simulation.closed_loop.driven_modes import DrivenModes
from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop_waves import loop_waves


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
        waves = loop_waves(config, light, cutoff_cpa=cutoff, setting="shack_hartmann.cutoff_cpa")
        gradients = slopes_of_cells(optics, np.asarray(light.weights) > 0)
        return cls(LoopModes(gradients @ waves.shapes.T, waves.open_m2, waves.moved_m2), waves.drive)

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
