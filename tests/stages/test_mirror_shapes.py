"""The mirror: what it is told it does, the right way round, and its fit is the best there is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import Spiders, circular_pupil, pupil_of_discs
from nlcwfs.beam.zernike import zernike
from nlcwfs.config_messages import problems_in_words
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.mirror.mirror import WORTH_FITTING, Mirror
from nlcwfs.mirror.settings import MirrorSettings

DIAMETER_M = 8.0
GRID = Grid((38, 43), 0.22)  # neither square nor symmetric about a pixel in both axes
PUPIL = circular_pupil(GRID, diameter_m=DIAMETER_M, obstruction_ratio=0.3, spiders=Spiders((10.0, 130.0), 0.2))
SEEN = np.where(PUPIL < 0.1, 0, PUPIL) ** 2
WEIGHTS = SEEN / SEEN.sum()
KINDS = {
    "karhunen-loeve": MirrorSettings(cutoff_cpa=6.0),
    "zernike": MirrorSettings(kind="zernike", cutoff_cpa=6.0),
    "fourier": MirrorSettings(kind="fourier", cutoff_cpa=6.0),
    "actuators": MirrorSettings(kind="actuators", actuators_across=13),
}


@pytest.fixture(scope="module", params=list(KINDS))
def mirror(request):
    return Mirror.build(KINDS[request.param], PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")


def rough(seed):
    """A wavefront without symmetry, of many frequencies, in metres."""
    rng = np.random.default_rng(seed)
    steps = np.arange(-7, 8)
    v, u = np.meshgrid(steps, steps)
    waves = np.exp(2j * np.pi / 9.3 * (v[..., None, None] * GRID.y_m + u[..., None, None] * GRID.x_m))
    amplitude = rng.normal(size=(2, *v.shape)) / (1 + np.hypot(v, u)) ** 2
    return 1e-6 * np.einsum("vu,vuyx->yx", amplitude[0] + 1j * amplitude[1], waves).real


def images(mirror):
    """Every shape of the mirror as it comes out of it, seen on the light: pixel by mode, times root of the weight."""
    stack = np.stack([np.asarray(mirror.opd_m(unit)) for unit in np.eye(mirror.count)])
    seen = WEIGHTS > 0
    return (stack[:, seen] * np.sqrt(WEIGHTS[seen])).T


def test_a_fit_after_a_shape_is_the_command_that_made_it(mirror):
    """Where commands are redundant it is their part that the light can tell, which a second turn leaves alone."""
    command_m = 1e-7 * np.random.default_rng(1).normal(size=mirror.count)
    found_m = np.asarray(mirror.fitted(mirror.opd_m(command_m)))
    if mirror.rank < mirror.count:
        once_m, found_m = found_m, np.asarray(mirror.fitted(mirror.opd_m(found_m)))
        assert np.linalg.norm(once_m - command_m) > 0.1 * np.linalg.norm(command_m)  # they are redundant
        command_m = once_m
    np.testing.assert_allclose(found_m, command_m, atol=1e-18)  # rounding, times the condition of at most 20


def test_the_fit_is_that_of_numpy_with_the_same_truncation(mirror):
    opd_m = rough(2)
    seen = WEIGHTS > 0
    columns = images(mirror)
    right = np.sqrt(WEIGHTS[seen]) * (opd_m[seen] - np.sum(WEIGHTS * opd_m))
    best_m, _, rank, singular = np.linalg.lstsq(columns, right, rcond=WORTH_FITTING)
    assert rank == mirror.rank
    assert mirror.condition == pytest.approx(singular[0] / singular[rank - 1], rel=1e-6)
    # 1e-6: normal equations square a condition of at most 20, shapes are of order 1e-6 m.
    np.testing.assert_allclose(mirror.fitted(opd_m), best_m, atol=1e-6 * np.abs(best_m).max())


@pytest.mark.parametrize("kind", ["karhunen-loeve", "zernike"])
def test_ideal_modes_are_orthonormal_so_a_command_is_an_rms(kind):
    mirror = Mirror.build(KINDS[kind], PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")
    columns = images(mirror)
    np.testing.assert_allclose(columns.T @ columns, np.eye(mirror.count), atol=1e-11)  # rounding
    assert mirror.condition == 1
    assert mirror.rank == mirror.count


def test_no_shape_makes_piston_and_no_fit_sees_it(mirror):
    shapes = np.stack([np.asarray(mirror.opd_m(unit)) for unit in np.eye(mirror.count)])
    np.testing.assert_allclose(np.sum(shapes * WEIGHTS, axis=(1, 2)), 0, atol=1e-12)
    opd_m = rough(3)
    np.testing.assert_allclose(mirror.fitted(opd_m + 1e-5), mirror.fitted(opd_m), atol=1e-17)


def test_what_lies_outside_the_pupil_is_not_looked_at_and_not_moved(mirror):
    opd_m = rough(4)
    marked_m = np.where(PUPIL > 0, opd_m, np.nan)
    np.testing.assert_array_equal(mirror.fitted(marked_m), mirror.fitted(opd_m))
    shape_m = np.asarray(mirror.opd_m(mirror.fitted(opd_m)))
    assert not shape_m[PUPIL == 0].any()
    assert shape_m[PUPIL > 0].all()  # dim pixels of the rim move with their neighbours
    left_m = np.where(PUPIL > 0, opd_m - np.sum(WEIGHTS * opd_m) - shape_m, 0)
    assert np.abs(left_m).max() < 0.5 * np.abs(opd_m).max()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("kind", list(KINDS))
def test_a_positive_tilt_raises_the_path_towards_plus_x_and_plus_y(kind, axis):
    mirror = Mirror.build(KINDS[kind], PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")
    slope = 1e-7 * np.broadcast_to((GRID.y_m, GRID.x_m)[axis], GRID.shape)
    made_m = np.asarray(mirror.opd_m(mirror.fitted(slope)))
    expected_m = slope - np.sum(WEIGHTS * slope)
    error_m = np.sqrt(np.sum(WEIGHTS * (made_m - expected_m) ** 2))
    assert error_m < 0.03 * np.sqrt(np.sum(WEIGHTS * expected_m**2))  # actuators leave a ripple of 1 or 2 %
    if kind in ("zernike", "fourier"):  # whose first command is tilt along x, the second along y
        command_m = np.eye(mirror.count)[1 - axis]
        assert np.sum(WEIGHTS * np.asarray(mirror.opd_m(command_m)) * slope) > 0


def test_zernikes_on_a_clear_disc_are_those_of_the_books():
    grid = Grid((121, 124), 0.067)
    pupil = circular_pupil(grid, diameter_m=DIAMETER_M)
    mirror = Mirror.build(MirrorSettings(kind="zernike", modes=20), pupil, grid, diameter_m=DIAMETER_M)
    light = pupil**2 / np.sum(pupil**2)
    for place, noll in [(0, 2), (1, 3), (2, 4), (5, 7), (9, 11), (19, 21)]:
        made = np.asarray(mirror.opd_m(np.eye(20)[place]))
        same = np.sum(light * made * zernike(noll, grid, diameter_m=DIAMETER_M))
        assert same == pytest.approx(1, abs=0.02)  # the light of rim pixels counts by the square of their area


def test_fourier_modes_are_whole_periods_in_the_square():
    pupil = np.ones(GRID.shape)
    settings = MirrorSettings(kind="fourier", modes=10)
    mirror = Mirror.build(settings, pupil, GRID, diameter_m=DIAMETER_M, dtype="float64")
    np.testing.assert_allclose(mirror.cycles_per_aperture, [0.5, 0.5, 1, 1, 1, 1, *[2**0.5] * 4])
    made = np.asarray(mirror.opd_m(np.eye(10)[3]))
    wave = np.sqrt(2) * np.sin(2 * np.pi * GRID.x_m / DIAMETER_M) * np.ones(GRID.shape)
    np.testing.assert_allclose(made, wave - wave.mean(), atol=1e-12)


def test_an_actuator_pushes_a_gaussian_and_its_neighbour_by_the_coupling():
    grid = Grid((33, 33), 0.25)  # the pitch is four pixels, the middle actuator on a pixel
    settings = MirrorSettings(kind="actuators", actuators_across=9, coupling=0.2)
    mirror = Mirror.build(settings, np.ones(grid.shape), grid, diameter_m=DIAMETER_M, dtype="float64")
    assert mirror.count == 81
    made = np.asarray(mirror.opd_m(np.eye(81)[4 * 9 + 5]))  # fifth row, sixth column: one to +x of the middle
    made = made - made[0, 0]  # the mean was taken off
    expected = 0.2 ** ((grid.x_m - 1) ** 2 + grid.y_m**2)
    np.testing.assert_allclose(made, expected, atol=1e-9)  # the corner is 0.2^41 away


def test_only_actuators_that_reach_the_light_are_there():
    settings = MirrorSettings(kind="actuators", actuators_across=17)
    pupil = circular_pupil(GRID, diameter_m=DIAMETER_M)
    mirror = Mirror.build(settings, pupil, GRID, diameter_m=DIAMETER_M)
    places = np.linspace(-8, 8, 17)
    away = np.hypot(places[:, None], places) - 8  # pitches beyond the edge
    assert np.sum(away <= 0.4) <= mirror.count <= np.sum(away <= 1.0)  # half a pixel is 0.22 pitches


def test_a_command_is_clipped_at_the_stroke():
    plain = Mirror.build(MirrorSettings(modes=9), PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")
    short = Mirror.build(MirrorSettings(modes=9, stroke_um=0.3), PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")
    command_m = 1e-6 * np.array([0.1, -0.2, 0.5, -3.0, 0.3, 0, 0.29, -0.31, 7])
    clipped_m = np.clip(command_m, -0.3e-6, 0.3e-6)
    np.testing.assert_allclose(short.clipped(command_m), clipped_m, rtol=1e-12)
    np.testing.assert_allclose(short.opd_m(command_m), plain.opd_m(clipped_m), atol=1e-19)
    np.testing.assert_array_equal(plain.clipped(command_m), command_m)
    np.testing.assert_allclose(short.fitted(plain.opd_m(command_m)), command_m, atol=1e-18)  # a fit is not clipped


def test_shape_and_fit_go_through_jit_and_have_the_derivative_of_a_linear_map(mirror):
    change_m = 1e-7 * np.random.default_rng(5).normal(size=mirror.count)
    start_m, along_m = jnp.zeros(mirror.count), jnp.asarray(change_m)
    value, slope = jax.jvp(jax.jit(lambda command_m: mirror.opd_m(command_m)), (start_m,), (along_m,))
    assert not np.asarray(value).any()
    np.testing.assert_allclose(slope, mirror.opd_m(change_m), atol=1e-19)
    held = rough(6)
    light = np.where(PUPIL > 0, held, 0)
    # Adjoint of the shape: <opd, shape(c)> = <shapes opd, c>, with the shapes as they come out.
    left = np.sum(light * np.asarray(mirror.opd_m(change_m)))
    right = np.asarray(jax.grad(lambda c: jnp.sum(jnp.asarray(light) * mirror.opd_m(c)))(along_m)) @ change_m
    assert left == pytest.approx(right, rel=1e-12)


def test_single_precision_is_good_enough_for_nanometres():
    opd_m = rough(7)
    double = Mirror.build(MirrorSettings(modes=80), PUPIL, GRID, diameter_m=DIAMETER_M, dtype="float64")
    single = Mirror.build(MirrorSettings(modes=80), PUPIL, GRID, diameter_m=DIAMETER_M)
    assert single.shapes.dtype == single.fit.dtype == single.fitted(opd_m).dtype == jnp.float32
    np.testing.assert_allclose(single.fitted(opd_m), double.fitted(opd_m), atol=1e-12)  # 1e-6 of a micrometre


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"kind": "piezo"}, 'kind: must be "karhunen-loeve", "zernike", "fourier" or "actuators", got "piezo"'),
        ({"coupling": 1.0}, "coupling: must be a number greater than 0 and below 1, got 1.0"),
        ({"stroke_um": 0}, "stroke_um: must be a number greater than 0 and at most 1000 [um], got 0"),
        ({"stroke_um": float("nan")}, "stroke_um: must be a finite number, got nan"),
        ({"actuators_across": 1}, "actuators_across: must be a whole number from 2 to 1000, got 1"),
        ({"modes": 0}, "modes: must be a whole number from 1 to 100000, got 0"),
        ({"cutoff_cpa": 0.2}, "cutoff_cpa: must be a number from 1 to 500, got 0.2"),
        (
            {"kind": "actuators", "modes": 40},
            "modes: must be left out with actuators, which actuators_across counts, got 40",
        ),
        ({"stroke_nm": 400}, "stroke_nm: unknown key, got 400; the unit is in the name: did you mean stroke_um [um]?"),
    ],
)
def test_bad_settings_give_one_clear_line(values, line):
    with pytest.raises(ValidationError) as error:
        MirrorSettings(**values)
    assert problems_in_words(MirrorSettings, error.value) == [line]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (MirrorSettings(cutoff_cpa=30.0), r"mirror.cutoff_cpa: must be at most 18\.18.*, got 30"),
        (MirrorSettings(kind="fourier", cutoff_cpa=30.0), "mirror.cutoff_cpa"),
        (MirrorSettings(kind="zernike", modes=1400), "mirror.modes: must be below the .* lit pixels, got 1400"),
        (MirrorSettings(kind="zernike", modes=980), "mirror.modes: must be below .* tell apart, got 980"),
        (MirrorSettings(kind="actuators", actuators_across=60), "mirror.actuators_across: must be at most 37, .* 60"),
        (MirrorSettings(modes=1300), "modes.count: must be at most"),
    ],
)
def test_shapes_too_fine_for_the_pixels_are_refused(settings, message):
    with pytest.raises(SamplingError, match=message):
        Mirror.build(settings, PUPIL, GRID, diameter_m=DIAMETER_M)


def test_a_sparse_pupil_has_all_its_modes_up_to_the_cutoff():
    """Four discs have fewer modes than one; their number must not hang on how many were made beyond them."""
    centres_m = [(2.4, 1.1), (-1.1, 2.4), (-2.4, -1.1), (1.1, -2.4)]
    pupil = pupil_of_discs(GRID, centres_m=centres_m, disc_diameter_m=2.4)
    many = modal_basis(pupil, GRID, diameter_m=DIAMETER_M, count=300)
    for cutoff in (4.0, 8.0, 12.0):
        mirror = Mirror.build(MirrorSettings(cutoff_cpa=cutoff), pupil, GRID, diameter_m=DIAMETER_M)
        assert mirror.cycles_per_aperture.max() <= cutoff
        assert mirror.count == pytest.approx(int(np.sum(many.cycles_per_aperture <= cutoff)), rel=0.03)
    with pytest.raises(SamplingError, match=r"mirror.cutoff_cpa: must be lower, .* got 18\.1"):
        Mirror.build(MirrorSettings(cutoff_cpa=18.1), pupil, GRID, diameter_m=DIAMETER_M)


def test_a_diameter_must_be_a_length():
    with pytest.raises(SettingsError, match="diameter_m: must be a positive length, got -8"):
        Mirror.build(MirrorSettings(), PUPIL, GRID, diameter_m=-8.0)
