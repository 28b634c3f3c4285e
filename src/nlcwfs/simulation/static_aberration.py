"""The known aberration in the arm of the sensor, and the part of a grid that holds the light."""

import math

import jax
import numpy as np
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.defocused_images import centred_in
from nlcwfs.errors import SamplingError


def static_aberration(config: Config, weights: Float[np.ndarray, "Y X"], grid: Grid) -> Float[np.ndarray, "Y X"]:
    """The known aberration in the arm of the sensor: Kolmogorov without piston and tilt, of exactly its rms.

    Tilt is left out because it moves all images alike in angle: alignment takes it away.
    """
    rms_m = config.curvature_sensor.static_rms_nm * 1e-9
    if rms_m == 0:
        return np.zeros(grid.shape)
    cut = lit_part(weights)
    screens = PhaseScreens.build(Turbulence(1.0), shape=weights[cut].shape, pixel_m=grid.pixel_m)
    drawn = np.asarray(screens.draw(jax.random.key(config.curvature_sensor.static_seed)), float)
    planes = np.stack([axis[cut] for axis in np.broadcast_arrays(1.0, grid.y_m, grid.x_m)])
    weighted = planes * weights[cut]
    slopes = np.linalg.solve(np.einsum("ayx,byx->ab", weighted, planes), np.einsum("ayx,yx->a", weighted, drawn))
    bent = np.where(weights[cut] > 0, drawn - np.einsum("a,ayx->yx", slopes, planes), 0)
    return centred_in(bent * (rms_m / math.sqrt(np.sum(weights[cut] * bent**2))), grid.shape)


def lit_part(pupil: Float[np.ndarray, "Y X"]) -> tuple[slice, slice]:
    """The smallest part of a grid that holds all the light, of which there must be some, and has its centre.

    Raises:
        SamplingError: If no light gets through.

    Examples:
        >>> lit_part(np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]))
        (slice(1, 3, None), slice(1, 2, None))
    """
    slices = []
    for size, lit in zip(pupil.shape, (pupil.any(axis=1), pupil.any(axis=0)), strict=True):
        index = np.flatnonzero(lit)
        if not index.size:
            raise SamplingError("beam.pupil_map", "must let light through on the grid of the light", "no light")
        margin = int(min(index[0], size - 1 - index[-1]))
        slices.append(slice(margin, size - margin))
    return slices[0], slices[1]
