"""The pixels of the detector: light on a fine, wide grid is summed over their areas, in a finite window."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.errors import SamplingError, SettingsError


def integrate_on_pixels(
    photon_rate: Float[Array, "plane y x"], *, factor: int, window: tuple[int, int]
) -> Float[Array, "plane window_y window_x"]:
    """Sum the light of a fine grid over the pixels of a window around the optical axis.

    Grid and window share their centre, for odd and even sizes alike. Where their parities differ, an edge of
    a pixel falls inside a fine pixel, whose light is then shared in halves: light counts as uniform within a
    fine pixel. Light outside the window is lost, see `fraction_outside_window`; a window wider than the grid
    sees darkness there.

    Args:
        photon_rate: Photons on every fine pixel (a sum over its area, not a density), or any other additive
            quantity.
        factor: Number of fine pixels along a side of a detector pixel.
        window: Number of detector pixels along y and along x.

    Returns:
        Photons on every detector pixel, in the unit of the input.

    Raises:
        SamplingError: If a detector pixel is not made of a whole number of fine pixels.
        SettingsError: If the window has no pixels.

    Examples:
        >>> rate = jnp.ones((1, 6, 6))
        >>> integrate_on_pixels(rate, factor=2, window=(2, 2))
        Array([[[4., 4.],
                [4., 4.]]], dtype=...)
        >>> float(integrate_on_pixels(rate, factor=3, window=(5, 5)).sum())
        36.0
    """
    _check_geometry("integrate_on_pixels", factor, window)
    light = photon_rate
    for axis, count in zip((1, 2), window, strict=True):
        light = _integrate_along(light, axis, factor, count)
    return light


def fraction_outside_window(
    photon_rate: Float[Array, "plane y x"], *, factor: int, window: tuple[int, int]
) -> Float[Array, " plane"]:
    """Fraction of each plane's light that `integrate_on_pixels` loses outside its window.

    The lost light itself is summed, not the difference of two totals, so that a loss of 1e-9 survives
    float32.

    Args:
        photon_rate: Photons on every fine pixel.
        factor: Number of fine pixels along a side of a detector pixel.
        window: Number of detector pixels along y and along x.

    Returns:
        From 0, nothing is lost, to 1; 0 for a dark plane.

    Raises:
        SamplingError: If a detector pixel is not made of a whole number of fine pixels.
        SettingsError: If the window has no pixels.

    Examples:
        >>> fraction_outside_window(jnp.ones((1, 4, 4)), factor=1, window=(2, 4))
        Array([0.5], dtype=...)
    """
    _check_geometry("fraction_outside_window", factor, window)
    inside_y, inside_x = (
        _fraction_inside(size, count * factor) for size, count in zip(photon_rate.shape[1:], window, strict=True)
    )
    outside = jnp.asarray(1 - inside_y[:, None] * inside_x[None, :], photon_rate.dtype)
    lost = jnp.sum(photon_rate * outside[None], axis=(1, 2))
    total = jnp.sum(photon_rate, axis=(1, 2))
    return jnp.where(total > 0, lost / jnp.where(total > 0, total, 1.0), 0.0)


def _check_geometry(where: str, factor: int, window: tuple[int, int]) -> None:
    if factor < 1 or factor != int(factor):
        raise SamplingError(f"{where}.factor", "must be a whole number of fine pixels, at least one", factor)
    if min(window) < 1:
        raise SettingsError(f"{where}.window", "must be at least one pixel along each axis", window)


def _integrate_along(
    light: Float[Array, "plane y x"], axis: int, factor: int, count: int
) -> Float[Array, "plane wy wx"]:
    wanted = count * factor
    if (light.shape[axis] - wanted) % 2:
        light = _shift_half_a_fine_pixel(light, axis)
    light = _fit_to(light, axis, wanted)
    split = (*light.shape[:axis], count, factor, *light.shape[axis + 1 :])
    return jnp.sum(light.reshape(split), axis=axis + 1)


def _shift_half_a_fine_pixel(light: Float[Array, "plane y x"], axis: int) -> Float[Array, "plane wy wx"]:
    """Resample on one pixel more with the same centre, by giving half of each pixel to either side."""
    padded = _fit_to(light, axis, light.shape[axis] + 2)
    size = padded.shape[axis]
    before = jnp.take(padded, np.arange(size - 1), axis=axis)
    after = jnp.take(padded, np.arange(1, size), axis=axis)
    return (before + after) / 2


def _fit_to(light: Float[Array, "plane y x"], axis: int, size: int) -> Float[Array, "plane wy wx"]:
    """Cut or pad by the same number of pixels on both sides."""
    margin = (size - light.shape[axis]) // 2
    if margin < 0:
        return jnp.take(light, np.arange(-margin, -margin + size), axis=axis)
    return jnp.pad(light, [(margin, margin) if i == axis else (0, 0) for i in range(light.ndim)])


def _fraction_inside(size: int, window: int) -> Float[np.ndarray, " size"]:
    """Part of every fine pixel that lies within the window, both centred."""
    left = np.arange(size) - size / 2
    return np.clip(np.minimum(left + 1, window / 2) - np.maximum(left, -window / 2), 0, 1)
