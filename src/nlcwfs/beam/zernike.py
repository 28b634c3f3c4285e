"""Zernike polynomials: the language in which opticians report a wavefront."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import eval_jacobi

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.errors import SamplingError, SettingsError

WORST_CONDITION = 100.0
"""A fit is refused when noise in one Zernike could be this much larger than the noise in a well seen one."""


def noll_to_nm(noll: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m of a Noll index (from 1); m > 0 is cosine, m < 0 sine.

    Noll 1976 (JOSA 66, 207): even indices are cosines, odd ones sines.

    Raises:
        SettingsError: If the index is below 1.

    Examples:
        >>> [noll_to_nm(noll) for noll in (1, 2, 3, 4, 5, 6)]
        [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2)]
    """
    if noll < 1:
        raise SettingsError("noll", "must be at least 1", noll)
    n = (math.isqrt(8 * noll - 7) - 1) // 2
    place = noll - n * (n + 1) // 2 - 1  # from 0, among the n + 1 Zernikes of this radial order
    m = 2 * ((place + 1) // 2) if n % 2 == 0 else 2 * (place // 2) + 1
    return n, m if noll % 2 == 0 else -m


def nm_to_noll(n: int, m: int) -> int:
    """Noll index of radial order n and azimuthal order m (m > 0 cosine, m < 0 sine).

    Raises:
        SettingsError: If no Zernike has these orders.

    Examples:
        >>> nm_to_noll(2, 0), nm_to_noll(3, -1)
        (4, 7)
    """
    if abs(m) > n or (n - m) % 2:
        raise SettingsError("n, m", "must have |m| <= n and n - m even", (n, m))
    start = n * (n + 1) // 2 + max(abs(m), 1)  # the earlier one of the pair
    if m == 0:
        return start
    return start + (start + (m < 0)) % 2


def zernike(noll: int, grid: Grid, *, diameter_m: float) -> Float[np.ndarray, "y x"]:
    """One Zernike polynomial, with unit rms over the unobstructed disc.

    The radial part is `r^m P_k^(0, m)(2 r^2 - 1)`, a Jacobi polynomial evaluated by its stable recurrence
    (rounding below 1e-10 at Noll 1000, where the textbook sum of factorials has lost every digit).

    Returns:
        The polynomial; zero outside the disc, but pixels whose centre is less than one pixel outside take
        the value at the edge, because part of them is lit.

    Raises:
        SettingsError: If the index is below 1 or the diameter not positive.

    Examples:
        >>> zernike(2, Grid((1, 4), pixel_m=0.5), diameter_m=2.0)
        array([[-1.5, -0.5,  0.5,  1.5]])
    """
    return _zernikes([noll], grid, diameter_m)[0]


def zernikes(count: int, grid: Grid, *, diameter_m: float) -> Float[np.ndarray, "noll y x"]:
    """The Zernike polynomials from Noll 1 (piston) to `count`, each as `zernike` gives it.

    Raises:
        SettingsError: If the count is below 1 or the diameter not positive.

    Examples:
        >>> zernikes(15, Grid((5, 6), pixel_m=0.5), diameter_m=2.0).shape
        (15, 5, 6)
    """
    if count < 1:
        raise SettingsError("zernikes.count", "must be at least 1", count)
    return _zernikes(range(1, count + 1), grid, diameter_m)


class ZernikeFit(eqx.Module):
    """Reads Zernike coefficients from a wavefront known inside some pupil; built by `zernike_fit`.

    Attributes:
        matrix: What every pixel adds to a coefficient; entry 0 is Noll 1.
        lit: Pixels that are looked at.
        condition: Ratio of the best to the worst seen combination of Zernikes on this pupil (1 on a disc).
    """

    matrix: Float[np.ndarray | Array, "noll y x"]
    lit: Bool[np.ndarray | Array, "y x"]
    condition: float = eqx.field(static=True)

    def coefficients(self, opd_m: Float[Array | np.ndarray, "y x"]) -> Float[Array, " noll"]:
        """Least-squares coefficients, in metres; pixels outside the pupil are not looked at."""
        # `where` and not a product alone: NaN outside the pupil is how files mark it.
        seen_m = jnp.where(jnp.asarray(self.lit), jnp.asarray(opd_m), 0)
        return jnp.tensordot(jnp.asarray(self.matrix, seen_m.dtype), seen_m, axes=2)


def zernike_fit(pupil: Float[np.ndarray, "y x"], grid: Grid, *, diameter_m: float, count: int) -> ZernikeFit:
    """Prepare the least-squares fit of the first `count` Zernikes on any pupil, weighted by its light.

    On an obstructed or segmented pupil Zernikes are not orthogonal: they are fitted together, piston
    included, so each coefficient means "the others held as fitted" and depends on `count`.

    Raises:
        SamplingError: If the pupil cannot tell so many Zernikes apart.
        SettingsError: If the count is below 1.

    Examples:
        >>> from nlcwfs.beam.pupil import circular_pupil
        >>> grid = Grid((20, 20), pixel_m=0.1)
        >>> fit = zernike_fit(circular_pupil(grid, diameter_m=2.0), grid, diameter_m=2.0, count=6)
        >>> opd_m = 3e-9 * zernike(5, grid, diameter_m=2.0)
        >>> fit.coefficients(opd_m).tolist()[4]
        3.0...e-09
    """
    weights = light_weights(pupil)
    lit = weights > 0
    root = np.sqrt(weights[lit])
    seen = zernikes(count, grid, diameter_m=diameter_m)[:, lit] * root
    if count > root.size:
        raise SamplingError("zernikes.count", f"must be at most the {root.size} lit pixels", count)
    left, singular, right = np.linalg.svd(seen, full_matrices=False)
    condition = singular[0] / singular[-1] if singular[-1] > 0 else np.inf
    if condition > WORST_CONDITION:
        rule = f"the pupil must tell the Zernikes apart (condition {condition:.3g} > {WORST_CONDITION:g})"
        raise SamplingError("zernikes.count", f"{rule}; ask for fewer", count)
    matrix = np.zeros((count, *pupil.shape))
    matrix[:, lit] = (left / singular) @ right * root
    return ZernikeFit(matrix, lit, float(condition))


def _zernikes(nolls, grid: Grid, diameter_m: float) -> np.ndarray:
    if not diameter_m > 0:
        raise SettingsError("diameter_m", "must be a positive length", diameter_m)
    radius = np.hypot(grid.y_m, grid.x_m) / (diameter_m / 2)
    angle_rad = np.arctan2(grid.y_m, grid.x_m)
    near = radius < 1 + grid.pixel_m / (diameter_m / 2)
    levels, level = np.unique(np.minimum(radius[near], 1), return_inverse=True)  # far fewer than pixels
    stack = np.zeros((len(nolls), *grid.shape))
    for image, noll in zip(stack, nolls, strict=True):
        n, m = noll_to_nm(noll)
        order = abs(m)
        radial = levels**order * eval_jacobi((n - order) // 2, 0, order, 2 * levels**2 - 1)
        turn = np.cos(order * angle_rad[near]) if m >= 0 else np.sin(order * angle_rad[near])
        image[near] = math.sqrt((n + 1) * (1 if m == 0 else 2)) * radial[level] * turn
    return stack
