"""Commands reach the mirror when they should: against a mirror that is followed in small steps of time."""

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.feedback.delay_line import DelayLine

SUBSTEPS = 10  # of an exposure; every latency below is a whole number of them


def mirror_in_time(commands: np.ndarray, latency_frames: float) -> np.ndarray:
    """Shape `[exposure, substep, mode]`; command n arrives `latency_frames` after exposure n begins."""
    exposures = len(commands)
    shape = np.zeros((exposures * SUBSTEPS, commands.shape[1]))
    for number, command in enumerate(commands):
        shape[round((number + latency_frames) * SUBSTEPS) :] = command
    return shape.reshape(exposures, SUBSTEPS, -1)


@pytest.mark.parametrize("latency_frames", [0.0, 0.4, 1.0, 1.7, 3.2])
def test_the_mirror_holds_what_a_mirror_in_time_holds(latency_frames):
    commands = np.random.default_rng(3).normal(size=(9, 4))
    expected = mirror_in_time(commands, latency_frames)
    line = DelayLine.build(4, latency_frames=latency_frames, dtype="float64")
    for number, command in enumerate(commands):
        line = line.push(jnp.asarray(command))
        first = round(line.share_before * SUBSTEPS)
        held = np.concatenate(
            [np.repeat(line.before_m[None], first, 0), np.repeat(line.after_m[None], SUBSTEPS - first, 0)]
        )
        np.testing.assert_array_equal(held, expected[number])
        np.testing.assert_allclose(line.mean_m, expected[number].mean(0), atol=1e-14)  # rounding of a sum of ten
        np.testing.assert_array_equal(line.newest_m, command)


def test_the_share_of_an_exposure_is_the_part_of_the_latency():
    shares = [DelayLine.build(1, latency_frames=frames).share_before for frames in (0.0, 0.4, 1.0, 1.7)]
    np.testing.assert_allclose(shares, [0, 0.4, 0, 0.7], atol=1e-15)  # rounding
