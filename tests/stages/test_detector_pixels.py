"""Light on a fine grid falls on the pixels of a window; expected numbers come from overlaps of intervals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.detector.pixels import fraction_outside_window, integrate_on_pixels
from nlcwfs.errors import SamplingError, SettingsError

integrate = jax.jit(integrate_on_pixels, static_argnames=("factor", "window"))  # one compilation, not ten
outside = jax.jit(fraction_outside_window, static_argnames=("factor", "window"))


def overlaps(pixels, factor, size):
    """Length shared by every detector pixel and every fine pixel, both rows centred on zero."""
    left_pixel = (np.arange(pixels)[:, None] - pixels / 2) * factor
    left_fine = np.arange(size)[None, :] - size / 2
    shared = np.minimum(left_pixel + factor, left_fine + 1) - np.maximum(left_pixel, left_fine)
    return np.maximum(shared, 0)


GEOMETRIES = [  # shape of the fine grid, factor, window: every pair of parities, window inside and outside
    ((12, 18), 3, (4, 6)),
    ((12, 18), 3, (3, 5)),
    ((13, 10), 2, (4, 3)),
    ((9, 14), 2, (7, 9)),
    ((7, 8), 1, (4, 11)),
    ((5, 6), 4, (1, 2)),
    ((5, 6), 4, (3, 1)),
]


@pytest.mark.parametrize(("shape", "factor", "window"), GEOMETRIES)
def test_a_pixel_gets_the_light_that_falls_on_its_area(shape, factor, window):
    light = np.random.default_rng(1).random((2, *shape))
    expected = overlaps(window[0], factor, shape[0]) @ light @ overlaps(window[1], factor, shape[1]).T
    pixels = integrate(jnp.asarray(light), factor=factor, window=window)
    np.testing.assert_allclose(pixels, expected, atol=1e-13)  # rounding of sums of some 20 numbers below 1


@pytest.mark.parametrize(("shape", "factor", "window"), GEOMETRIES)
def test_the_adjoint_spreads_each_pixel_over_its_area(shape, factor, window):
    image = np.random.default_rng(2).random((1, *window))

    def forward(light):
        return integrate(light, factor=factor, window=window)

    (spread,) = jax.linear_transpose(forward, jnp.zeros((1, *shape)))(jnp.asarray(image))
    expected = overlaps(window[0], factor, shape[0]).T @ image @ overlaps(window[1], factor, shape[1])
    np.testing.assert_allclose(spread, expected, atol=1e-13)  # rounding


@pytest.mark.parametrize(("shape", "factor", "window"), GEOMETRIES)
def test_lost_light_is_what_no_pixel_gets(shape, factor, window):
    light = np.random.default_rng(3).random((2, *shape))
    inside = overlaps(window[0], factor, shape[0]) @ light @ overlaps(window[1], factor, shape[1]).T
    expected = 1 - inside.sum(axis=(1, 2)) / light.sum(axis=(1, 2))
    lost = outside(jnp.asarray(light), factor=factor, window=window)
    np.testing.assert_allclose(lost, expected, atol=1e-14)  # rounding of the difference above


def test_a_loss_of_a_billionth_is_seen_in_float32():
    light = jnp.zeros((1, 6, 6), jnp.float32).at[0, 2, 3].set(1.0).at[0, 0, 0].set(1e-9)
    lost = outside(light, factor=2, window=(2, 2))
    np.testing.assert_allclose(lost, [1e-9], rtol=1e-6)  # rounding of float32


def test_a_dark_plane_loses_nothing():
    assert float(fraction_outside_window(jnp.zeros((1, 4, 4)), factor=2, window=(1, 1))[0]) == 0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_precision_of_the_light_is_kept(dtype):
    light = jnp.ones((1, 5, 5), dtype)
    assert integrate_on_pixels(light, factor=2, window=(2, 2)).dtype == dtype
    assert fraction_outside_window(light, factor=2, window=(2, 2)).dtype == dtype


@pytest.mark.parametrize("function", [integrate_on_pixels, fraction_outside_window])
def test_impossible_pixels_are_refused(function):
    light = jnp.ones((1, 4, 4))
    with pytest.raises(SamplingError, match=r"\.factor: must be a whole number of fine pixels.*got 0"):
        function(light, factor=0, window=(2, 2))
    with pytest.raises(SettingsError, match=r"\.window: must be at least one pixel.*got \(0, 2\)"):
        function(light, factor=1, window=(0, 2))
