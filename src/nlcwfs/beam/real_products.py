"""Matrix products of complex light in real numbers: XLA on CPUs multiplies complex ones several times more slowly."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


def intensity_behind(
    field: Float[Array, "part *n y x"], to_v: Complex[Array, "v y"], to_u: Complex[Array, "u x"]
) -> Float[Array, "*n v u"]:
    """Squared modulus of `to_v @ field @ to_u.T`.

    Args:
        field: Real and imaginary part of any number of fields.
        to_v: What the optics do along y.
        to_u: What they do along x.

    Examples:
        >>> import numpy as np
        >>> field = np.array([[1.0, 2.0]]) + 1j * np.array([[0.0, 1.0]])
        >>> double = jnp.asarray(2j * np.eye(2))
        >>> intensity_behind(jnp.stack([field.real, field.imag]), jnp.ones((1, 1), complex), double).tolist()
        [[4.0, 20.0]]
    """
    along = _times(field, to_u)
    across = _times(along.swapaxes(-1, -2), to_v)
    return (across[0] ** 2 + across[1] ** 2).swapaxes(-1, -2)


def _times(field: Float[Array, "part *n row column"], matrix: Complex[Array, "out column"]) -> Array:
    """Real and imaginary part of every row times a matrix."""
    count = matrix.shape[0]
    both = jnp.concatenate([matrix.real, matrix.imag]).T
    flat = jnp.matmul(field.reshape(-1, field.shape[-1]), both, precision=jax.lax.Precision.HIGHEST)
    product = flat.reshape(*field.shape[:-1], 2, count)
    real = product[0, ..., 0, :] - product[1, ..., 1, :]
    return jnp.stack([real, product[0, ..., 1, :] + product[1, ..., 0, :]])
