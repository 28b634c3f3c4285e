"""The forward model as a caller meets it: refusals, centring, precision, jit and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor, centred_in
from nlcwfs.errors import SettingsError

SHARES_RULE = "curvature_sensor.flux_fractions: must be one per plane, positive, sum 1"
GREEN = Spectrum.monochromatic(0.65e-6)
RAINBOW = Spectrum((0.68e-6, 0.85e-6, 1.02e-6), (0.2, 0.5, 0.3))
DISTANCES_M = (-3.5e6, -2.5e6, 2.5e6, 3.5e6)


def asymmetric_pupil(shape: tuple[int, int]) -> np.ndarray:
    rng = np.random.default_rng(5)
    return rng.uniform(0.2, 1, shape) * (rng.uniform(size=shape) > 0.2)


def random_opd(shape: tuple[int, int], seed: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=300e-9, size=shape)


def build(pupil=None, grid=None, *, distances_m=DISTANCES_M, spectrum=GREEN, dtype="float64", **options):
    pupil = asymmetric_pupil((20, 23)) if pupil is None else pupil
    grid = Grid((32, 35), 0.3) if grid is None else grid
    return CurvatureSensor.build(pupil, grid, distances_m=distances_m, spectrum=spectrum, dtype=dtype, **options)


# ----------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distances_m": ()}, "curvature_sensor.distances_m: must be finite, at least one, got ()"),
        (
            {"distances_m": (1e6, float("nan"))},
            "curvature_sensor.distances_m: must be finite, at least one, got (1000000.0, nan)",
        ),
        (
            {"distances_m": (float("inf"), 1e6)},
            "curvature_sensor.distances_m: must be finite, at least one, got (inf, 1000000.0)",
        ),
        (
            {"flux_fractions": (0.5, 0.5)},
            f"{SHARES_RULE}, got [0.5 0.5]",
        ),
        (
            {"flux_fractions": (0.5, 0.5, 1.0, -1.0)},
            f"{SHARES_RULE}, got [ 0.5  0.5  1.  -1. ]",
        ),
        (
            {"flux_fractions": (0.3, 0.3, 0.3, 0.3)},
            f"{SHARES_RULE}, got [0.3 0.3 0.3 0.3]",
        ),
        (
            {"flux_fractions": (0.5, float("nan"), 0.2, 0.3)},
            f"{SHARES_RULE}, got [0.5 nan 0.2 0.3]",
        ),
        ({"pupil": np.zeros((20, 23))}, "pupil: must let some light through, got zeros everywhere"),
        (
            {"grid": Grid((18, 35), 0.3)},
            "grid.shape: must exceed the pupil's (20, 23) by an even number of pixels, got (18, 35)",
        ),
        (
            {"grid": Grid((32, 36), 0.3)},
            "grid.shape: must exceed the pupil's (20, 23) by an even number of pixels, got (32, 36)",
        ),
    ],
)
def test_contradictions_are_refused_with_their_key_rule_and_value(options, message):
    with pytest.raises(SettingsError) as refusal:
        build(**options)
    assert str(refusal.value) == message


@pytest.mark.parametrize("hole", [np.nan, np.inf])
def test_a_pupil_that_is_not_a_number_is_refused(hole):
    pupil = asymmetric_pupil((20, 23))
    pupil[3, 4] = hole
    with pytest.raises(SettingsError, match=r"^pupil: must be finite, got 1 pixels that are not$"):
        build(pupil)


# ------------------------------------------------------------------------------------------------ centring


@pytest.mark.parametrize(("inner", "outer"), [((3, 4), (7, 10)), ((4, 3), (4, 9)), ((2, 5), (8, 5))])
def test_a_small_map_lies_in_the_middle_of_a_wide_grid(inner, outer):
    small = np.random.default_rng(1).normal(size=inner)
    wide = centred_in(small, outer)
    pixel_m = 0.5
    small_grid, wide_grid = Grid(inner, pixel_m), Grid(outer, pixel_m)
    assert wide.shape == outer
    assert wide.sum() == pytest.approx(small.sum(), abs=1e-14)
    # Every value keeps its place in metres.
    for row, y_m in enumerate(small_grid.y_m[:, 0]):
        for column, x_m in enumerate(small_grid.x_m[0]):
            there = np.argmin(abs(wide_grid.y_m[:, 0] - y_m)), np.argmin(abs(wide_grid.x_m[0] - x_m))
            assert wide[there] == small[row, column]


@pytest.mark.parametrize("outer", [(8, 10), (7, 9), (2, 10), (7, 2)])
def test_a_map_that_cannot_share_its_centre_is_refused(outer):
    with pytest.raises(SettingsError, match=r"^grid\.shape: must exceed the pupil's \(3, 4\) by an even number"):
        centred_in(np.ones((3, 4)), outer)


def test_a_wider_pupil_array_of_zeros_changes_nothing():
    pupil, static_m, opd_m = (
        asymmetric_pupil((20, 23)),
        random_opd((20, 23), 8),
        jnp.asarray(random_opd((32, 35))),
    )
    padding = [(6, 6), (6, 6)]
    small = build(pupil, static_opd_m=static_m).images(opd_m, 1e4)
    wide = build(np.pad(pupil, padding), static_opd_m=np.pad(static_m, padding)).images(opd_m, 1e4)
    np.testing.assert_array_equal(small.photons, wide.photons)


# ------------------------------------------------------------------------------------- precision and speed


@pytest.mark.parametrize("spectrum", [GREEN, RAINBOW])
def test_single_precision_agrees_within_its_rounding(spectrum):
    opd_m, static_m = random_opd((32, 35)), random_opd((20, 23), 8)
    options = {"spectrum": spectrum, "static_opd_m": static_m, "flux_fractions": (0.1, 0.2, 0.3, 0.4)}
    double = np.asarray(build(**options).images(jnp.asarray(opd_m), 2e4).photons)
    single = build(**options, dtype="float32").images(jnp.asarray(opd_m, jnp.float32), 2e4)
    assert single.photons.dtype == np.float32
    # Phases of 10 rad rounded to 6e-8 cost 6e-7 of the amplitude, the FFTs some 1e-7: twice that in
    # intensity, and a few sigma over the pixels.
    np.testing.assert_allclose(single.photons, double, atol=5e-6 * double.max(), rtol=0)


def test_numbers_from_numpy_serve_as_well_as_pythons():
    colours = Spectrum(tuple(np.array([0.68e-6, 1.02e-6])), tuple(np.array([0.4, 0.6])))
    opd_m = random_opd((32, 35))
    single = build(spectrum=colours, dtype="float32").images(jnp.asarray(opd_m, jnp.float32), 2e4).photons
    python = build(spectrum=Spectrum((0.68e-6, 1.02e-6), (0.4, 0.6))).images(jnp.asarray(opd_m), 2e4).photons
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, python, atol=5e-6 * float(python.max()), rtol=0)  # as above


def test_compiled_and_batched_images_are_the_same():
    sensor = build(spectrum=RAINBOW)
    opds_m = jnp.asarray(np.stack([random_opd((32, 35), seed) for seed in (1, 2, 3)]))
    photons = jnp.asarray([1.0, 2e4, 3e6])
    one_by_one = np.stack([sensor.images(opd, rate).photons for opd, rate in zip(opds_m, photons, strict=True)])
    scale = np.asarray(photons)[:, None, None, None]

    compiled = jax.jit(lambda sensor, opd, rate: sensor.images(opd, rate).photons)
    jitted = np.stack([compiled(sensor, opd, rate) for opd, rate in zip(opds_m, photons, strict=True)])
    batched = jax.vmap(lambda opd, rate: sensor.images(opd, rate).photons)(opds_m, photons)
    # The compiler may order sums otherwise: rounding.
    np.testing.assert_allclose(jitted / scale, one_by_one / scale, atol=1e-14)
    np.testing.assert_allclose(batched / scale, one_by_one / scale, atol=1e-14)


def test_planes_keep_their_order_and_their_share():
    order = [2, 0, 3, 1]
    fractions = np.array([0.1, 0.2, 0.3, 0.4])
    opd_m = jnp.asarray(random_opd((32, 35)))
    images = np.asarray(build(flux_fractions=tuple(fractions)).images(opd_m, 100.0).photons)
    shuffled = build(distances_m=tuple(DISTANCES_M[i] for i in order), flux_fractions=tuple(fractions[order])).images(
        opd_m, 100.0
    )
    np.testing.assert_allclose(shuffled.photons, images[order], atol=1e-13)  # rounding of 100 photons
    assert shuffled.pixel_m == 0.3
    equal = np.asarray(build().images(opd_m, 100.0).photons)
    np.testing.assert_allclose(equal * 4 * fractions[:, None, None], images, atol=1e-13)


def test_a_plane_at_the_pupil_shows_the_pupil():
    sensor = build(distances_m=(0.0,))
    image = sensor.images(jnp.asarray(random_opd((32, 35))), 100.0).photons[0]
    expected = np.pad(asymmetric_pupil((20, 23)) ** 2, 6)
    np.testing.assert_allclose(image, 100 * expected / expected.sum(), atol=1e-13)  # rounding
