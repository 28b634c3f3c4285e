"""The loop under air that twinkles: its light is that of the moving amplitude, and its model of even light holds it."""

import jax.numpy as jnp
import numpy as np
import pytest
from small_loop import small

from nlcwfs.errors import SettingsError
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, run_loop

SHORT, HIGH = "loop.seconds=0.06", "atmosphere.layer_heights_km=[10]"


def test_the_light_is_that_of_the_amplitude_and_the_loop_stays_closed():
    loop = Loop.build(small(SHORT, HIGH))
    state, light = loop.init(), loop.light
    exposure = light.expose(jnp.asarray(4), state.control.line, state.image, jnp.zeros_like(light.weights)).exposure
    arrived = float(jnp.sum(exposure.photons.sum((1, 2)) / (1 - exposure.lost)))
    squares = [np.asarray(light.sequence.factor(moment)[0]) ** 2 for moment in light.sequence.moments_s(4)]
    told = float(np.sum(np.asarray(light.still.weights) * np.mean(squares, axis=0))) * light.still.photons
    assert arrived == pytest.approx(told, rel=1e-3)
    assert abs(told / light.still.photons - 1) > 1e-4  # a telescope of 2 m varies by 1 %
    _, records = run_loop(loop)
    _, even = run_loop(Loop.build(small(SHORT)))
    left_nm, even_nm = (np.sqrt(np.mean(LoopTelemetry.of(one).rms_nm[20:] ** 2)) for one in (records, even))
    assert left_nm == pytest.approx(even_nm, rel=0.15)


@pytest.mark.parametrize("sensor", ["shack-hartmann", "pyramid"])
def test_sensors_of_even_light_refuse_it(sensor):
    with pytest.raises(SettingsError, match=rf'layer_heights_km: must be 0 with loop.sensor = "{sensor}"'):
        LoopLight.build(small(HIGH, f"loop.sensor={sensor}"))
