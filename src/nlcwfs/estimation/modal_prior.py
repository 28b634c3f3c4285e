"""A phase as independent unknowns when the modes of the pupil have a whole covariance, rim and wind included."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.estimation.whitened_phase import Unknown


class ModalPrior(eqx.Module):
    r"""The map from unknowns of unit variance to a phase, :math:`\phi = M S x` with :math:`S S^T` the covariance.

    The root S is turned so that a frame informs each unknown apart from all others: the curvature of a fit is then the
    diagonal that `preconditioner` divides out. It has the methods of `WhitenedPhase` that a fit needs; the tilt is one
    of its modes, and `Unknown.slope` stays empty-handed.

    Attributes:
        root: S, from unknowns to modes.
        spread: M S, from unknowns to lit cells.
        seen: Fisher information that a frame has of each unknown.
        lit: Places of the lit cells.
        shape: Of the grid.

    Examples:
        >>> modes = np.eye(3)[:, :2]  # two modes on three cells
        >>> prior = ModalPrior.build(modes, np.diag([4.0, 1.0]), np.eye(2), np.array([0, 1, 3]), (2, 2))
        >>> prior.phase_rad(Unknown(jnp.ones(2, "float32"), jnp.zeros(2, "float32"))).shape, sorted(prior.seen.tolist())
        ((2, 2), [1.0, 4.0])
    """

    root: Float[Array, "mode unknown"]
    spread: Float[Array, "cell unknown"]
    seen: Float[Array, " unknown"]
    lit: Int[Array, " cell"]
    shape: tuple[int, int] = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        modes: Float[np.ndarray, "cell mode"],
        covariance: Float[np.ndarray, "mode mode"],
        information: Float[np.ndarray, "mode mode"],
        lit: Int[np.ndarray, " cell"],
        shape: tuple[int, int],
        dtype: str = "float32",
    ) -> "ModalPrior":
        """Unknowns of modes with this covariance, turned to the information that a frame has.

        Args:
            modes: On the lit cells.
            covariance: Of what is expected beside the mean, rad^2.
            information: Of a frame, 1/rad^2.
            lit: Places of the lit cells in the grid, row by row.
            shape: Of the grid.
            dtype: Precision.
        """
        root = np.linalg.cholesky(covariance)
        seen, turn = np.linalg.eigh(root.T @ information @ root)
        root = root @ turn
        kept = {"root": root, "spread": modes @ root, "seen": np.maximum(seen, 0)}
        return cls(**{k: jnp.asarray(v, dtype) for k, v in kept.items()}, lit=jnp.asarray(lit), shape=shape)

    def phase_rad(self, unknown: Unknown) -> Float[Array, "y x"]:
        """The phase of these unknowns."""
        flat = jnp.zeros(self.shape[0] * self.shape[1], self.spread.dtype)
        return flat.at[self.lit].set(self.spread @ unknown.waves).reshape(self.shape)

    def transposed(self, gradient: Float[Array, "y x"]) -> Unknown:
        """The transpose of `phase_rad`."""
        return Unknown(gradient.reshape(-1)[self.lit] @ self.spread, jnp.zeros(2, self.spread.dtype))

    def dot(self, a: Unknown, b: Unknown) -> Float[Array, ""]:
        """Inner product; of an unknown with itself twice its negative logarithm of the prior."""
        return jnp.dot(a.waves, b.waves)

    def nothing(self) -> Unknown:
        """The unknowns of what is expected."""
        return Unknown(jnp.zeros_like(self.seen), jnp.zeros(2, self.seen.dtype))

    def preconditioner(self, information: Float[Array, ""], shown: Unknown) -> Unknown:
        """Inverse of the curvature of a fit; the information of a frame is known better than its mean per cell."""
        return Unknown(1 / (1 + self.seen), jnp.ones(2, self.seen.dtype))
