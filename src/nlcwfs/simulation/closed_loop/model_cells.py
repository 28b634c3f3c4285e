"""The mirror's shape on the cells of a reconstructor's model."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.pupil import nearest_lit
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.resolution_level import sum_blocks
from nlcwfs.simulation.closed_loop.light import LoopLight


class ModelCells(eqx.Module):
    """From the cells of the light to coarser ones of a model, whose window is wider than the pupil.

    Attributes:
        weights: Share of the light in every cell of its own.
        nearest: The lit cell of the model next to each.
        corner: Cells of the light from the pupil's part to the rim of the model, along y and x.
        coarser: Cells of the light along one of the model.
    """

    weights: Float[Array, "lit_y lit_x"]
    nearest: tuple[np.ndarray, ...]
    corner: tuple[int, int] = eqx.field(static=True)
    coarser: int = eqx.field(static=True)

    @classmethod
    def build(cls, light: LoopLight, lit: Bool[np.ndarray, "Y X"], *, oversampling: int) -> "ModelCells":
        """Lay the cells of a model over those of the light.

        Args:
            light: Of the loop.
            lit: Cells of the model with light.
            oversampling: Of them along a detector pixel.

        Raises:
            SettingsError: If a cell of the model is not a whole number of the light's.
        """
        coarser, rest = divmod(light.still.factor, oversampling)
        if rest:
            rule = f"must be a multiple of estimation.map.oversampling ({oversampling}) in a loop"
            raise SettingsError("simulation.light_oversampling", rule, light.still.factor)
        corner = [(a * coarser - b) // 2 for a, b in zip(lit.shape, light.weights.shape, strict=True)]
        rows, columns = np.nonzero(lit)
        index = nearest_lit(lit)
        return cls(light.weights, (rows[index], columns[index]), (corner[0], corner[1]), coarser)

    def __call__(self, opd_m: Float[Array, "lit_y lit_x"]) -> Float[Array, "Y X"]:
        """A shape on the model's cells, continued beyond the rim as it is there."""
        margins = [(corner, corner) for corner in self.corner]
        both = jnp.stack([jnp.pad(self.weights * opd_m, margins), jnp.pad(self.weights, margins)])
        summed = sum_blocks(both, self.coarser)
        mean_m = jnp.where(summed[1] > 0, summed[0] / jnp.where(summed[1] > 0, summed[1], 1), 0)
        return mean_m[self.nearest[0], self.nearest[1]]
