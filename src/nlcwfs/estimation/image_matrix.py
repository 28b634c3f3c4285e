"""One matrix from images to modes, the test whether it holds, and the range in which it does."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.estimation.image_signals import ImageSignal
from nlcwfs.estimation.interaction_matrix import Linearised
from nlcwfs.estimation.loop_reconstructor import LoopModes, loop_reconstructor

EXACT = jax.lax.Precision.HIGHEST
"""Accelerators round the factors of a product to 11 bits unless told otherwise."""

DRAWS = 24
"""Random residuals from which it is learnt what is not linear, and how much chi-square varies."""

FACTORS = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Sizes of residuals at which the linear estimate is tried, over what the loop leaves of the driven modes."""

TRIES = 6
"""Residuals of each size."""

BENT = 0.5
"""The linear range ends where the estimate is off the linear one by more than this part of it: a loop still shrinks
such a residual, but not a much larger one."""

MARGIN = 3.0
"""A linear range serves that is so many times what the loop leaves. Measured (`bench/linear_regime.py`): with 4.0 (2 m)
and 4.7 (8 m, 3e7 photons at 1 kHz) a loop stays; with 2.1 (8 m, 3e6 photons at 260 Hz) it crept away to 240 nm."""

LEAST_CHI2 = 1.5
"""Below so much chi-square no estimate is doubted: normalised differences hardly let it grow."""

DRAW = 53
"""Seed of the residuals."""


class LinearRange(NamedTuple):
    """How a linear estimate does with larger and larger residuals, measured on random ones.

    Attributes:
        rms_m: Of the driven modes.
        missed: Rms of what the estimate is off the linear one, over that of the linear one; of mean images.
        chi2: Of data less linear model, over its mean for residuals as the loop leaves them; with noise.
        size: Rms of the estimate over that of the residual.
        limit_m: Largest residual of which no more than `BENT` is missed; 0 if there is none.
        limit_chi2: Chi-square there, `LEAST_CHI2` at least.
    """

    rms_m: tuple[float, ...]
    missed: tuple[float, ...]
    chi2: tuple[float, ...]
    size: tuple[float, ...]
    limit_m: float
    limit_chi2: float

    @property
    def serves(self) -> bool:
        """Whether there is room for what the loop leaves, `MARGIN` times."""
        return self.limit_m >= MARGIN * self.rms_m[0]


class Residuals(NamedTuple):
    """What a loop leaves, and what it is seen in.

    Attributes:
        images: Mean electrons of every pixel for the coefficients of all modes, in metres; and a seed for
            waves that are finer than all modes.
        read_variance: Of a pixel, electrons squared.
        dtype: Precision of images and matrices.
    """

    images: Callable[[Float[np.ndarray, " mode"], int], Float[np.ndarray, "plane v u"]]
    read_variance: float
    dtype: str = "float32"


class ImageMatrix(eqx.Module):
    """A linear reconstructor of images.

    Attributes:
        signal: What is taken from the images.
        reference: The signal of the reference wavefront.
        matrix: Metres of each driven mode for each unit of the signal.
        interaction: Signal of a metre of each driven mode.
        weight: One over the variance of each signal.
        expected_chi2: Of signal less linear model, for residuals as the loop leaves them.
        predicted_m: Error that is expected ...
        error_m2: ... and its variance in each driven mode.
        range: In which residuals it holds.
    """

    signal: ImageSignal
    reference: Float[Array, " signal"]
    matrix: Float[Array, "driven signal"]
    interaction: Float[Array, "signal driven"]
    weight: Float[Array, " signal"]
    expected_chi2: float = eqx.field(static=True)
    predicted_m: float = eqx.field(static=True)
    error_m2: Float[np.ndarray | Array, " driven"]
    range: LinearRange = eqx.field(static=True)

    def modes_m(
        self, electrons: Float[Array, "plane v u"], usable: Bool[Array, "plane v u"]
    ) -> Float[Array, " driven"]:
        """The driven modes beside the reference: one product."""
        return jnp.matmul(self.matrix, self._news(electrons, usable), precision=EXACT)

    def chi2(
        self,
        electrons: Float[Array, "plane v u"],
        usable: Bool[Array, "plane v u"],
        modes_m: Float[Array, " driven"],
    ) -> Float[Array, ""]:
        """How much of the signal these modes leave, over what is expected: about 1 where all is linear.

        A second product, which no command has to wait for.
        """
        left = self._news(electrons, usable) - jnp.matmul(self.interaction, modes_m, precision=EXACT)
        return jnp.sum(self.weight * left**2) / self.expected_chi2

    def _news(self, electrons: Float[Array, "plane v u"], usable: Bool[Array, "plane v u"]) -> Float[Array, " signal"]:
        return self.signal.of(electrons, usable) - self.reference


def image_matrix(
    signal: ImageSignal,
    linear: Linearised,
    known: LoopModes,
    left: Residuals,
    *,
    closed: bool,
) -> ImageMatrix:
    """The reconstructor of least mean square error, with what is not linear as noise.

    Args:
        signal: What is taken from the images.
        linear: Mean signal and mean derivative of all modes, driven ones first.
        known: Variances of the modes; its interaction is that of `linear`.
        left: Residuals for which it is made.
        closed: Whether driven modes have what a loop leaves of them, or all of the turbulence.
    """
    rng, dtype, count = np.random.default_rng(DRAW), left.dtype, linear.interaction.shape[1]
    signals = jax.jit(lambda images: signal.of(images, jnp.ones(images.shape, bool)))
    driven_m2 = left_in_loop(signal, known, left) if closed else known.open_m2[: known.moved_m2.size]
    driven = driven_m2.size
    rms_m = np.sqrt(np.concatenate([driven_m2, known.open_m2[driven:]]))
    drawn = rng.standard_normal((DRAWS, count)) * rms_m
    images = [left.images(one, seed) for seed, one in enumerate(drawn)]
    photon = signal.variance(np.mean(images, axis=0), left.read_variance)
    shown = np.stack([np.asarray(signals(one.astype(dtype)), float) for one in images])
    bent = np.mean((shown - linear.signal - drawn @ linear.interaction.T) ** 2, axis=0)
    noise = photon + bent
    made = loop_reconstructor(known, noise_rad2=noise, closed=closed)
    forward, weight = linear.interaction[:, :driven], 1 / noise

    def tried(coefficients_m: np.ndarray, seed: int) -> tuple[float, ...]:
        """Chi-square; squares of what the estimate is off, of the linear one and of the estimate."""
        images = np.maximum(left.images(coefficients_m, seed), 0)
        modes_m = made.matrix @ (np.asarray(signals(images.astype(dtype)), float) - linear.signal)
        linear_m = made.matrix @ (linear.interaction @ coefficients_m)
        noisy = rng.poisson(images) + rng.standard_normal(images.shape) * np.sqrt(left.read_variance)
        news = np.asarray(signals(noisy.astype(dtype)), float) - linear.signal
        chi2 = float(np.sum(weight * (news - forward @ (made.matrix @ news)) ** 2))
        return chi2, *(float(np.sum(one**2)) for one in (modes_m - linear_m, linear_m, modes_m))

    found = []
    for factor in FACTORS:
        scale = np.where(np.arange(count) < driven, factor, 1.0) * rms_m
        one = [tried(scale * rng.standard_normal(count), DRAWS + seed) for seed in range(TRIES)]
        found.append(np.mean(one, axis=0))
    chi2, off_m2, linear_m2, size_m2 = np.array(found).T
    driven_m = np.array(FACTORS) * np.sqrt(np.sum(driven_m2))
    return ImageMatrix(
        signal=signal,
        reference=jnp.asarray(linear.signal, dtype),
        matrix=jnp.asarray(made.matrix, dtype),
        interaction=jnp.asarray(forward, dtype),
        weight=jnp.asarray(weight, dtype),
        expected_chi2=float(chi2[0]),
        predicted_m=float(np.sqrt(np.sum(made.error_m2))),
        error_m2=made.error_m2,
        range=linear_range(driven_m, np.sqrt(off_m2 / linear_m2), chi2 / chi2[0], np.sqrt(size_m2) / driven_m),
    )


def left_in_loop(signal: ImageSignal, known: LoopModes, left: Residuals) -> Float[np.ndarray, " driven"]:
    """Variance of the driven modes that a closed loop leaves: what it errs, and what the air moves since."""
    images = left.images(np.zeros(known.open_m2.size), DRAWS)
    made = loop_reconstructor(known, noise_rad2=signal.variance(images, left.read_variance), closed=True)
    return np.minimum(known.open_m2[: known.moved_m2.size], made.error_m2 + known.moved_m2)


def linear_range(
    rms_m: Float[np.ndarray, " factor"],
    missed: Float[np.ndarray, " factor"],
    chi2: Float[np.ndarray, " factor"],
    size: Float[np.ndarray, " factor"],
) -> LinearRange:
    """Where the linear range ends, interpolated between the sizes that were tried.

    Examples:
        >>> sizes = np.array([1e-8, 2e-8, 4e-8])
        >>> found = linear_range(sizes, np.array([0.3, 0.4, 0.6]), np.array([1.0, 1.2, 2.2]), np.ones(3))
        >>> round(1e9 * found.limit_m, 1), round(found.limit_chi2, 1)
        (30.0, 1.7)
    """
    useful = missed <= BENT
    told = _floats(rms_m), _floats(missed), _floats(chi2), _floats(size)
    if not useful.any():
        return LinearRange(*told, 0.0, 0.0)
    last = int(np.flatnonzero(useful)[-1])
    limit_m = float(rms_m[last])
    if last + 1 < len(rms_m):
        part = (BENT - missed[last]) / (missed[last + 1] - missed[last])
        limit_m += float(part * (rms_m[last + 1] - rms_m[last]))
    limit_chi2 = max(LEAST_CHI2, float(np.interp(limit_m, rms_m, chi2)))
    return LinearRange(*told, limit_m, limit_chi2)


def _floats(values: Float[np.ndarray, " factor"]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
