"""The Shack-Hartmann in the loop: the same light as any sensor's, gain 1, and what it leaves of the turbulence."""

import functools
import json
import sys
from pathlib import Path

import aotpy
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from small_loop import SMALL, small

sys.path.insert(0, str(Path(__file__).parents[1] / "stages"))
from command_line import type_in

from nlcwfs.beam.zernike import zernikes
from nlcwfs.estimation.loop_reconstructor import LoopModes, loop_reconstructor
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.slopes_to_modes import average_gradients, minimum_variance, response
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop.driven_modes import moved_share
from nlcwfs.simulation.closed_loop.lenslet_light import keys_cubic
from nlcwfs.simulation.closed_loop.lenslet_modes import slopes_of_cells
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import MISSING, LoopTelemetry, run_loop, summary

LENSLETS = ("loop.sensor=shack-hartmann", "shack_hartmann.subapertures=10", "shack_hartmann.pixels=32")
BRIGHT = 1e9


@functools.cache
def built(*overrides: str) -> Loop:
    return Loop.build(small(*LENSLETS, *overrides))


def ran(loop: Loop, *overrides: str) -> tuple[LoopTelemetry, dict]:
    """A run with other settings of the loop itself, on the same mirror, sensor and air."""
    loop.config = small(*LENSLETS, *overrides)
    state, records = run_loop(loop)
    return LoopTelemetry.of(records), summary(loop, state, records, 1.0)


def exposed(loop: Loop, frame: int, command_m: np.ndarray):
    """An exposure behind a mirror of this shape."""
    state = loop.init()
    line = state.control.push(jnp.asarray(command_m, jnp.float32)).line
    return loop.light.expose(jnp.asarray(frame, jnp.int32), line, state.image, jnp.zeros_like(loop.light.weights))


def noise_free(loop: Loop, residual_m: np.ndarray):
    """An exposure of very many photons, each where it is expected, of a wavefront on the lit part of the light."""
    photons = loop.light.optics.images(jnp.asarray(residual_m, jnp.float32), BRIGHT)
    exposure = exposed(loop, 0, np.zeros(loop.light.mirror.count)).exposure
    return eqx.tree_at(lambda one: one.frames.electrons, exposure, photons)


def measured_m(loop: Loop, exposure, memory=None) -> np.ndarray:
    usable = jnp.ones(exposure.frames.electrons.shape, bool)
    sight, _ = loop.measurement.measure(exposure, usable, jnp.zeros_like(loop.light.weights), memory)
    return np.asarray(sight.residual_m)


def test_the_air_and_the_score_are_those_of_the_curvature_sensor():
    loop, other = built(), Loop.build(small("loop.sensor=ideal"))
    command_m = np.linspace(-1e-7, 1e-7, loop.light.mirror.count)
    ours, theirs = exposed(loop, 3, command_m), exposed(other, 3, command_m)
    np.testing.assert_array_equal(ours.exposure.opd_m, theirs.exposure.opd_m)
    np.testing.assert_array_equal(ours.exposure.truth_m, theirs.exposure.truth_m)
    assert float(ours.square_m2) == float(theirs.square_m2)
    assert np.std(np.asarray(ours.exposure.opd_m)) > 1e-7


def test_all_photons_that_lenslets_catch_are_counted():
    """4000 photons of which serve what NumPy counts on a disc, less 4 to 8 % beyond 8 lambda / d."""
    loop = built()
    middle = (np.arange(1000) + 0.5) / 100 - 5
    disc = (np.hypot(middle[:, None], middle[None, :]) < 5).reshape(10, 100, 10, 100).swapaxes(1, 2)
    share = disc.mean(axis=(2, 3))
    caught = share[share > 0.7].sum() / share.sum()
    photons = np.asarray(exposed(loop, 0, np.zeros(loop.light.mirror.count)).exposure.photons)
    assert photons.shape == (np.sum(share > 0.7), 32, 32)
    assert 0.92 < photons.sum() / (4000 * caught) < 0.96
    counts = [
        float(exposed(loop, n, np.zeros(loop.light.mirror.count)).exposure.frames.electrons.sum()) for n in range(9)
    ]
    assert np.all(np.equal(np.mod(counts, 1), 0))
    assert np.mean(counts) == pytest.approx(float(photons.sum()), abs=5 * float(np.sqrt(photons.sum() / 9)))


@pytest.mark.parametrize("centroid", ["matched", "gravity", "thresholded", "weighted"])
def test_a_small_known_wavefront_is_measured_as_itself(centroid):
    """Tilt in y and x, defocus, astigmatism, coma of 4 to 12 nm each; closed form, and the mirror's best fit to it.

    4 %: averaging over lenslets of a fifth of a cycle, and filters that are calibrated on aberrated spots.
    """
    loop = built("loop.start=closed", f"shack_hartmann.centroid={centroid}")
    light = loop.light
    wave = 1e-9 * np.array([0, 12.0, -8.0, 6.0, -5.0, 7.0, 4.0])
    wavefront_m = np.tensordot(wave, zernikes(7, light.part, diameter_m=2.0), axes=1)
    wanted_m = np.asarray(light.mirror.fitted(jnp.asarray(wavefront_m, jnp.float32)))
    found_m = measured_m(loop, noise_free(loop, wavefront_m))
    np.testing.assert_allclose(np.sum(found_m * wanted_m), np.sum(wanted_m**2), rtol=0.04)
    assert np.linalg.norm(found_m - wanted_m) < 0.08 * np.linalg.norm(wanted_m)


def test_gain_is_one_amid_what_the_loop_leaves():
    """A mode more in the closed loop is measured as so much more: spots are smeared and bent there, and smaller gains
    would close just as well, only slowly. A bright star, for the prior takes 13 % at 50 photons a spot; 6 % for the
    waves between the lenslets."""
    bright = ("atmosphere.photons_per_s=2e8",)
    loop = built(*bright)
    loop.config = small(*LENSLETS, *bright, "loop.seconds=0.05")
    state, _ = run_loop(loop)
    gains = []
    for mode in (0, 1, 4, 7):
        push_m = 2e-8 * (np.arange(loop.light.mirror.count) == mode)
        command_m = np.asarray(state.control.line.mean_m)
        both = [exposed(loop, state.frame, command_m + sign * push_m).exposure for sign in (1, -1)]
        both = [eqx.tree_at(lambda one: one.frames.electrons, one, one.photons) for one in both]
        less, more = (measured_m(loop, one, state.memory)[mode] for one in both)
        gains.append((more - less) / 4e-8)
    np.testing.assert_allclose(gains, 1, atol=0.06)


def test_it_closes_from_a_flat_mirror_and_stays_near_the_floor():
    told, found = ran(built())
    assert found["outcome"] == "closed"
    assert 2 <= found["frames_to_close"] < 12
    assert told.rms_nm[0] > 300
    floor_nm = found["bounds"]["floor_nm"]
    assert floor_nm < found["rms_nm"] < 2 * floor_nm
    assert 0.3 < found["strehl"] < 1
    assert not told.closed[0]


def test_the_same_seed_gives_the_same_numbers():
    loop = built()
    first, _ = ran(loop, "loop.seconds=0.03")
    again, _ = ran(loop, "loop.seconds=0.03")
    np.testing.assert_array_equal(first.command_m, again.command_m)


@pytest.mark.parametrize("fault", ["nan-frames", "lost-frames", "doubled-frames", "dead-plane", "bump"])
def test_it_survives(fault):
    """20 ms of trouble at 80 ms; at 200 ms it is where it was."""
    times = ("loop.seconds=0.2", "loop.fault_at_s=0.08", "loop.fault_s=0.02")
    told, found = ran(built(), f"loop.fault={fault}", *times, "loop.bump_nm=400")
    trouble = slice(40, 50)
    if fault == "nan-frames":
        assert set(told.outcome[trouble]) == {int(Outcome.NO_LIGHT)}
        assert np.ptp(told.command_m[trouble], axis=0).max() == 0
    if fault == "lost-frames":
        assert set(told.outcome[trouble]) == {MISSING}
    if fault == "bump":
        assert told.rms_nm[40] > 350
    assert np.isfinite(told.command_m).all()
    assert found["outcome"] == "closed"
    assert np.median(told.rms_nm[-20:]) < 1.4 * np.median(told.rms_nm[30:40])


def test_a_star_without_light_is_told_and_nothing_moves():
    dim = ("atmosphere.photons_per_s=0.01", "loop.give_up_s=0.02")
    told, found = ran(built(*dim), *dim)
    assert found["outcome"] == "not closed"
    assert set(told.outcome) == {int(Outcome.NO_LIGHT)}
    assert not told.command_m.any()


def test_read_noise_is_read_and_reckoned_with():
    """3 electrons on 256 pixels a spot of 50 photons: more is left than without, far less than the open loop's."""
    few = ("shack_hartmann.pixels=16", "detector.read_noise_electrons=3")
    loop = built(*few)
    _, noisy = ran(loop, *few)
    electrons = np.asarray(exposed(loop, 0, np.zeros(loop.light.mirror.count)).exposure.frames.electrons)
    assert electrons.min() < -9  # which photons alone never are
    _, quiet = ran(built(few[0]), few[0])
    assert 1.1 * quiet["rms_nm"] < noisy["rms_nm"] < 2.5 * quiet["rms_nm"]


def test_modes_that_lenslets_do_not_see_are_not_driven():
    coarse = ("shack_hartmann.cutoff_cpa=3",)
    loop = built(*coarse)
    told, _ = ran(loop, *coarse, "loop.seconds=0.02")
    cycles = np.asarray(loop.light.mirror.cycles_per_aperture)
    assert told.command_m[-1][cycles <= 3].all()
    assert not told.command_m[:, cycles > 3].any()


def test_actuators_are_driven_as_well():
    """Nearly as far down as Karhunen-Loeve modes of as many cycles."""
    pushed = ("mirror.kind=actuators", "mirror.actuators_across=11")
    _, found = ran(built(*pushed), *pushed)
    _, ideal = ran(built())
    assert 0.8 * ideal["rms_nm"] < found["rms_nm"] < 1.4 * ideal["rms_nm"]


def test_latency_needs_the_shapes_on_their_way():
    """Two frames late at gain 1, which without them oscillates."""
    late = ("feedback.latency_frames=2", "loop.seconds=0.16")
    loop = built(*late)
    told, found = ran(loop, *late)
    assert found["outcome"] == "closed"
    prompt, _ = ran(built())
    assert np.median(told.rms_nm[30:]) < 3.5 * np.median(prompt.rms_nm[30:])


def test_interpolation_is_exact_for_parabolas_and_goes_on_beyond_the_rim():
    points = np.array([1.0, 1.3, 2.77, 4.5, -3.0, 11.0])
    values = keys_cubic(points, 8) @ (np.arange(8) ** 2 - 3.0 * np.arange(8))
    np.testing.assert_allclose(values[:4], points[:4] ** 2 - 3 * points[:4], atol=1e-12)  # rounding
    np.testing.assert_allclose(values[4:], [0.0, 28.0], atol=1e-12)


def test_the_matrix_of_slopes_is_the_mean_gradient_of_the_light():
    loop = built()
    optics, lit = loop.light.optics, np.asarray(loop.light.weights) > 0
    wavefront_m = np.random.default_rng(1).normal(size=lit.shape)
    fine_m = np.asarray(optics.on_cells(jnp.asarray(wavefront_m, jnp.float32)), float)
    wanted = response(optics.sensor, average_gradients(optics.sensor), fine_m[None])[:, 0]
    found = slopes_of_cells(optics, lit) @ wavefront_m[lit]
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())  # single precision


def test_an_open_loop_has_the_minimum_variance():
    """The same as one solution for all modes at once, driven or not."""
    random = np.random.default_rng(3)
    slopes = random.normal(size=(14, 9))
    air, noise = random.uniform(0.5, 9, size=9), random.uniform(0.1, 2, size=14)
    known = LoopModes(slopes, air, np.full(4, 0.1))
    found = loop_reconstructor(known, noise_rad2=noise, closed=False)
    wanted = minimum_variance(slopes, prior_m2=air, noise_rad2=noise, keep=4)
    np.testing.assert_allclose(found.matrix, wanted.matrix, atol=1e-9)
    covariance = np.linalg.inv(slopes.T @ (slopes / noise[:, None]) + np.diag(1 / air))
    np.testing.assert_allclose(found.error_m2, np.diag(covariance)[:4], rtol=1e-9)


def test_wind_moves_a_wave_by_what_numpy_averages_over_its_directions():
    config = small("loop.rate_hz=100", "atmosphere.wind_speeds_m_per_s=[17.0]")
    angle = 2 * np.pi * (np.arange(1000) + 0.5) / 1000
    moved = np.mean(
        (np.cos(2 * np.pi * 3 * 0.17 / 2 * np.cos(angle)) - 1) ** 2
        + np.sin(2 * np.pi * 3 * 0.17 / 2 * np.cos(angle)) ** 2
    )
    assert moved_share(config, np.array([3.0]))[0] == pytest.approx(moved, rel=1e-6)


def test_a_run_leaves_a_folder_that_the_standard_reads(tmp_path):
    out = tmp_path / "run"
    settings = [word for setting in [*SMALL, *LENSLETS, "loop.seconds=0.04"] for word in ("--set", setting)]
    result = type_in("loop", "--out", out, *settings)
    assert result.exit_code == 0, result.output
    assert json.loads((out / "summary.json").read_text())["outcome"] == "closed"
    system = aotpy.AOSystem.read_from_file(str(out / "telemetry.fits"))
    (sensor,) = system.wavefront_sensors
    assert isinstance(sensor, aotpy.ShackHartmann)
    assert sensor.n_valid_subapertures == np.sum(np.asarray(sensor.subaperture_mask.data) >= 0) == 76
    assert sensor.subaperture_size == pytest.approx(0.2)
    assert np.asarray(system.loops[0].residual_commands.data).shape[0] == 20


def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path):
    config = small(*LENSLETS, "loop.seconds=0.04")
    loop = built()
    loop.config = config
    _, whole = run_loop(loop)
    folder_of.prepare_folder(tmp_path / "run", config, resume=False)

    def stop(state, records):
        if len(records) == 12:
            folder_of.write_checkpoint(tmp_path / "run", config, state, records)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_loop(loop, watch=stop)
    state, records = folder_of.read_checkpoint(tmp_path / "run", config)
    _, resumed = run_loop(loop, state=state, records=records)
    assert [one.rms_nm for one in resumed] == [one.rms_nm for one in whole]
