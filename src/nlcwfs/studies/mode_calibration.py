"""Whether error bars are honest: errors of an estimate's modes over the errors that it told, by spatial frequency."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.estimation.error_bars import ErrorBars, ModesInBands
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori

GROUPS_CPA = {"low": (0.0, 4.0), "middle": (4.0, 12.0), "high": (12.0, np.inf)}
"""Groups of modes by cycles per aperture; their edges are edges of the bands of `ModesInBands`."""


class ModeErrors(NamedTuple):
    """Projects the error of a wavefront on the modes whose error bars a reconstructor tells.

    Attributes:
        projector: From the lit pixels to the coefficients of unit rms, in rad per metre.
        rows: Row of every lit pixel on the frame; outside of it where the model's window is wider.
        columns: Its column.
        groups: Which modes each group holds.
    """

    projector: Float[np.ndarray, "mode lit"]
    rows: Int[np.ndarray, " lit"]
    columns: Int[np.ndarray, " lit"]
    groups: dict[str, np.ndarray]

    @classmethod
    def of(cls, solver: MaximumAPosteriori) -> "ModeErrors":
        """The modes of a reconstructor."""
        geometry, modes = solver.geometry, solver.error.modes
        window = Grid(modes.shape, geometry.frame.pixel_m)
        light = np.asarray(light_weights(geometry.pupil.on(window)), float)
        rows, columns = np.asarray(modes.rows), np.asarray(modes.columns)
        radian_m = geometry.wavelength_m / (2 * np.pi)
        margins = [(whole - part) // 2 for whole, part in zip(modes.shape, geometry.frame.shape, strict=True)]
        return cls(
            projector=np.asarray(modes.modes, float) * light[rows, columns] / radian_m,
            rows=rows - margins[0],
            columns=columns - margins[1],
            groups=mode_groups(modes),
        )

    def squares_over_told(self, error_m: Float[np.ndarray, "y x"], bars: ErrorBars) -> dict[str, float]:
        """Sum of the squares of the coefficients of each group, over the sum of the variances told.

        Args:
            error_m: Estimate minus truth on the frame's pixels; pixels that are NaN count as right.
            bars: What the estimate told.
        """
        coefficients = self.projector @ np.nan_to_num(error_m)[self.rows, self.columns]
        told = np.asarray(bars.mode_rad2, float)
        return {
            name: float(np.sum(coefficients[own] ** 2) / np.sum(told[own])) if own.any() else np.nan
            for name, own in self.groups.items()
        }


def mode_groups(modes: ModesInBands) -> dict[str, np.ndarray]:
    """For each group of `GROUPS_CPA`, which modes are in it."""
    lower_cpa = np.array([low for low, _ in modes.bands_cpa])[np.asarray(modes.band)]
    return {name: (lower_cpa >= low) & (lower_cpa < high) for name, (low, high) in GROUPS_CPA.items()}
