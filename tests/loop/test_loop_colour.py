"""The loop in light of many colours: the sensor sees them all, its reconstructor believes in one."""

import functools

import numpy as np
import pytest
from small_loop import small

from nlcwfs.errors import SettingsError
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, run_loop

BAND = ("beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.4", "curvature_sensor.lenses=ideal")
LOW = "atmosphere.dispersion.zenith_deg=45"
SHORT = "loop.seconds=0.06"


@functools.cache
def left_nm(*overrides: str) -> float:
    """Rms of the residual after 20 of 30 frames."""
    _, records = run_loop(Loop.build(small(SHORT, *overrides)))
    return float(np.sqrt(np.mean(LoopTelemetry.of(records).rms_nm[20:] ** 2)))


def test_chromatic_lenses_keep_a_band_of_40_percent_as_good_as_one_colour():
    """One air, one seed: what remains is the noise of photons that fall elsewhere, 1 nm of 57."""
    assert left_nm(*BAND) == pytest.approx(left_nm(), rel=0.04)


def test_dispersion_without_a_corrector_spoils_the_loop():
    """163 mas from 0.68 to 0.85 um, where lambda / D is 88 mas."""
    assert left_nm(*BAND, LOW) > 1.15 * left_nm(*BAND)


def test_the_wavelength_of_sensing_is_not_that_of_the_bluest_colour():
    light = LoopLight.build(small(*BAND))
    assert len(light.still.sensor.spectrum.shares) > 1
    assert light.still.wavelength_m == pytest.approx(0.85e-6)


@pytest.mark.parametrize("sensor", ["shack-hartmann", "pyramid"])
def test_other_sensors_know_one_colour(sensor):
    rule = f'must be "line" with loop.sensor = "{sensor}", got "flat"'
    with pytest.raises(SettingsError, match=f"^beam.spectrum.shape: {rule}$"):
        LoopLight.build(small(*BAND, f"loop.sensor={sensor}"))
    with pytest.raises(SettingsError, match=r"^atmosphere.star.size_mas: must be 0 with loop.sensor"):
        LoopLight.build(small("atmosphere.star.size_mas=3", f"loop.sensor={sensor}"))
