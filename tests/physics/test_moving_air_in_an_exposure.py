"""Air that moves while light is integrated: a ripple that is blown across keeps the contrast sinc(f v T)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.loop.small_loop import small

from nlcwfs.feedback.delay_line import DelayLine
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.sequence import SequenceSimulator

SMALL = ["precision=double", "atmosphere.screen_width_m=20", "loop.rate_hz=20", "simulation.rate_hz=20"]
RATE_HZ, SPEED_M_PER_S, CYCLES_PER_M, HEIGHT_M = 20.0, 10.0, 1.7, 1e-10
TURN_RAD = np.pi * CYCLES_PER_M * SPEED_M_PER_S / RATE_HZ
"""Half the turn of the ripple's phase in an exposure: 0.85 of a cycle passes by."""


class Ripple(eqx.Module):
    """One wave in place of the air; the wind blows it towards +x."""

    x_m: jax.Array
    height_m: jax.Array

    def opd_m(self, time_s):
        return self.height_m * jnp.sin(2 * np.pi * CYCLES_PER_M * (self.x_m - SPEED_M_PER_S * time_s))


def answer(kind: str, membrane: str, substeps: int) -> np.ndarray:
    """What a ripple of one metre would do to the light of exposure 2, as far as light is linear in it."""
    moments = [f"{section}.substeps={substeps}" for section in ("simulation", "loop")]
    config, light = small(*SMALL, *moments, f"curvature_sensor.membrane={membrane}"), None
    if kind == "loop":
        light = LoopLight.build(config)
    sequence = SequenceSimulator.build(config) if light is None else light.sequence
    rows, columns = (
        waves.shape[1] for waves in (sequence.still.screens.low_waves_y, sequence.still.screens.low_waves_x)
    )
    x_m = (np.arange(columns) - (columns - 1) / 2) * sequence.still.light.pixel_m + np.zeros((rows, 1))
    found = []
    for height_m in (HEIGHT_M, -HEIGHT_M):
        moving = eqx.tree_at(lambda one: one.flow, sequence, Ripple(jnp.asarray(x_m), jnp.asarray(height_m)))
        if light is None:
            exposure = moving.expose(2)
        else:
            line = DelayLine.build(light.mirror.count, dtype="float64")
            flat_m, seen = jnp.zeros_like(light.weights), eqx.tree_at(lambda one: one.sequence, light, moving)
            exposure = seen.expose(jnp.asarray(2, jnp.int32), line, light.star_image(1.65e-6), flat_m).exposure
        found.append(np.asarray(exposure.photons))
    return (found[0] - found[1]) / (2 * HEIGHT_M)


@pytest.mark.parametrize(("kind", "membrane"), [("sequence", "none"), ("loop", "sine")])
def test_a_ripple_that_is_blown_across_keeps_the_sinc_of_its_way(kind, membrane):
    """Light that is linear in the ripple sees the mean of its moments: the ripple in the middle of the exposure, times
    sin(x) / (N sin(x / N)) for N moments, x = pi f v T: nearly sinc(f v T) for many, too much by x^2 / (6 N^2)."""
    still = answer(kind, membrane, 1)  # one moment is the middle
    few, many, sinc = answer(kind, membrane, 2), answer(kind, membrane, 12), np.sinc(TURN_RAD / np.pi)
    # 1e-5: the square of the ripple's phase is 5e-7, and the light is summed to 1e-10.
    np.testing.assert_allclose(few, np.cos(TURN_RAD / 2) * still, atol=1e-5 * np.abs(still).max())
    share = np.sum(many * still) / np.sum(still**2)
    np.testing.assert_allclose(many, share * still, atol=1e-5 * np.abs(still).max())
    assert share / sinc - 1 == pytest.approx(TURN_RAD**2 / (6 * 12**2), rel=0.05)
    assert 0.15 < sinc < 0.2
