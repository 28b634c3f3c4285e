"""Kalman's filter of the lenslets, made for the air that a loop has seen."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import DIM, KOLMOGOROV_SPECTRUM, ModalBasis, modal_basis
from nlcwfs.beam.pupil import nearest_lit
from nlcwfs.config import Config
from nlcwfs.constants import SEEING_WAVELENGTH_M
from nlcwfs.feedback.controller import Telemetry
from nlcwfs.simulation.closed_loop.air import learnt_air, unit_variance_m2
from nlcwfs.simulation.closed_loop.carried_spots import CarriedSpots, SpotsAir
from nlcwfs.simulation.closed_loop.flow import AT_LEAST, BEYOND, CELLS
from nlcwfs.simulation.closed_loop.lenslet_modes import slopes_of_cells
from nlcwfs.simulation.closed_loop.lenslets import FollowedSpots
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop_waves import PERIOD, waves_between

FINE = 4.0
"""Cells for each cycle of the finest mode, at least, where the air's covariance is computed. Measured, D/d = 36 at 420
exposures a second: 4 and 8 leave 66.6 nm, and take 12 and 29 s."""

FARTHEST = 1.5
"""Waves finer than the modes count up to so many times the highest frequency of the modes, as noise that is new in each
exposure. It is not: the wind carries it on as well. Measured, D/d = 36 at 420 exposures a second, 0.2 to 0.5 s after
learning: with 1, 4 and 16 times their variance 66.6, 66.4 and 66.3 nm; with half as many modes again 66.3."""

WAVES = 256
"""Waves that are pushed through the lenslets at a time."""


def carried_spots(
    followed: FollowedSpots, config: Config, light: LoopLight, telemetry: Telemetry
) -> CarriedSpots | None:
    """The lenslets with a filter for the wind that a closed loop has seen; None if no wind is clear.

    Args:
        followed: Has measured until now, and knows the strength of the air as the settings have it.
        config: The settings.
        light: Mirror and pupil.
        telemetry: What was recorded.
    """
    basis, lit = filtered_basis(light), np.asarray(light.weights) > 0
    cells = _on_cells(basis, lit)
    weights = np.asarray(basis.weights, float)[lit]
    mirror_m = np.asarray(light.mirror.shapes, float)
    coarse, grid = coarser(basis, light.part)
    air = learnt_air(_told_strength(config, light), coarse, grid, (cells * weights) @ mirror_m.T, telemetry)
    if air is None:
        return None
    gradients = slopes_of_cells(followed.optics, lit)
    interaction = gradients @ cells.T
    finer = finer_rad2(light, basis, gradients, interaction)
    dtype = str(light.weights.dtype)
    return CarriedSpots(
        followed=followed,
        air=SpotsAir(air.step, interaction, finer, air.wind),
        again=jnp.asarray(air.step.again, dtype),
        interaction=jnp.asarray(interaction, dtype),
        pushed=jnp.asarray(gradients @ mirror_m.T, dtype),
        shapes=jnp.asarray(air.shapes, dtype),
        seen=jnp.asarray(air.commands, dtype),
        ahead=jnp.asarray(air.commands @ air.ahead, dtype),
        mirror=light.mirror,
    )


def filtered_basis(light: LoopLight) -> ModalBasis:
    """The modes of the air that are filtered, on the lit part of the light."""
    pupil = light.still.shape.on(light.part)
    count = min(max(AT_LEAST, round(BEYOND * light.mirror.count)), int(np.sum(pupil > DIM)) // CELLS)
    return modal_basis(pupil, light.part, diameter_m=light.still.shape.diameter_m, count=count)


def finer_rad2(
    light: LoopLight,
    basis: ModalBasis,
    gradients: scipy.sparse.csr_array,
    interaction: Float[np.ndarray, "slope mode"],
) -> Float[np.ndarray, "slope slope"]:
    """Covariance of the slopes of the waves that are finer than the modes.

    Args:
        light: Air and pupil.
        basis: The modes, on the lit part of the light.
        gradients: Slopes of each lit cell.
        interaction: Slopes of each mode.
    """
    lit = np.asarray(light.weights) > 0
    lowest = float(basis.cycles_per_aperture[-1])
    waves, frequency = waves_between(lowest, FARTHEST * lowest, light)
    fit = _on_cells(basis, lit) * np.asarray(basis.weights, float)[lit]
    strength = unit_variance_m2(light.still.air, light.still.shape.diameter_m)
    rms_m = np.sqrt(KOLMOGOROV_SPECTRUM * frequency ** (-11 / 3) * strength * 2 / PERIOD**2)
    total = np.zeros((len(interaction),) * 2)
    for first in range(0, len(frequency), WAVES):
        part = waves[:, first : first + WAVES] * rms_m[first : first + WAVES]
        seen = gradients @ part - interaction @ (fit @ part)
        total += seen @ seen.T
    return total


def _on_cells(basis: ModalBasis, lit: np.ndarray) -> Float[np.ndarray, "mode lit"]:
    """Modes on all lit cells; dim ones take the value of their nearest bright neighbour, as of a mirror."""
    bright = np.asarray(basis.weights) > 0
    return np.asarray(basis.modes, float)[:, bright][:, nearest_lit(bright)[lit]]


def coarser(basis: ModalBasis, grid: Grid) -> tuple[ModalBasis, Grid]:
    """The same modes on as large cells as they bear: means over the light of some of the cells.

    Args:
        basis: The modes.
        grid: Their cells.
    """
    across = np.count_nonzero(np.asarray(basis.weights).any(0))
    times = max(1, int(across / (FINE * float(basis.cycles_per_aperture[-1]))))
    rest = [(0, -size % times) for size in grid.shape]

    def summed(values: np.ndarray) -> np.ndarray:
        padded = np.pad(values, [(0, 0)] * (values.ndim - 2) + rest)
        rows, columns = (size // times for size in padded.shape[-2:])
        return padded.reshape(*values.shape[:-2], rows, times, columns, times).sum((-3, -1))

    weights = summed(np.asarray(basis.weights, float))
    modes = np.stack([summed(one * np.asarray(basis.weights, float)) for one in np.asarray(basis.modes)])
    modes /= np.where(weights > 0, weights, 1)
    coarse = eqx.tree_at(lambda one: (one.modes, one.weights), basis, (modes, weights))
    return coarse, Grid(weights.shape, times * grid.pixel_m)


def _told_strength(config: Config, light: LoopLight) -> Config:
    """The settings with Fried's parameter, which the lenslets' reconstructor knows as well."""
    fried_m = light.still.air.fried_at(SEEING_WAVELENGTH_M)
    prior = config.estimation.prior.model_copy(update={"fried_m": fried_m})
    told = config.estimation.model_copy(update={"prior": prior})
    return config.model_copy(update={"estimation": told})
