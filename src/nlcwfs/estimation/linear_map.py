"""The matrix from features to modes: the best linear estimate for each number of photons, and how far to trust it."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from nlcwfs.estimation.binned_features import Features
from nlcwfs.estimation.linear_training import TrainingSet

PHOTONS = np.geomspace(1e2, 1e7, 11)
"""Numbers of photons that have a matrix of their own: half a decade apart, a factor 1.8 at most from any."""

RIDGES = np.geomspace(1e-9, 1e-1, 33)
"""Noise to choose from, in units of that of one photon: 1 / photons, or more where the training is short."""

FLOOR = 1e-3
"""Share of the median feature's noise that every feature has at least: some bins never see light."""

CLASSES = 8
"""Wavefronts that judge the matrix are sorted by the size of their estimates into so many classes."""


class Judgement(NamedTuple):
    """What to think of one linear estimate.

    Attributes:
        coefficients_m: The modes.
        variance_m2: Expected square of the error, mean over the pupil.
        ratio: Variance of the turbulence over that of the strongest in training.
    """

    coefficients_m: Float[Array, " mode"]
    variance_m2: Float[Array, ""]
    ratio: Float[Array, ""]


class LinearMap(eqx.Module):
    """Matrices learnt by `learn`, one for each of `PHOTONS`.

    Attributes:
        values: Mean features.
        coefficients_m: Mean modes.
        matrices: From features to modes.
        noise_m2: Variance of the estimate by photon noise, times the photons.
        weights_per_m2: Of the squares of the modes in the size of an estimate: each over its variance in training,
            because many modes tell the strength of the turbulence better than the few strongest.
        noise_size: What photon noise adds to the size, times the photons.
        size: Mean size of the estimates of each class.
        missed_m2: Mean square of their errors without noise, wavefront beyond the modes included.
        ratio: Mean of their `TrainingSet.variance_ratio`.
    """

    values: Float[Array, " feature"]
    coefficients_m: Float[Array, " mode"]
    matrices: Float[Array, "photons mode feature"]
    noise_m2: Float[Array, " photons"]
    weights_per_m2: Float[Array, " mode"]
    noise_size: Float[Array, " photons"]
    size: Float[Array, "photons class"]
    missed_m2: Float[Array, "photons class"]
    ratio: Float[Array, "photons class"]

    def judge(self, features: Features, photons: Float[Array, ""]) -> Judgement:
        """The modes behind the features of an exposure with so many photons; unknown bins say nothing."""
        photons = jnp.maximum(photons, 1)
        which = jnp.argmin(jnp.abs(jnp.asarray(np.log(PHOTONS), photons.dtype) - jnp.log(photons)))
        rest_m = self.matrices[which] @ jnp.where(features.known, features.values - self.values, 0)
        size = jnp.sum(self.weights_per_m2 * rest_m**2) - self.noise_size[which] / photons
        # Beyond the largest class everything grows with the size of the estimate.
        larger = jnp.maximum(size / self.size[which, -1], 1)
        missed_m2 = jnp.interp(size, self.size[which], self.missed_m2[which]) * larger
        ratio = jnp.interp(size, self.size[which], self.ratio[which]) * larger
        return Judgement(self.coefficients_m + rest_m, missed_m2 + self.noise_m2[which] / photons, ratio)


def learn(
    training: TrainingSet,
    noise: Float[np.ndarray, "feature feature"],
    *,
    judges: int,
    beyond_m2: float,
    dtype: str,
) -> LinearMap:
    r"""The linear estimate of least mean square error, from examples.

    :math:`W = C_{mf} (C_{ff} + \rho N)^{-1}` (Wiener; e.g. Kay 1993, sec. 12.5), C the covariances of modes and
    features over the training, which hold what is not linear as noise, N the photon noise of one photon. The ridge
    :math:`\rho` of each number of photons n is the one that does best on wavefronts that were not learnt from:
    1 / n, or more where examples are few.

    Args:
        training: Wavefronts and their features.
        noise: See `BinnedFeatures.noise`.
        judges: The last so many wavefronts are not learnt from, but choose the ridge and measure the error.
        beyond_m2: Variance of the strongest wavefronts beyond the modes.
        dtype: Precision of the result.

    Examples:
        One mode, two features that show it, the second with a hundred times more noise.

        >>> rng = np.random.default_rng(0)
        >>> modes = rng.normal(size=(500, 1)) * 1e-7
        >>> values, images = modes @ np.array([[1e5, 1e5]]), np.ones((1, 1, 1))
        >>> training = TrainingSet(values, modes, np.ones(500), images)
        >>> found = learn(training, np.diag([1.0, 100.0]), judges=50, beyond_m2=0.0, dtype="float64")
        >>> first, second = np.asarray(found.matrices[-1, 0])
        >>> bool(90 < first / second < 110)
        True
    """
    scale = np.sqrt(np.maximum(np.diag(noise), FLOOR * np.median(np.diag(noise))))
    noise = noise / scale / scale[:, None] + FLOOR * np.eye(scale.size)
    mean, mean_m = training.values[:-judges].mean(axis=0), training.coefficients_m[:-judges].mean(axis=0)
    seen, modes_m = (training.values - mean) / scale, training.coefficients_m - mean_m
    taught, asked = slice(None, -judges), slice(-judges, None)
    count = len(seen) - judges
    power, waves = scipy.linalg.eigh(seen[taught].T @ seen[taught] / count, noise)
    power = np.maximum(power, 0)
    shown = seen @ waves
    cross = modes_m[taught].T @ shown[taught] / count
    gains = [1 / (power + ridge) for ridge in RIDGES]
    answers_m = [(shown[asked] * gain) @ cross.T for gain in gains]
    errors_m2 = np.array([np.sum((one - modes_m[asked]) ** 2, axis=1) for one in answers_m])
    noise_m2 = np.array([cross**2 @ gain**2 for gain in gains])
    best = np.argmin(errors_m2.mean(axis=1)[:, None] + noise_m2.sum(axis=1)[:, None] / PHOTONS, axis=0)
    weights_per_m2 = 1 / (np.var(modes_m[taught], axis=0) * modes_m.shape[1])
    ratio = training.variance_ratio[asked]
    classes = [_classes(answers_m[b] ** 2 @ weights_per_m2, errors_m2[b] + beyond_m2 * ratio, ratio) for b in best]
    size, missed_m2, ratios = np.moveaxis(np.array(classes), 1, 0)
    matrices = np.array([(cross * gains[b]) @ waves.T / scale for b in best])
    found = mean, mean_m, matrices, noise_m2[best].sum(axis=1), weights_per_m2, noise_m2[best] @ weights_per_m2
    return LinearMap(*(jnp.asarray(one, dtype) for one in (*found, size, missed_m2, ratios)))


def _classes(
    size: Float[np.ndarray, " screen"], missed_m2: Float[np.ndarray, " screen"], ratio: Float[np.ndarray, " screen"]
) -> Float[np.ndarray, "3 class"]:
    """Means over classes of about equally many wavefronts, from small estimates to large ones."""
    classes = np.array_split(np.argsort(size), min(CLASSES, size.size))
    return np.array([[one[members].mean() for members in classes] for one in (size, missed_m2, ratio)])
