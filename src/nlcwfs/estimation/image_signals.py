"""What a linear reconstructor takes from defocused images: counts in units of the flux, or normalised differences."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.errors import SettingsError

LIT_SHARE = 0.999
"""The brightest pixels that hold so much of the mean light are used; the others are mostly noise."""


@runtime_checkable
class ImageSignal(Protocol):
    """From images to a vector; the same function for mean images, which have a derivative, and for counts."""

    def of(self, electrons: Float[Array, "plane v u"], usable: Bool[Array, "plane v u"]) -> Float[Array, " signal"]:
        """The signal of an exposure; zero where pixels were not read."""
        ...

    def variance(self, electrons: Float[np.ndarray, "plane v u"], read_variance: float) -> Float[np.ndarray, " signal"]:
        """Its variance by photon and read noise, for these mean images."""
        ...


class NormalisedCounts(eqx.Module):
    """Counts of each pixel over those of all.

    Attributes:
        pixels: Numbers of the pixels in use.

    Examples:
        >>> images = jnp.array([[[4.0, 3.0], [0.0, 1.0]]])
        >>> counts = NormalisedCounts.of_light(images)
        >>> counts.of(images, images >= 0).tolist()
        [0.5, 0.375, 0.125]
    """

    pixels: Int[np.ndarray | Array, " signal"]

    @classmethod
    def of_light(cls, mean: Float[Array | np.ndarray, "plane v u"]) -> "NormalisedCounts":
        """The pixels that light falls on."""
        return cls(np.flatnonzero(lit_pixels(np.asarray(mean, float))))

    def of(self, electrons: Float[Array, "plane v u"], usable: Bool[Array, "plane v u"]) -> Float[Array, " signal"]:
        """See `ImageSignal`."""
        seen = jnp.where(usable, electrons, 0).ravel()[jnp.asarray(self.pixels)]
        total = jnp.sum(seen)
        return seen / jnp.where(total > 0, total, 1)

    def variance(self, electrons: Float[np.ndarray, "plane v u"], read_variance: float) -> Float[np.ndarray, " signal"]:
        """See `ImageSignal`."""
        seen = np.asarray(electrons, float).ravel()[np.asarray(self.pixels)]
        return (seen + read_variance) / np.sum(seen) ** 2


class NormalisedDifferences(eqx.Module):
    """Curvature as its sensors take it: (I+ - I-) / (I+ + I-) of each pixel, planes in pairs at +z and -z.

    One electron and the read noise are added to the sum, so that a pixel without light says nothing.

    Attributes:
        after: Numbers of the planes downstream ...
        before: ... and of those at the same distance upstream.
        pixels: Numbers of the pixels in use, among all of all pairs.
        darkness: Electrons added to the sum.

    Examples:
        >>> images = jnp.array([[[30.0]], [[9.0]]])
        >>> curvature = NormalisedDifferences.of_light(images, (1e6, -1e6), read_variance=0.0)
        >>> bool(jnp.allclose(curvature.of(images, images >= 0), 21 / 40))  # 21 of 39 and one
        True
    """

    after: tuple[int, ...] = eqx.field(static=True)
    before: tuple[int, ...] = eqx.field(static=True)
    pixels: Int[np.ndarray | Array, " signal"]
    darkness: float = eqx.field(static=True)

    @classmethod
    def of_light(
        cls, mean: Float[Array | np.ndarray, "plane v u"], distances_m: tuple[float, ...], *, read_variance: float
    ) -> "NormalisedDifferences":
        """The pixels that light falls on.

        Raises:
            SettingsError: If the planes are not pairs.
        """
        after = tuple(place for place, distance_m in enumerate(distances_m) if distance_m > 0)
        if sorted(distances_m) != sorted(sign * distances_m[place] for place in after for sign in (1, -1)):
            told = [round(1e-3 * distance_m, 3) for distance_m in distances_m]
            raise SettingsError("linear_curvature.distances_km", "must be pairs, at +z and at -z", told)
        before = tuple(distances_m.index(-distances_m[place]) for place in after)
        both = np.asarray(mean, float)[list(after)] + np.asarray(mean, float)[list(before)]
        return cls(after, before, np.flatnonzero(lit_pixels(both)), 1.0 + read_variance)

    def of(self, electrons: Float[Array, "plane v u"], usable: Bool[Array, "plane v u"]) -> Float[Array, " signal"]:
        """See `ImageSignal`."""
        pixels, after, before = jnp.asarray(self.pixels), list(self.after), list(self.before)
        seen = jnp.where(usable, electrons, 0)
        difference = (seen[jnp.array(after)] - seen[jnp.array(before)]).ravel()[pixels]
        total = (seen[jnp.array(after)] + seen[jnp.array(before)]).ravel()[pixels]
        read = (usable[jnp.array(after)] & usable[jnp.array(before)]).ravel()[pixels]
        return jnp.where(read, difference / jnp.maximum(total + self.darkness, self.darkness), 0)

    def variance(self, electrons: Float[np.ndarray, "plane v u"], read_variance: float) -> Float[np.ndarray, " signal"]:
        """See `ImageSignal`; that of a binomial share of the mean sum."""
        seen = np.asarray(electrons, float)
        after, before = seen[list(self.after)].ravel()[self.pixels], seen[list(self.before)].ravel()[self.pixels]
        total = after + before
        share = (after - before) / np.maximum(total, np.finfo(float).tiny)
        return (total * (1 - share**2) + 2 * read_variance) / (total + self.darkness) ** 2


def lit_pixels(mean: Float[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """The brightest pixels, with `LIT_SHARE` of the light.

    Examples:
        >>> lit_pixels(np.array([[600.0, 399.5], [0.0, 0.5]])).tolist()
        [[True, True], [False, False]]
    """
    falling = np.sort(mean.ravel())[::-1]
    enough = int(np.searchsorted(np.cumsum(falling), LIT_SHARE * np.sum(mean)))
    return (mean >= falling[min(enough, falling.size - 1)]) & (mean > 0)
