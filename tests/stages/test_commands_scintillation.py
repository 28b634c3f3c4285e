"""`atmosphere.layer_heights_km` from the settings to frames: what is said, written, left alone and refused."""

import equinox as eqx
import jax
import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import type_in

from nlcwfs.config import Config, digest, load_config
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key

SMALL = [
    "beam.diameter_m=2",
    "curvature_sensor.distances_km=[-300, 300]",
    "detector.pixels_across_pupil=20",
    "detector.window_pixels=32",
    "simulation.light_oversampling=2",
    "atmosphere.opd_rms_nm=200",
    "atmosphere.photons=1e6",
]
LAYERS = [
    "atmosphere.layer_fractions=[0.4, 0.6]",
    "atmosphere.wind_speeds_m_per_s=[5, 10]",
    "atmosphere.wind_directions_deg=[0, 0]",
]
HIGH = [*LAYERS, "atmosphere.layer_heights_km=[0, 10]"]
BAND = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.2", "beam.spectrum.wavelengths=3"]


def settings(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


def test_layers_at_the_telescope_change_nothing():
    flat = load_config(None, [*SMALL, *LAYERS, "atmosphere.layer_heights_km=[0, 0]"])
    assert digest(flat) == digest(load_config(None, [*SMALL, *LAYERS]))
    assert digest(load_config(None, ["atmosphere.layer_heights_km=[0]"])) == digest(Config())
    assert digest(load_config(None, [*SMALL, *HIGH])) != digest(flat)
    simulator = ExposureSimulator.build(flat)
    assert simulator.high is None
    key = frame_key(seed=3, frame=1)
    old = ExposureSimulator.build(load_config(None, SMALL)).expose(key)
    np.testing.assert_array_equal(simulator.expose(key).photons, old.photons)


@pytest.mark.parametrize("more", [[], BAND], ids=["one colour", "band"])
def test_the_light_varies_from_exposure_to_exposure_around_its_mean(more):
    """The photons on the planes are those of the amplitude of the same key, and 1e6 on the mean."""
    simulator = ExposureSimulator.build(load_config(None, [*SMALL, *HIGH, *more]))
    assert simulator.high is not None
    share = np.asarray(simulator.weights, float)
    lit = share[np.ix_(share.any(1), share.any(0))]
    draw, lights = eqx.filter_jit(simulator.high.draw), []
    for frame in range(12):
        key = frame_key(seed=1, frame=frame)
        exposure = simulator.expose(key)
        lights.append(float(np.sum(exposure.photons.sum((1, 2)) / (1 - exposure.lost))))
        factor = np.asarray(draw(jax.random.split(key)[0]).factor)
        told = 1e6 * np.mean(np.sum(lit * np.abs(factor) ** 2, axis=(1, 2)))
        assert lights[-1] == pytest.approx(told, rel=1e-4)  # the colours of a flat band do not vary unlike by more
    spread = np.std(lights, ddof=1) / 1e6
    assert 1e-3 < spread < 0.1
    assert np.mean(lights) == pytest.approx(1e6, abs=1e6 * 4 * spread / np.sqrt(12))  # 4 sigma


def test_frames_are_written_and_the_scintillation_is_told(tmp_path):
    out = tmp_path / "frames.fits"
    done = type_in("simulate", *settings(*SMALL, *HIGH), "--out", out)
    said = done.output
    assert done.exit_code == 0, said
    assert "Scintillation: index 0.0" in said
    assert "at 0 km, " in said
    assert "at 10 km." in said
    with fits.open(out) as frames:
        exposure = ExposureSimulator.build(load_config(None, [*SMALL, *HIGH])).expose(frame_key(seed=0, frame=0))
        written = next(hdu.data for hdu in frames if hdu.data is not None and hdu.data.shape[-3:] == (2, 32, 32))
        np.testing.assert_allclose(np.asarray(written, float).reshape(2, 32, 32), exposure.frames.electrons, atol=1e-3)


@pytest.mark.parametrize(
    ("command", "change", "message"),
    [
        (
            "simulate",
            ["layer_heights_km=[10]"],
            "layer_heights_km: must be one per layer, 2 as in layer_fractions, got",
        ),
        ("simulate", ["layer_heights_km=[0, -1]"], "layer_heights_km[1]: must be a number from 0 to 100 [km], got -1"),
        ("simulate", ["opd_rms_nm=600", "layer_heights_km=[0, 100]"], "layer_heights_km: must leave the scintillation"),
        ("design", ["layer_heights_km=[0, 10]"], "layer_heights_km: must be 0 with nlcwfs design, got [0.0, 10.0]"),
    ],
)
def test_bad_heights_are_one_line(tmp_path, command, change, message):
    words = settings(*SMALL, *LAYERS, *(f"atmosphere.{one}" for one in change))
    out = ("--out", tmp_path / "out.fits") if command != "design" else ()
    done = type_in(command, *words, *out)
    assert done.exit_code == 2
    assert done.stderr.strip().splitlines()[-1].startswith(f"nlcwfs: atmosphere.{message}")


def test_a_loop_in_many_colours_refuses_heights_in_a_line(tmp_path):
    done = type_in("loop", *settings(*SMALL, *HIGH, *BAND), "--out", tmp_path / "run")
    assert done.exit_code == 2
    line = "nlcwfs: atmosphere.layer_heights_km: must be 0 with light of many colours in sequences and loops, got "
    assert done.stderr.strip().splitlines()[-1].startswith(line)
