"""The mean counts of the sensor's pixels for a phase, with the gain and background of each plane."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.estimation.gerchberg_saxton import pupil_light
from nlcwfs.estimation.resolution_level import Level, Measurement


class PlaneScale(NamedTuple):
    """How the light of each plane becomes counts.

    Attributes:
        counts: Counts of the whole plane, its dark rim included, if the background is nothing.
        background: Counts of every pixel without light.
    """

    counts: Float[Array, "plane 1 1"]
    background: Float[Array, "plane 1 1"]


def light_on_pixels(level: Level, phase_rad: Float[Array, "y x"]) -> Float[Array, "plane v u"]:
    """Light of unit power at the pupil, on the measured pixels of every plane; `planes + 1` FFTs for each colour.

    The phase is that of the wavelength at which the sensor works; other colours see the same path.
    """
    colours, planes = level.colours, level.optics.transfer.shape[1]
    if colours is not None:
        opd_m = phase_rad * (level.optics.spectrum.wavelengths_m[0] / (2 * np.pi))
        return level.on_pixels(planes * colours.images(opd_m, 1.0).photons)
    near = pupil_light(level, phase_rad)
    far = jnp.fft.ifft2(jnp.fft.fft2(near)[None] * level.optics.transfer[0])
    return level.on_pixels(far.real**2 + far.imag**2)


def plane_scale(
    light: Float[Array, "plane v u"],
    measured: Measurement,
    *,
    fits_background: bool,
    shares: Float[Array, " plane"] | None = None,
) -> PlaneScale:
    """Gain and background of each plane, from the counts.

    Without a background the counts of the plane are those measured, over the share of its light that falls on usable
    pixels. With it, a straight line of counts against light, weighted by 1 / (light + mean).

    Args:
        light: See `light_on_pixels`.
        measured: The counts.
        fits_background: Whether pixels without light may have counts.
        shares: Share of the light of each plane, when it is to be taken as known; measured when left out.
    """
    usable = measured.usable.astype(light.dtype)
    counts = jnp.where(measured.usable, measured.counts, 0)
    total = jnp.sum(counts, axis=(1, 2), keepdims=True)
    seen = jnp.sum(usable * light, axis=(1, 2), keepdims=True)
    tiny = jnp.finfo(light.dtype).tiny
    if not fits_background:
        gain, background = total / jnp.maximum(seen, tiny), jnp.zeros_like(total)
    else:
        weight = usable / (light + seen / jnp.maximum(jnp.sum(usable, axis=(1, 2), keepdims=True), 1))
        norm = jnp.maximum(jnp.sum(weight, axis=(1, 2), keepdims=True), tiny)
        mean = jnp.sum(weight * light, axis=(1, 2), keepdims=True) / norm
        spread = jnp.sum(weight * (light - mean) ** 2, axis=(1, 2), keepdims=True)
        gain = jnp.sum(weight * (light - mean) * counts, axis=(1, 2), keepdims=True) / jnp.maximum(spread, tiny)
        gain = jnp.maximum(gain, 0)
        background = jnp.sum(weight * counts, axis=(1, 2), keepdims=True) / norm - gain * mean
    if shares is not None:
        gain = shares[:, None, None] * jnp.sum(gain)
    return PlaneScale(gain, background)


def mean_counts(level: Level, scale: PlaneScale, phase_rad: Float[Array, "*both y x"]) -> Float[Array, "plane v u"]:
    """What the measured pixels count on average, for a phase, or for a `ComplexPhase`."""
    if phase_rad.ndim == 3:
        level, phase_rad = level.twinkling(phase_rad[1]), phase_rad[0]
    return scale.counts * light_on_pixels(level, phase_rad) + scale.background
