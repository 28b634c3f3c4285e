"""A linear estimator for a sensor whose response shrinks as the wavefront gets rougher: a few strengths of residual."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nlcwfs.estimation.loop_reconstructor import settled_prior


class Regime(NamedTuple):
    """How a sensor answers amid residuals of one strength. Light is in shares of all that is seen.

    Attributes:
        mean: Mean light on every pixel, sum 1.
        gains: Response to each mode, over that of the closed loop.
        prior_m2: Variance of each mode before the measurement.
        scatter: Variance of a pixel that is neither noise nor linear in the modes, over the square of its mean.
        contrast: Expected square of what differs from the mean light, over that of the mean.
    """

    mean: Float[np.ndarray, " pixel"]
    gains: Float[np.ndarray, " mode"]
    prior_m2: Float[np.ndarray, " mode"]
    scatter: float
    contrast: float


class RegimeEstimator(NamedTuple):
    """The estimator of one regime: `inverse @ (response.T @ (weights * signal))`.

    Attributes:
        weights: Of every pixel: one over the variance of its share.
        inverse: Covariance of the modes after the measurement, in square metres, times their gains.
        error_m2: Variance of what is left of each mode.
    """

    weights: Float[np.ndarray, " pixel"]
    inverse: Float[np.ndarray, "mode mode"]
    error_m2: Float[np.ndarray, " mode"]


def regime_estimator(
    response: Float[np.ndarray, "pixel mode"],
    regime: Regime,
    *,
    electrons: float,
    read_variance: float,
    moved_m2: Float[np.ndarray, " mode"] | None,
) -> RegimeEstimator:
    r"""The linear estimator with the least mean square error amid one strength of residual.

    :math:`g (g R^T N^{-1} R g + C^{-1})^{-1} R^T N^{-1}`; N holds photon noise, read noise and the scatter of what is
    not linear. In a closed loop C is what the last estimate left and what the air has moved since, as for lenslets
    (`loop_reconstructor`).

    Args:
        response: Share of the light for a metre of each mode, in the closed loop.
        regime: The strength.
        electrons: Of the whole exposure.
        read_variance: Variance of a pixel without light, in square electrons.
        moved_m2: How much each mode changes from an exposure to the next; None unless the loop is closed.

    Examples:
        One pixel in which the light falls and rises by a half per metre: with 100 electrons the share of 1 has the
        variance 0.01, the information is 0.25 / 0.01 = 25, and the prior 1 / 0.2 = 5.

        >>> amid = Regime(np.ones(1), np.ones(1), np.array([0.2]), scatter=0.0, contrast=1.0)
        >>> made = regime_estimator(np.array([[0.5]]), amid, electrons=100.0, read_variance=0.0, moved_m2=None)
        >>> made.error_m2.round(4).tolist(), made.weights.tolist()
        ([0.0333], [100.0])
    """
    noise = regime.mean / electrons + read_variance / electrons**2 + regime.scatter * regime.mean**2
    weights = np.where(regime.mean > 0, 1 / np.where(noise > 0, noise, 1), 0)
    amplitude_m = np.sqrt(regime.prior_m2)
    scaled = response * (np.sqrt(weights)[:, None] * (regime.gains * amplitude_m)[None, :])
    fisher = scaled.T @ scaled
    prior = np.ones(amplitude_m.size) if moved_m2 is None else settled_prior(fisher, moved_m2 / regime.prior_m2)
    inverse = np.linalg.inv(fisher + np.diag(1 / prior)) * amplitude_m[:, None] * amplitude_m[None, :]
    return RegimeEstimator(weights, inverse * regime.gains[None, :], np.diag(inverse).copy())


def regime_of(uneven: Float[np.ndarray, " regime"], regimes: Sequence[Regime]) -> int:
    """The strength of residual whose light is as uneven as what is seen.

    Args:
        uneven: Square of what differs from the mean light of each regime, noise taken off, over that of the mean.
        regimes: To choose from.

    Examples:
        >>> some = [Regime(np.ones(1), np.ones(1), np.ones(1), 0.0, one) for one in (1.6, 0.4, 0.1)]
        >>> [regime_of(np.full(3, value), some) for value in (0.3, -0.1, 9.0)]
        [1, 2, 0]
    """
    expected = np.array([one.contrast for one in regimes])
    return int(np.argmin(np.abs(np.log(np.maximum(uneven, 1e-9) / expected))))
