r"""How many photons a sensor needs to see a mode, relative to what quantum mechanics allows.

A mode of unit rms (one radian over the pupil) changes the mean images; the information that N photons carry of its
amplitude is :math:`F = \sum (\partial \mu)^2 / \mu`, with exact derivatives. No sensor exceeds :math:`4 N` (Haffert et
al. 2023). The flux factor is 4 N / F: photons needed over those of the ideal sensor. It does not depend on N.

A sensor whose reconstructor is linear cannot use what changes from wavefront to wavefront: the signal of its speckles
averages out. Its information is that of the mean images and their mean derivatives over many wavefronts (Guyon 2010,
sec. 5.1). A reconstructor that solves for the wavefront uses the images of each.

Guyon (2005) writes the variance of a ripple's amplitude, both its quadratures together, as
:math:`\beta_p^2 / N` with 1 for the ideal sensor: that is the quantum limit, and beta is the root of the flux factor.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.errors import SamplingError, SettingsError

CELLS_PER_PERIOD = 4
"""Fewest cells of the light in a period of a ripple."""

BLIND = 1e6
"""A sensor that needs so many times the photons of the ideal one is called blind: rounding ends there, too."""

DARK = 1e-9
"""Pixels with less than this share of the brightest one are rounding."""

Images = Callable[[Float[Array, "Y X"]], Float[Array, "image v u"]]
LongExposure = Callable[[Float[Array, "some v u"], Turbulence], Float[Array, "some v u"]]


class Optics(NamedTuple):
    """What is asked of a sensor here.

    Attributes:
        images: Photons on every pixel for a wavefront in metres, when the whole sensor gets one photon.
        grid: Cells of the wavefront.
        weights: Share of the light in every cell.
        diameter_m: Of the telescope.
        wavelength_m: Of the light.
        long_exposure: What turbulence makes of images and their derivatives on average, where a closed form is
            known; None where it must be drawn.
        finest_cpa: Highest frequency that a linear reconstructor tells from others, cycles per aperture.
    """

    images: Images
    grid: Grid
    weights: Float[np.ndarray, "Y X"]
    diameter_m: float
    wavelength_m: float
    long_exposure: LongExposure | None = None
    finest_cpa: float = np.inf


class Signals(NamedTuple):
    """Mean images of one photon, and how they change with modes of one radian.

    Attributes:
        mean: Photons.
        changes: Photons per radian.
    """

    mean: Float[Array, "image v u"]
    changes: Float[Array, "mode image v u"]


def ripples(optics: Optics, cycles: Sequence[float], *, direction_deg: float = 0.0) -> Float[np.ndarray, "mode Y X"]:
    """A cosine and a sine of each frequency, unit rms over the light, without piston.

    Args:
        optics: Their grid and pupil.
        cycles: Cycles per aperture.
        direction_deg: Where the crests move, from +x towards +y.

    Raises:
        SamplingError: If a frequency is too high for the grid, or not positive.

    Examples:
        >>> from nlcwfs.beam.pupil import light_weights
        >>> grid = Grid((32, 32), 0.25)
        >>> optics = Optics(abs, grid, np.full((32, 32), 1 / 1024), 8.0, 1e-6)
        >>> cosine, sine = ripples(optics, [2.0])
        >>> round(float((cosine**2).mean()), 3), round(float((cosine * sine).mean()), 3)
        (1.0, 0.0)
    """
    most = optics.diameter_m / optics.grid.pixel_m / CELLS_PER_PERIOD
    for value in cycles:
        if not 0 < value <= most:
            rule = f"must be above 0 and at most {most:g} cycles per aperture on cells of {optics.grid.pixel_m:.3g} m"
            raise SamplingError("sensitivity.cycles_per_aperture", rule, value)
    along_m = np.cos(np.radians(direction_deg)) * optics.grid.x_m + np.sin(np.radians(direction_deg)) * optics.grid.y_m
    turns = np.asarray(cycles, float)[:, None, None] / optics.diameter_m * along_m
    waves = np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)
    waves = waves.reshape(-1, *optics.grid.shape)
    waves = waves - np.sum(optics.weights * waves, axis=(1, 2), keepdims=True)
    return waves / np.sqrt(np.sum(optics.weights * waves**2, axis=(1, 2), keepdims=True))


def signals(
    images: Images, opd_m: Float[Array, "Y X"], modes: Float[Array, "mode Y X"], *, wavelength_m: float
) -> Signals:
    """Images of a wavefront and their exact derivatives.

    Args:
        images: See `Optics`.
        opd_m: The wavefront.
        modes: In radians.
        wavelength_m: Of the light.

    Examples:
        >>> import jax.numpy as jnp
        >>> at = signals(lambda opd: 1 + opd[None] ** 2, jnp.ones((1, 1)), jnp.ones((1, 1, 1)), wavelength_m=2 * np.pi)
        >>> float(at.mean.sum()), float(at.changes.sum())
        (2.0, 2.0)
    """
    mean, along = jax.linearize(images, opd_m)
    metres = wavelength_m / (2 * np.pi)
    return Signals(mean, jax.lax.map(lambda mode: along((metres * mode).astype(opd_m.dtype)), modes))


def information(seen: Signals) -> Float[np.ndarray, "mode mode"]:
    """Fisher information of the modes that one photon carries, 1 / rad^2.

    Examples:
        >>> import jax.numpy as jnp
        >>> image = Signals(jnp.full((1, 1, 1), 0.5), jnp.full((1, 1, 1, 1), 0.5))
        >>> information(image).round(6).tolist()
        [[0.5]]
    """
    weighted = _per_noise(seen.changes, seen.mean)
    return weighted @ weighted.T


def flux_factors(per_photon: Float[np.ndarray, " mode"]) -> Float[np.ndarray, " mode"]:
    """Photons needed over those of the ideal sensor; infinite where nothing is seen.

    Examples:
        >>> flux_factors(np.array([2.0, 0.0])).tolist()
        [2.0, inf]
    """
    seen = 4 / np.maximum(per_photon, 4 / BLIND / 2)
    return np.where(seen < BLIND, seen, np.inf)


def of_ripples(per_photon: Float[np.ndarray, " mode"]) -> Float[np.ndarray, " frequency"]:
    """Flux factor of each frequency: the mean information of its cosine and its sine.

    Examples:
        >>> of_ripples(np.array([1.0, 3.0])).tolist()
        [2.0]
    """
    return flux_factors(per_photon.reshape(-1, 2).mean(axis=1))


def mean_information(several: Sequence[Signals]) -> Float[np.ndarray, " mode"]:
    r"""Information in the mean images of many wavefronts, of each mode alone, the bias of their number removed.

    The square of a mean derivative over n wavefronts is too large by its variance / n. Products of different wavefronts
    only, :math:`((\sum d)^2 - \sum d^2) / (n (n - 1))`, have the right mean for any n.

    Args:
        several: Two or more independent wavefronts.

    Examples:
        >>> import jax.numpy as jnp
        >>> noise = [Signals(jnp.ones((1, 1, 1)), jnp.full((1, 1, 1, 1), value)) for value in (1.0, -1.0)]
        >>> mean_information(noise).tolist()  # unbiased, so it may be negative where there is nothing
        [-1.0]
    """
    return SignalSums.of(several).information()


class SignalSums(NamedTuple):
    """Sums over wavefronts from which `mean_information` follows, one wavefront in memory at a time.

    Attributes:
        count: Wavefronts.
        mean: Sum of their images.
        changes: Sum of the derivatives.
        squares: Sum of the derivatives' squares.
    """

    count: int
    mean: Float[np.ndarray, "image v u"]
    changes: Float[np.ndarray, "mode image v u"]
    squares: Float[np.ndarray, "mode image v u"]

    @classmethod
    def of(cls, several: Iterable[Signals]) -> "SignalSums":
        """The sums over some wavefronts."""
        sums: SignalSums | None = None
        for one in several:
            mean, changes = np.asarray(one.mean, float), np.asarray(one.changes, float)
            before = cls(0, 0 * mean, 0 * changes, 0 * changes) if sums is None else sums
            sums = cls(before.count + 1, before.mean + mean, before.changes + changes, before.squares + changes**2)
        if sums is None or sums.count < 2:
            raise SettingsError("wavefronts", "must be two or more to average", 0 if sums is None else sums.count)
        return sums

    def information(self) -> Float[np.ndarray, " mode"]:
        """Information per photon of each mode."""
        pairs = (self.changes**2 - self.squares) / (self.count * (self.count - 1))
        mean = self.mean / self.count
        seen = mean > DARK * mean.max()
        return np.sum(pairs[:, seen] / mean[seen], axis=1)


def _per_noise(changes: Array, mean: Array) -> Float[np.ndarray, "mode pixel"]:
    """Derivatives in units of the photon noise of one photon."""
    mean_, changes_ = np.asarray(mean, float).ravel(), np.asarray(changes, float).reshape(len(changes), -1)
    seen = mean_ > DARK * mean_.max()
    return changes_[:, seen] / np.sqrt(mean_[seen])
