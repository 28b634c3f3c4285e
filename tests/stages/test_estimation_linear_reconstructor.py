"""The linear reconstructor on starlight made in NumPy: recovery, tilt, its error bar, masks, updates.

No line of the light is shared with the code under test. It runs on cells three times finer than the detector's and on
a window twice as wide. Nothing is symmetric: neither frames nor distances nor shares nor the static aberration.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation.linear_reconstructor import LinearReconstructor
from nlcwfs.estimation.linear_settings import LinearSettings
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings

DIAMETER_M, WAVELENGTH_M = 8.0, 0.65e-6
FRAME = Grid((30, 33), 0.4)
LIGHT = Grid((180, 195), 0.4 / 3)  # centred on the frame: 30 and 32 pixels more
DISTANCES_M = np.array([-3.5e6, 2.0e6, 3.2e6])
SHARES = np.array([0.4, 0.25, 0.35])
SEEING_ARCSEC = 0.6 / 35  # the telescope is about one r0 wide at this wavelength
RADIAN_M = WAVELENGTH_M / (2 * np.pi)


def smooth(grid: Grid) -> np.ndarray:
    """A static aberration of 30 nm, on any pixels."""
    y, x = np.broadcast_arrays(grid.y_m / 4, grid.x_m / 4)
    return 30e-9 * (np.cos(2.1 * x + 0.7) * np.sin(1.3 * y - 0.2) + 0.5 * x * y)


def disc(grid: Grid) -> np.ndarray:
    parts = Grid((grid.shape[0] * 5, grid.shape[1] * 5), grid.pixel_m / 5)
    lit = parts.y_m**2 + parts.x_m**2 < (DIAMETER_M / 2) ** 2
    return lit.reshape(grid.shape[0], 5, grid.shape[1], 5).mean(axis=(1, 3))


PUPIL = disc(LIGHT)
WEIGHTS = PUPIL**2 / np.sum(PUPIL**2)


def images(opd_m: np.ndarray, distances_m=DISTANCES_M) -> np.ndarray:
    """Shares of the photons on the detector's pixels; z > 0 is downstream."""
    squared = LIGHT.fy_per_m**2 + LIGHT.fx_per_m**2
    field = np.sqrt(WEIGHTS) * np.exp(1j * (opd_m + smooth(LIGHT)) / RADIAN_M)
    spectrum = np.fft.fft2(field)
    planes = []
    for distance_m, share in zip(distances_m, SHARES, strict=True):
        far = np.fft.ifft2(spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * distance_m * squared))
        planes.append(share * on_frame(abs(far) ** 2))
    return np.array(planes)


def on_frame(fine: np.ndarray) -> np.ndarray:
    """Sums over the 30 x 33 pixels in the middle."""
    return fine.reshape(60, 3, 65, 3).sum(axis=(1, 3))[15:45, 16:49]


def truth_on_frame(opd_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    light, weighted = (on_frame(one) for one in (WEIGHTS, WEIGHTS * opd_m))
    return light, np.where(light > 0, weighted / np.where(light > 0, light, 1), 0)


def error_m(estimate_m, opd_m: np.ndarray) -> float:
    """Rms over the light, piston removed, of means over pixels."""
    light, mean_m = truth_on_frame(opd_m)
    left = np.asarray(estimate_m, float) - mean_m
    left = left - np.sum(light * left) / light.sum()
    return float(np.sqrt(np.sum(light * left**2) / light.sum()))


def geometry() -> SensorGeometry:
    return SensorGeometry(
        pupil=PupilShape(DIAMETER_M),
        frame=FRAME,
        wavelength_m=WAVELENGTH_M,
        distances_m=tuple(DISTANCES_M.tolist()),
        flux_fractions=tuple(SHARES.tolist()),
        static_opd_m=smooth(FRAME),
    )


@pytest.fixture(scope="module")
def solver() -> LinearReconstructor:
    """Taught weak turbulence."""
    linear = LinearSettings(modes=40, training_screens=1200)
    return LinearReconstructor.build(geometry(), EstimationSettings(seeing_arcsec=SEEING_ARCSEC), linear=linear)


def estimate(solver: LinearReconstructor, counts: np.ndarray, usable: np.ndarray | None = None, **options):
    usable = np.ones(counts.shape, bool) if usable is None else usable
    return eqx.filter_jit(solver.estimate)(jnp.asarray(counts), jnp.asarray(usable), **options)


def with_updates(solver: LinearReconstructor, updates: int) -> LinearReconstructor:
    """The same matrix, with other updates and no trial of them."""
    parts = {name: getattr(solver, name) for name in solver.__dataclass_fields__}
    linear = solver.linear.model_copy(update={"gerchberg_saxton_updates": updates})
    return LinearReconstructor(**parts | {"trial": None, "linear": linear})


def few_modes(seed: int, rms_rad: float) -> np.ndarray:
    """Smooth and asymmetric: a cubic polynomial without piston and tilt."""
    y, x = np.broadcast_arrays(LIGHT.y_m / 4, LIGHT.x_m / 4)
    terms = np.stack([x**2, x * y, y**2, x**3, x**2 * y, x * y**2, y**3])
    opd_m = np.tensordot(np.random.default_rng(seed).normal(size=7), terms, axes=1)
    planes = np.stack([np.ones_like(x), x, y])
    slopes = np.linalg.solve(
        np.einsum("ayx,byx,yx->ab", planes, planes, WEIGHTS), (planes * WEIGHTS * opd_m).sum((1, 2))
    )
    opd_m = opd_m - np.tensordot(slopes, planes, axes=1)
    return opd_m * (rms_rad * RADIAN_M / np.sqrt(np.sum(WEIGHTS * opd_m**2)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_small_wavefront_is_recovered_and_only_the_right_way_round(solver, seed):
    opd_m = few_modes(seed, rms_rad=0.5)
    found_m = estimate(solver, 1e7 * images(opd_m)).opd_m
    rms_m = 0.5 * RADIAN_M
    assert error_m(found_m, opd_m) < 0.15 * rms_m
    for wrong_m in (opd_m[::-1], opd_m[:, ::-1], -opd_m):
        assert error_m(found_m, wrong_m) > 0.3 * rms_m
    behind_m = estimate(solver, 1e7 * images(opd_m, -DISTANCES_M)).opd_m
    assert error_m(behind_m, opd_m) > 0.5 * rms_m


@pytest.mark.parametrize("slope", [(1e-7, 0.0), (-0.6e-7, 2e-7), (3e-7, -3e-7)])
def test_a_tilt_of_several_pixels_leaves_the_rest_as_it_was(solver, slope):
    """3e-7 over 3500 km are 2.6 pixels, and 4.6 um across the telescope: a hundred times what was taught."""
    opd_m = few_modes(4, rms_rad=0.3)
    tilted_m = opd_m + slope[0] * LIGHT.y_m + slope[1] * LIGHT.x_m
    without = error_m(estimate(solver, 1e7 * images(opd_m)).opd_m, opd_m)
    found_m = estimate(solver, 1e7 * images(tilted_m)).opd_m
    tilt_rms_m = np.hypot(*slope) * DIAMETER_M / 4
    assert error_m(found_m, tilted_m) < without + 0.02 * tilt_rms_m


def turbulence(count: int, telescope_over_fried: float) -> list[np.ndarray]:
    screens = PhaseScreens.build(
        Turbulence(DIAMETER_M / telescope_over_fried, WAVELENGTH_M), shape=LIGHT.shape, pixel_m=LIGHT.pixel_m
    )
    drawn = [np.asarray(screens.draw(jax.random.key(1000 + number)), float) for number in range(count)]
    return [np.where(PUPIL > 0, one - np.sum(WEIGHTS * one), 0) for one in drawn]


def test_the_predicted_error_is_the_error(solver):
    """In the air that was taught, at few photons (noise rules) and many, with read noise and without."""
    air = Turbulence.from_seeing(seeing_arcsec=SEEING_ARCSEC)
    skies = turbulence(40, DIAMETER_M / air.fried_at(WAVELENGTH_M))
    rng = np.random.default_rng(8)
    for photons, read_noise in ((1e3, 0.0), (2e4, 0.0), (1e6, 0.0), (2e4, 2.0)):
        squares, predicted = [], []
        for opd_m in skies:
            counts = rng.poisson(photons * images(opd_m)) + rng.normal(0, read_noise, (3, *FRAME.shape))
            found = estimate(solver, counts, read_variance=jnp.asarray(read_noise**2))
            squares.append(error_m(found.opd_m, opd_m) ** 2)
            predicted.append(float(found.predicted_error_m) ** 2)
            assert found.outcome.succeeded == (photons > 1e3)  # at a photon a pixel no speckle tells right from wrong
        spread = np.std(squares) / np.mean(squares) / np.sqrt(len(squares))
        # The judges are 120 wavefronts, photons are rounded to half a decade, read noise is spread evenly.
        tolerance = 5 * spread + (0.15 if read_noise == 0 else 0.5)
        assert np.mean(predicted) == pytest.approx(np.mean(squares), rel=tolerance), (photons, read_noise)
    assert np.mean(predicted) > 0


def test_frames_may_be_mapped_over_and_a_masked_pixel_does_no_harm(solver):
    frames = np.stack([2e5 * images(few_modes(seed, rms_rad=0.3)) for seed in (6, 7)])
    usable = np.ones(frames[0].shape, bool)
    usable[0, 8, 24] = usable[1, 22, 9] = usable[2, 22, 9] = False  # as light a tilted wavefront would send there
    broken = np.where(usable, frames, 1e6)
    mapped = eqx.filter_jit(jax.vmap(lambda counts: solver.estimate(counts, jnp.ones(counts.shape, bool))))
    both = mapped(jnp.asarray(frames))
    for number in (0, 1):
        alone = estimate(solver, frames[number])
        np.testing.assert_allclose(both.opd_m[number], alone.opd_m, atol=1e-11)  # single precision
        masked = estimate(solver, broken[number], usable)
        assert (
            error_m(masked.opd_m, few_modes(6 + number, rms_rad=0.3))
            < 1.5 * error_m(alone.opd_m, few_modes(6 + number, rms_rad=0.3)) + 2e-9
        )
    wild = estimate(solver, broken[0]).opd_m
    assert error_m(wild, few_modes(6, rms_rad=0.3)) > 1e-7  # the mask did matter


def test_a_wavefront_that_does_not_explain_the_images_is_not_believed(solver):
    (strong,) = turbulence(1, 12.0)
    assert not estimate(solver, 2e4 * images(strong)).outcome.succeeded
    assert not estimate(solver, np.zeros((3, *FRAME.shape))).outcome.succeeded


def test_updates_bring_strong_turbulence_nearer_and_say_by_how_much():
    """Untold strengths, one update: the error shrinks, the error bar with it, and the strength is found."""
    linear = LinearSettings(modes=50, training_screens=400, gerchberg_saxton_updates=1)
    updated = LinearReconstructor.build(geometry(), EstimationSettings(), linear=linear)
    alone = with_updates(updated, 0)
    rng = np.random.default_rng(9)
    typical = DIAMETER_M / Turbulence.from_seeing(seeing_arcsec=0.6).fried_at(WAVELENGTH_M)
    for strength in (2.0, 6.0):
        before, after, promised, found_strength = [], [], [], []
        for opd_m in turbulence(15, strength):
            counts = rng.poisson(1e5 * images(opd_m)).astype(float)
            first, then = estimate(alone, counts), estimate(updated, counts)
            before.append(error_m(first.opd_m, opd_m))
            after.append(error_m(then.opd_m, opd_m))
            promised.append(float(then.predicted_error_m))
            found_strength.append(float(then.strength))
        assert np.median(after) < 0.85 * np.median(before)
        # Forty trials in eight classes of wavefronts; here 1.2 and 1.35.
        assert 0.7 < np.sqrt(np.mean(np.square(promised)) / np.mean(np.square(after))) < 1.6
        assert 0.7 < np.median(found_strength) * (typical / strength) ** (5 / 3) < 1.4
        assert int(then.iterations) == 1
        assert int(first.iterations) == 0


def ffts_in(jaxpr) -> float:
    """Two-dimensional complex FFTs in a program, those of loops as often as they run; a real one is half."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "fft":
            real = "RFFT" in equation.params["fft_type"].name
            total += np.prod(equation.invars[0].aval.shape[:-2], dtype=float) * (0.5 if real else 1.0)
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", value)
            total += times * ffts_in(inner) if hasattr(inner, "eqns") else 0
    return total


@pytest.mark.parametrize("updates", [0, 3])
def test_the_count_of_ffts_is_what_the_program_holds(solver, updates):
    several = with_updates(solver, updates)
    usable, counts = jnp.ones((3, *FRAME.shape), bool), jnp.ones((3, *FRAME.shape))
    program = jax.make_jaxpr(lambda counts: several.estimate(counts, usable))(counts)
    assert int(estimate(several, counts).ffts) == ffts_in(program.jaxpr)
