"""The errors that a loop is expected to leave, and the rate at which they are least."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from nlcwfs.simulation.design.loop_residual import LoopResidual
from nlcwfs.simulation.design.plane_information import PlaneInformation

RATES_HZ = (5.0, 20000.0)
"""Slowest and fastest rate that is looked at."""


@dataclass(frozen=True)
class Planes:
    """Symmetric pairs of planes.

    Attributes:
        distances_m: Of each pair, positive.
        shares: Of the light, for each pair; sum 1.
    """

    distances_m: tuple[float, ...]
    shares: tuple[float, ...]

    @classmethod
    def evenly(cls, *distances_m: float) -> "Planes":
        """Pairs that share the light evenly.

        Examples:
            >>> Planes.evenly(2.5e6, 3.5e6).shares
            (0.5, 0.5)
        """
        return cls(tuple(distances_m), (1 / len(distances_m),) * len(distances_m))


@dataclass(frozen=True)
class LoopErrors:
    """What is expected to be left, rms in metres.

    Attributes:
        rate_hz: Exposures in a second.
        fitting_m: What the mirror cannot make.
        lag_m: What changes until the correction.
        photon_m: What the planes' photons leave open of the mirror's modes.
        quantum_m: The same for a sensor that loses nothing.
    """

    rate_hz: float
    fitting_m: float
    lag_m: float
    photon_m: float
    quantum_m: float

    @cached_property
    def total_m(self) -> float:
        """All of it."""
        return math.hypot(self.fitting_m, self.lag_m, self.photon_m)

    @cached_property
    def floor_m(self) -> float:
        """All of it with the best sensor that can be."""
        return math.hypot(self.fitting_m, self.lag_m, self.quantum_m)

    @property
    def loss(self) -> float:
        """Photons needed over the quantum limit."""
        return (self.photon_m / self.quantum_m) ** 2


def loop_errors(information: PlaneInformation, planes: Planes, *, rate_hz: float) -> LoopErrors:
    """What planes are expected to leave at a rate.

    Args:
        information: Of planes on pixels.
        planes: The planes.
        rate_hz: Exposures in a second.
    """
    return errors_with(information.residual, _summed(information, planes), rate_hz=rate_hz)


def errors_with(
    residual: LoopResidual, per_photon: Sequence[Float[np.ndarray, "mode mode"]], *, rate_hz: float
) -> LoopErrors:
    r"""What is expected to be left by a sensor of this information.

    The photons' part is :math:`\mathrm{tr}(N F + C^{-1})^{-1}` over the mirror's modes, C what is known beforehand
    (`LoopResidual.prior_rad2`), mean over the draws; modes finer than those computed are like their last quarter.

    Args:
        residual: What is left before an exposure.
        per_photon: Fisher information, one matrix a draw, 1/rad^2.
        rate_hz: Exposures in a second.

    Examples:
        A sensor at the quantum limit, 4 for each photon and mode, leaves what `quantum_m` says.

        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.simulation.design.loop_residual import Loop
        >>> small = Loop(Turbulence(0.2), 1.0, 0.85e-6, 4.0, 10.0, 1.0, photons_per_s=1e6)
        >>> left = LoopResidual.build(small, PupilShape(1.0))
        >>> found = errors_with(left, [4 * np.eye(left.basis.count)], rate_hz=500.0)
        >>> round(found.loss, 6)
        1.0
    """
    prior, photons = residual.prior_rad2(rate_hz), residual.loop.photons_per_s / rate_hz
    return _told(residual, np.mean([posterior_rad2(photons * one, prior) for one in per_photon], axis=0), rate_hz)


def ideal_errors(residual: LoopResidual, *, rate_hz: float, loss: float = 1.0) -> LoopErrors:
    """What a sensor leaves that needs `loss` times the photons of the quantum limit, whatever the mode.

    Args:
        residual: What is left before an exposure.
        rate_hz: Exposures in a second.
        loss: Photons over those of the quantum limit.
    """
    return _told(residual, _at_limit(residual, rate_hz, loss), rate_hz)


def _at_limit(residual: LoopResidual, rate_hz: float, loss: float) -> Float[np.ndarray, " mode"]:
    prior, photons = residual.prior_rad2(rate_hz), residual.loop.photons_per_s / rate_hz
    return prior / (1 + 4 * photons / loss * prior)


def _told(residual: LoopResidual, open_rad2: Float[np.ndarray, " mode"], rate_hz: float) -> LoopErrors:
    """Errors in metres; `open_rad2` is what photons leave open of each mode."""
    told = residual.told

    def of_mirror(each_rad2: Float[np.ndarray, " mode"]) -> float:
        last = float(np.mean(each_rad2[told - max(1, told // 4) : told]))
        return float(np.sum(each_rad2[:told])) + (residual.controlled - told) * last

    lag = float(np.sum(residual.lag_rad2(rate_hz)[:told]))
    squares = residual.fitting_rad2(), lag, of_mirror(open_rad2), of_mirror(_at_limit(residual, rate_hz, 1.0))
    return LoopErrors(rate_hz, *(residual.loop.radian_m * math.sqrt(max(square, 0.0)) for square in squares))


def posterior_rad2(
    information: Float[np.ndarray, "mode mode"], prior_rad2: Float[np.ndarray, " mode"]
) -> Float[np.ndarray, " mode"]:
    """Variance that is left of each mode: the diagonal of `(F + C^-1)^-1`, by Cholesky's factor.

    Examples:
        >>> posterior_rad2(np.diag([3.0, 0.0]), np.array([1.0, 2.0])).round(6).tolist()
        [0.25, 2.0]
    """
    root = np.sqrt(prior_rad2)  # scaled so that nothing is ill conditioned: 1 + C^1/2 F C^1/2
    scaled = np.eye(len(root)) + root[:, None] * information * root
    inverse = scipy.linalg.solve_triangular(np.linalg.cholesky(scaled), np.eye(len(root)), lower=True)
    return prior_rad2 * np.sum(inverse**2, axis=0)


def best_rate_hz(information: PlaneInformation, planes: Planes) -> float:
    """Rate at which the least is expected to be left, to 2 %.

    Args:
        information: Of planes on pixels; counts as the same at all rates.
        planes: The planes.
    """
    per_photon = _summed(information, planes)
    return best_of_rates(lambda rate_hz: errors_with(information.residual, per_photon, rate_hz=rate_hz).total_m)


def best_of_rates(left_m: Callable[[float], float]) -> float:
    """Rate at which a function is least, between `RATES_HZ`, rounded to two digits.

    Examples:
        >>> best_of_rates(lambda rate_hz: rate_hz / 400 + 400 / rate_hz)
        400.0
    """
    low, high = np.log(RATES_HZ)
    found = scipy.optimize.fminbound(lambda one: left_m(math.exp(one)), low, high, xtol=0.02)
    return float(f"{math.exp(float(np.ravel(found)[0])):.2g}")


def _summed(information: PlaneInformation, planes: Planes) -> list[Float[np.ndarray, "mode mode"]]:
    pairs = [information.of_pair(distance_m) for distance_m in planes.distances_m]
    shares = np.array(planes.shares)
    return [np.tensordot(shares, np.stack(draw), axes=1) for draw in zip(*pairs, strict=True)]
