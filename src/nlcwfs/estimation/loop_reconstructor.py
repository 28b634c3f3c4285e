"""From slopes to modes in a closed loop, with what the loop itself leaves of the turbulence as the prior."""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from nlcwfs.errors import SettingsError

ROUNDS = 6
"""Rounds of prediction and measurement after which the prior of a loop has settled to a percent."""


STEADY_WIND = 16.0
"""Air that moves in one exposure, over the random walk of Kalman's filter: the wind is steady, and a wave that is
averaged over n exposures moves n times as far, not the root of it. Measured with the lenslets of the loop, 3e6 photons
a second: D/d 18 (160 Hz, seeds 0 and 1) 1, 4, 16, 64 leave 152, 142, 140, 139 nm, D/d 36: -, 118, 116, 116."""


class LoopModes(NamedTuple):
    """What is known of the modes before anything is measured.

    Attributes:
        interaction: Slope of every subaperture, along y and then x, in radians per metre of each mode.
        open_m2: Variance of each mode in the air.
        moved_m2: How much it changes from an exposure to the next, of those that are driven.
    """

    interaction: Float[np.ndarray, "slope mode"]
    open_m2: Float[np.ndarray, " mode"]
    moved_m2: Float[np.ndarray, " driven"]


class LoopMatrix(NamedTuple):
    """A reconstructor and what it expects of itself.

    Attributes:
        matrix: Metres of each driven mode per radian of each slope.
        prior_m2: Variance of the driven modes before a measurement.
        error_m2: Variance of what is left after it.
    """

    matrix: Float[np.ndarray, "driven slope"]
    prior_m2: Float[np.ndarray, " driven"]
    error_m2: Float[np.ndarray, " driven"]


def loop_reconstructor(known: LoopModes, *, noise_rad2: Float[np.ndarray, " slope"], closed: bool) -> LoopMatrix:
    r"""The reconstructor with the least mean square error of the driven modes.

    :math:`R = (G^T N^{-1} G + C^{-1})^{-1} G^T N^{-1}` as `minimum_variance`; modes that are not driven have the
    variance of the air, are estimated all the same so that they do not alias, and dropped. In a closed loop the
    variance C of the driven ones is what the last estimate left and what the air has moved since, which is found by
    going round: :math:`C \leftarrow \mathrm{diag}((G^T N^{-1} G + C^{-1})^{-1}) + s Q`, Kalman's filter of modes that
    move independently, with s for `STEADY_WIND`.

    Args:
        known: The modes, driven ones first.
        noise_rad2: Variance of every slope from photon and read noise; infinite for one that is not to be used.
        closed: Whether driven modes have what a loop leaves of them, or all of the turbulence.

    Raises:
        SettingsError: If a variance is not positive, or sizes disagree.

    Examples:
        One mode, one slope: C = E + s Q with 1 / E = 1 / N + 1 / C has the solution C = 2 for N = 2, s Q = 1.

        >>> known = LoopModes(np.ones((1, 1)), np.array([100.0]), np.array([1.0 / STEADY_WIND]))
        >>> found = loop_reconstructor(known, noise_rad2=np.array([2.0]), closed=True)
        >>> found.matrix.round(2).tolist(), found.error_m2.round(2).tolist()
        ([[0.5]], [1.0])
    """
    slopes, modes = known.interaction.shape
    driven = known.moved_m2.size
    for name, variance, size in (("open_m2", known.open_m2, modes), ("noise_rad2", noise_rad2, slopes)):
        if np.shape(variance) != (size,) or not np.all(np.asarray(variance) > 0):
            raise SettingsError(f"loop_reconstructor.{name}", f"must be {size} positive variances", np.shape(variance))
    # in units of the air's own amplitudes and of the noise: a ridge on unscaled modes would take most from the tilt
    amplitude_m, noise_rad = np.sqrt(known.open_m2), np.sqrt(noise_rad2)
    scaled = known.interaction * (amplitude_m[None, :] / noise_rad[:, None])
    first, rest = scaled[:, :driven], scaled[:, driven:]
    inner = rest.T @ rest
    inner[np.diag_indices(modes - driven)] += 1
    cross = scipy.linalg.solve(inner, rest.T @ first, assume_a="pos") if modes > driven else np.zeros((0, driven))
    fisher = first.T @ first - (rest.T @ first).T @ cross
    moved = known.moved_m2 / known.open_m2[:driven]
    prior = settled_prior(fisher, moved) if closed else np.ones(driven)
    inverse = np.linalg.inv(fisher + np.diag(1 / prior))
    matrix = inverse @ (first.T - cross.T @ rest.T)
    matrix *= amplitude_m[:driven, None] / noise_rad[None, :]
    scale = known.open_m2[:driven]
    return LoopMatrix(matrix, prior * scale, np.diag(inverse) * scale)


def settled_prior(
    fisher: Float[np.ndarray, "mode mode"], moved: Float[np.ndarray, " mode"]
) -> Float[np.ndarray, " mode"]:
    """Variance of modes in a loop that has settled: what an estimate leaves, and what the air moves, see above.

    Args:
        fisher: Information of an exposure, in units of the modes' variance in the open loop.
        moved: What changes from an exposure to the next, in the same units.

    Examples:
        >>> settled_prior(np.array([[50.0]]), np.array([0.01 / STEADY_WIND])).round(3).tolist()
        [0.02]
    """
    prior = np.minimum(1, STEADY_WIND * moved)
    for _ in range(ROUNDS):
        prior = np.minimum(1, _left(fisher, prior) + STEADY_WIND * moved)
    return prior


def _left(fisher: Float[np.ndarray, "mode mode"], prior: Float[np.ndarray, " mode"]) -> Float[np.ndarray, " mode"]:
    return np.diag(np.linalg.inv(fisher + np.diag(1 / prior)))
