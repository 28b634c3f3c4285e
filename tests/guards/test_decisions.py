"""What `docs/decisions` promises and no stage's own test holds."""

import numpy as np

from nlcwfs.config import load_config
from nlcwfs.interop.frames_reconstruction import rms_m
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key

SMALL = ["detector.pixels_across_pupil=12", "detector.window_pixels=16", "atmosphere.opd_rms_nm=100"]


def frames_of(count, *, seed):
    simulator = ExposureSimulator.build(load_config(None, SMALL))
    return [np.asarray(simulator.expose(frame_key(seed=seed, frame=k)).frames.electrons) for k in range(count)]


def test_a_wavelength_on_half_of_the_pupil_counts_fully():
    rng = np.random.default_rng(1)
    light = rng.random((9, 12))
    light[:, :3] = 0
    weights = light / light.sum()
    right = np.arange(12) >= 7
    error_m = np.where(right, 0.65e-6, 0.0) * np.ones((9, 1)) + 3e-6  # and piston, which does not count
    error_m[:, :3] = np.nan
    share = weights[:, right].sum()
    # variance of a two-valued variable: p (1 - p) step^2
    assert np.isclose(rms_m(error_m, weights), 0.65e-6 * np.sqrt(share * (1 - share)), rtol=1e-12)


def test_the_same_seed_gives_the_same_frames_however_many_there_are():
    three, one = frames_of(3, seed=5), frames_of(1, seed=5)
    assert np.array_equal(three[0], one[0])
    assert np.array_equal(three[2], frames_of(3, seed=5)[2])


def test_another_frame_or_another_seed_is_another_exposure():
    first, second = frames_of(2, seed=5)
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, frames_of(1, seed=6)[0])
