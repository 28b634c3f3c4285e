"""Matrix products of complex light in real numbers: XLA on CPUs multiplies complex ones several times more slowly."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
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
        >>> field = np.array([[1.0, 2.0]]) + 1j * np.array([[0.0, 1.0]])
        >>> double = jnp.asarray(2j * np.eye(2))
        >>> intensity_behind(jnp.stack([field.real, field.imag]), jnp.ones((1, 1), complex), double).tolist()
        [[4.0, 20.0]]
    """
    return _intensity(field, to_v, to_u, _times)


def intensity_behind_even(
    field: Float[Array, "part *n y x"],
    to_v: Complex[Array, "parity half_v half_y"],
    to_u: Complex[Array, "parity half_u half_x"],
) -> Float[Array, "*n v u"]:
    """The same for optics that are their own mirror image, with half of the products, see `even_and_odd`.

    Examples:
        >>> optics = np.array([[1.0, 2.0, 5j], [5j, 2.0, 1.0]])
        >>> field = np.array([[1.0, -3.0, 2j]])
        >>> seen = intensity_behind_even(
        ...     jnp.stack([field.real, field.imag]),
        ...     jnp.asarray(even_and_odd(np.ones((2, 1), complex))),
        ...     jnp.asarray(even_and_odd(optics)),
        ... )
        >>> bool(np.allclose(seen[0], abs(optics @ field[0]) ** 2))
        True
    """
    return _intensity(field, to_v, to_u, _times_even)


def even_and_odd(matrix: Complex[np.ndarray, "u x"]) -> Complex[np.ndarray, "parity half_u half_x"]:
    """What optics that are their own mirror image do to the even and to the odd part of a field.

    Args:
        matrix: The same when turned by 180 degrees; an even number of rows.

    Examples:
        >>> even_and_odd(np.array([[1, 2], [2, 1]], complex)).real.tolist()
        [[[1.5]], [[-0.5]]]
    """
    rows, columns = matrix.shape
    half = (columns + 1) // 2
    lower = matrix[rows // 2 :]
    right, left = lower[:, columns - half :], lower[:, :half][:, ::-1]
    return np.stack([right + left, right - left]) / 2


def _intensity(field: Array, to_v: Array, to_u: Array, times: Callable[[Array, Array], Array]) -> Array:
    along = times(field, to_u)
    across = times(along.swapaxes(-1, -2), to_v)
    return (across[0] ** 2 + across[1] ** 2).swapaxes(-1, -2)


def _times(field: Float[Array, "part *n row column"], matrix: Complex[Array, "out column"]) -> Array:
    """Real and imaginary part of every row times a matrix."""
    count = matrix.shape[0]
    both = jnp.concatenate([matrix.real, matrix.imag]).T
    flat = jnp.matmul(field.reshape(-1, field.shape[-1]), both, precision=jax.lax.Precision.HIGHEST)
    product = flat.reshape(*field.shape[:-1], 2, count)
    real = product[0, ..., 0, :] - product[1, ..., 1, :]
    return jnp.stack([real, product[0, ..., 1, :] + product[1, ..., 0, :]])


def _times_even(
    field: Float[Array, "part *n row column"], pair: Complex[Array, "parity half_out half_column"]
) -> Array:
    columns, half = field.shape[-1], pair.shape[2]
    right, left = field[..., columns - half :], jnp.flip(field[..., : columns // 2], -1)
    if columns % 2:  # the column in the middle belongs to one side alone
        left = jnp.pad(left, [(0, 0)] * (field.ndim - 1) + [(1, 0)])
    even, odd = _times(right + left, pair[0]), _times(right - left, pair[1])
    return jnp.concatenate([jnp.flip(even - odd, -1), even + odd], -1)
