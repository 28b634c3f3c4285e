"""Laws of the detector for random sizes, lights and cameras."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from nlcwfs.detector import Detector, DetectorSettings, fraction_outside_window, integrate_on_pixels

seeds = st.integers(0, 2**31 - 1)
sizes = st.integers(1, 13)
few = settings(max_examples=12, deadline=None)  # every new shape compiles
integrate = jax.jit(integrate_on_pixels, static_argnames=("factor", "window"))
outside = jax.jit(fraction_outside_window, static_argnames=("factor", "window"))


def random_light(seed, *shape):
    return np.random.default_rng(seed).gamma(0.5, 100.0, shape)


@few
@given(seeds, sizes, sizes, st.integers(1, 4), sizes, sizes)
def test_light_is_on_a_pixel_or_lost(seed, ny, nx, factor, wy, wx):
    light = jnp.asarray(random_light(seed, 2, ny, nx))
    pixels = integrate(light, factor=factor, window=(wy, wx))
    lost = outside(light, factor=factor, window=(wy, wx))
    total = np.asarray(light).sum(axis=(1, 2))
    np.testing.assert_allclose(pixels.sum(axis=(1, 2)) + lost * total, total, rtol=1e-13)  # rounding of sums


@few
@given(seeds, sizes, sizes, st.integers(1, 4), st.integers(0, 3), st.integers(0, 3))
def test_a_window_around_all_light_loses_nothing(seed, ny, nx, factor, more_y, more_x):
    light = jnp.asarray(random_light(seed, 1, ny, nx))
    window = (-(-ny // factor) + more_y, -(-nx // factor) + more_x)
    pixels = integrate(light, factor=factor, window=window)
    np.testing.assert_allclose(pixels.sum(), np.asarray(light).sum(), rtol=1e-13)  # rounding of sums
    assert float(outside(light, factor=factor, window=window)[0]) == 0


@few
@given(
    seeds,
    st.integers(4, 9),
    st.integers(4, 9),
    st.integers(1, 4),
    st.sampled_from([(1, 0), (0, -1), (-1, 1)]),
)
def test_light_moved_by_one_detector_pixel_moves_the_image_by_one(seed, ny, nx, factor, move):
    border = 2 * factor
    light = np.pad(random_light(seed, 1, ny, nx), ((0, 0), (border, border), (border, border)))
    moved = np.roll(light, (move[0] * factor, move[1] * factor), axis=(1, 2))
    window = (-(-light.shape[1] // factor) + 1, -(-light.shape[2] // factor) + 1)
    image = integrate(jnp.asarray(light), factor=factor, window=window)
    image_moved = integrate(jnp.asarray(moved), factor=factor, window=window)
    np.testing.assert_allclose(image_moved, np.roll(image, move, axis=(1, 2)), atol=1e-10)  # rounding of 1e3


@few
@given(seeds, st.floats(1, 300), st.floats(1, 300))
def test_a_deeper_well_never_saturates_more(seed, one_well, other_well):
    light = jnp.asarray(random_light(seed, 2, 5, 7))
    shallow, deep = (
        Detector(DetectorSettings(full_well_electrons=well)).read(light, jax.random.key(seed))
        for well in sorted((one_well, other_well))
    )
    assert not np.any(np.asarray(deep.saturated) & ~np.asarray(shallow.saturated))
    assert np.all(np.asarray(shallow.electrons) <= np.asarray(deep.electrons))
    assert float(shallow.electrons.max()) <= min(one_well, other_well)


@few
@given(seeds, st.floats(1, 50))
def test_brighter_light_never_saturates_a_converter_less(seed, brighter):
    light = jnp.asarray(random_light(seed, 2, 5, 7))
    # The converter alone, without photon noise; its highest code stands for (255 - 20) * 2 electrons.
    camera = Detector(DetectorSettings(bits=8, bias_adu=20, gain_electrons_per_adu=2))
    faint, bright = camera.to_adu(light), camera.to_adu(brighter * light)
    assert np.all(np.asarray(bright) >= np.asarray(faint))
    np.testing.assert_array_equal(np.asarray(faint) == 255, np.round(np.asarray(light) / 2 + 20) >= 255)


@few
@given(seeds, st.floats(0.05, 50), st.sampled_from([1.0, 30.0, 600.0]), st.floats(0, 500))
def test_rounding_errs_by_half_a_step_at_most(seed, step, em_gain, bias_adu):
    settings = DetectorSettings(bits=16, gain_electrons_per_adu=step, em_gain=em_gain, bias_adu=bias_adu)
    camera = Detector(settings)
    span = (2**16 - 1 - bias_adu) * step / em_gain
    electrons = np.random.default_rng(seed).uniform(-bias_adu * step / em_gain, span, 200)
    back = camera.to_electrons(camera.to_adu(jnp.asarray(electrons)))
    half_step = step / em_gain / 2
    errors = np.abs(np.asarray(back) - electrons)
    assert errors.max() <= half_step * (1 + 1e-9)  # rounding of 65535 steps
    assert errors.max() >= 0.8 * half_step  # 200 uniform errors: all below 0.8 once in 1e19


@few
@given(
    st.floats(0.05, 50),
    st.floats(1, 1000),
    st.floats(0, 500),
    st.integers(10, 20),
    st.sampled_from(["f4", "f8"]),
)
def test_every_code_survives_electrons_and_back(step, em_gain, bias_adu, bits, dtype):
    camera = Detector(DetectorSettings(bits=bits, gain_electrons_per_adu=step, em_gain=em_gain, bias_adu=bias_adu))
    codes = np.linspace(0, 2**bits - 1, 999).round()
    back = camera.to_adu(camera.to_electrons(jnp.asarray(codes, dtype)))
    np.testing.assert_array_equal(back, codes)


def test_planes_are_read_with_independent_noise():
    camera = Detector(DetectorSettings(preset="EMCCD"))
    a, b = camera.read(jnp.full((2, 100, 650), 20.0), jax.random.key(1)).electrons
    assert abs(np.corrcoef(np.ravel(a), np.ravel(b))[0, 1]) < 0.02  # 5 sigma of 6.5e4 pairs
