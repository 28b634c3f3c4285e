"""From a wrapped phase to a wavefront: unwrapping and modal filtering in one linear projection."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Float, Int

from nlcwfs.beam.modes import ModalBasis
from nlcwfs.estimation.angle import wrap

WEAKEST_DIRECTION = 1e-3
"""Combinations of modes whose slopes are this much weaker than the strongest are left to the remainder."""


class SlopeUnwrapper(eqx.Module):
    """Fits the slopes of modes to the wrapped slopes of a phase (Guyon 2010, sec. 3.2).

    The difference of neighbouring pixels does not feel the wraps, once brought into -pi..pi. Its projection on
    the slopes of the modes unwraps and filters in one matrix product. But slopes alone forget what the sensor
    knows of the low orders: their noise adds up across the pupil as in a Shack-Hartmann sensor. So the wrapped
    remainder is projected on the modes afterwards, and added.

    Attributes:
        modes: On the lit pixels, one row each.
        weights: Share of the light of each lit pixel, sum 1.
        lit: Rows and columns of the lit pixels.
        nearest: Number of the lit pixel nearest to each pixel.
        first: One lit pixel of each pair of neighbours.
        second: The other.
        from_slopes: Coefficients for one radian of difference on each pair of neighbours.
        passes: How often the remainder is projected back.
    """

    modes: Float[Array, "mode lit"]
    weights: Float[Array, " lit"]
    from_slopes: Float[Array, "mode pair"]
    lit: tuple[Int[Array, " lit"], Int[Array, " lit"]]
    nearest: Int[Array, "y x"]
    first: Int[Array, " pair"]
    second: Int[Array, " pair"]
    passes: int = eqx.field(static=True)

    @classmethod
    def build(
        cls, basis: ModalBasis, *, passes: int, labels: Int[np.ndarray, "y x"] | None = None, dtype: str = "float32"
    ) -> "SlopeUnwrapper":
        """Precompute the projection of slopes for a basis.

        Args:
            basis: Modes on the pixels of the phase.
            passes: How often the wrapped remainder is projected back on the modes.
            labels: Segment of each pixel: a step between two is no slope. The remainder tells it, within half a turn.
            dtype: Precision of the projection.

        Examples:
            >>> from nlcwfs.beam.grid import Grid
            >>> from nlcwfs.beam.modes import modal_basis
            >>> from nlcwfs.beam.pupil import circular_pupil
            >>> grid = Grid((24, 24), pixel_m=0.4)
            >>> basis = modal_basis(circular_pupil(grid, diameter_m=8.0), grid, diameter_m=8.0, count=20)
            >>> phase_rad = basis.combine(np.r_[9.0, np.zeros(19)])  # 9 rad rms of tilt: many wraps
            >>> wrapped_rad = jnp.angle(jnp.exp(1j * phase_rad.astype(complex)))
            >>> unwrapper = SlopeUnwrapper.build(basis, passes=2, dtype="float64")
            >>> round(float(unwrapper.coefficients(wrapped_rad)[0]), 6)
            9.0
        """
        weights = np.asarray(basis.weights)
        rows, columns = np.nonzero(weights > 0)
        number = np.full(weights.shape, -1)
        number[rows, columns] = np.arange(rows.size)
        nearest = np.asarray(
            scipy.ndimage.distance_transform_edt(number < 0, return_distances=False, return_indices=True)
        )
        pairs = [
            (number[:, :-1], number[:, 1:]),
            (number[:-1, :], number[1:, :]),
        ]
        first = np.concatenate([a[(a >= 0) & (b >= 0)] for a, b in pairs])
        second = np.concatenate([b[(a >= 0) & (b >= 0)] for a, b in pairs])
        if labels is not None:
            same = labels[rows, columns][first] == labels[rows, columns][second]
            first, second = first[same], second[same]
        modes = np.asarray(basis.modes, float)[:, rows, columns]
        lit_weights = weights[rows, columns]
        pair_weights = np.minimum(lit_weights[first], lit_weights[second])
        slopes = (modes[:, second] - modes[:, first]) * np.sqrt(pair_weights)
        strength, directions = np.linalg.eigh(slopes @ slopes.T)
        kept = strength > WEAKEST_DIRECTION**2 * strength[-1]
        inverse = (directions[:, kept] / strength[kept]) @ directions[:, kept].T
        from_slopes = inverse @ slopes * np.sqrt(pair_weights)
        return cls(
            modes=jnp.asarray(modes, dtype),
            weights=jnp.asarray(lit_weights, dtype),
            from_slopes=jnp.asarray(from_slopes, dtype),
            lit=(jnp.asarray(rows), jnp.asarray(columns)),
            nearest=jnp.asarray(number[tuple(nearest)]),
            first=jnp.asarray(first),
            second=jnp.asarray(second),
            passes=passes,
        )

    def coefficients(self, wrapped_rad: Float[Array, "y x"]) -> Float[Array, " mode"]:
        """Coefficients of the unwrapped phase, in radians.

        Args:
            wrapped_rad: Phase on the pixels of the basis; whole turns do not matter, nor does what lies
                outside the pupil.
        """
        phase_rad = wrapped_rad[self.lit[0], self.lit[1]].astype(self.modes.dtype)
        found = self.from_slopes @ wrap(phase_rad[self.second] - phase_rad[self.first])
        for _ in range(self.passes):
            remainder = phase_rad - found @ self.modes
            # The common phase of the remainder is piston: take it out before it wraps.
            real, imaginary = jnp.cos(remainder) @ self.weights, jnp.sin(remainder) @ self.weights
            remainder = wrap(remainder - jnp.arctan2(imaginary, real))
            found = found + self.modes @ (self.weights * remainder)
        return found

    def unwrapped(self, wrapped_rad: Float[Array, "y x"]) -> Float[Array, "y x"]:
        """The unwrapped phase, as a sum of modes; each pixel outside the pupil shows its nearest lit one."""
        lit_rad = self.coefficients(wrapped_rad) @ self.modes
        return lit_rad[self.nearest].astype(wrapped_rad.dtype)
