"""The rms of a wavefront by spatial frequency: which modes the error is in."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.modes import ModalBasis
from nlcwfs.errors import SettingsError

EDGES_CPA = (4.0, 12.0)
"""Where low modes end and high ones begin, cycles per aperture."""


class RmsGroups(eqx.Module):
    """Rms of each group; their squares add up to the square of the whole.

    Attributes:
        tip_tilt_m: The ramps along x and y that fit best.
        low_m: Modes below the first edge, what is left of the ramps not included.
        middle_m: Modes from the first edge on.
        high_m: Modes from the second edge up to the last mode of the basis.
        beyond_m: What no mode of the basis makes.
    """

    tip_tilt_m: Float[Array, ""]
    low_m: Float[Array, ""]
    middle_m: Float[Array, ""]
    high_m: Float[Array, ""]
    beyond_m: Float[Array, ""]

    @property
    def total_m(self) -> Float[Array, ""]:
        """Rms of the whole wavefront, piston removed."""
        groups = [self.tip_tilt_m, self.low_m, self.middle_m, self.high_m, self.beyond_m]
        return jnp.sqrt(jnp.sum(jnp.stack(groups) ** 2))


def rms_groups(
    opd_m: Float[Array, "y x"] | Float[np.ndarray, "y x"],
    basis: ModalBasis,
    *,
    edges_cpa: tuple[float, float] = EDGES_CPA,
) -> RmsGroups:
    """Split the rms of a wavefront over the light into groups of modes, piston removed.

    The two ramps are fitted first, because the strongest Karhunen-Loeve modes are not quite ramps; the modes
    then see what is left. All parts are orthogonal on the light, hence the sum of squares.

    Args:
        opd_m: Wavefront on the pixels of the basis; what is outside the pupil is not looked at.
        basis: Modes of the pupil; its last one is the cutoff.
        edges_cpa: Where low modes end and high ones begin, cycles per aperture.

    Raises:
        SettingsError: If the edges are not in order.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.modes import modal_basis
        >>> from nlcwfs.beam.pupil import circular_pupil
        >>> grid = Grid((24, 24), pixel_m=0.4)
        >>> basis = modal_basis(circular_pupil(grid, diameter_m=8.0), grid, diameter_m=8.0, count=60)
        >>> groups = rms_groups(3e-7 * basis.modes[9] + 4e-7 * basis.modes[55], basis)
        >>> [round(float(each) * 1e9) for each in (groups.low_m, groups.middle_m, groups.total_m)]
        [300, 400, 500]
    """
    if not 0 <= edges_cpa[0] <= edges_cpa[1]:
        raise SettingsError("edges_cpa", "must be two frequencies, the lower one first", edges_cpa)
    opd_m = jnp.asarray(opd_m)
    weights = jnp.asarray(basis.weights, opd_m.dtype)
    lit = weights > 0
    left_m = jnp.where(lit, opd_m, 0)  # NaN outside the pupil is how files mark it
    left_m = left_m - jnp.sum(weights * left_m)
    tip_tilt_m2, left_m = _without_ramps(left_m, weights)
    coefficients_m = basis.project(left_m)
    beyond_m = left_m - basis.combine(coefficients_m)
    cycles = jnp.asarray(basis.cycles_per_aperture)
    low, high = cycles < edges_cpa[0], cycles >= edges_cpa[1]
    squares_m2 = coefficients_m**2
    return RmsGroups(
        tip_tilt_m=jnp.sqrt(tip_tilt_m2),
        low_m=jnp.sqrt(jnp.sum(jnp.where(low, squares_m2, 0))),
        middle_m=jnp.sqrt(jnp.sum(jnp.where(low | high, 0, squares_m2))),
        high_m=jnp.sqrt(jnp.sum(jnp.where(high, squares_m2, 0))),
        beyond_m=jnp.sqrt(jnp.sum(weights * beyond_m**2)),
    )


def _without_ramps(
    opd_m: Float[Array, "y x"], weights: Float[Array, "y x"]
) -> tuple[Float[Array, ""], Float[Array, "y x"]]:
    """Mean square of the ramps that fit best, and the rest; the wavefront comes without piston."""
    rows, columns = opd_m.shape
    y, x = jnp.meshgrid(jnp.arange(rows, dtype=opd_m.dtype), jnp.arange(columns, dtype=opd_m.dtype), indexing="ij")
    x = x - jnp.sum(weights * x)
    x = x / jnp.sqrt(jnp.sum(weights * x**2))
    y = y - jnp.sum(weights * y)
    y = y - jnp.sum(weights * x * y) * x
    y = y / jnp.sqrt(jnp.sum(weights * y**2))
    along_x, along_y = jnp.sum(weights * x * opd_m), jnp.sum(weights * y * opd_m)
    return along_x**2 + along_y**2, opd_m - along_x * x - along_y * y
