"""A membrane from the settings to the header of frames and to the model; who refuses it, in a line."""

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from tests.loop.small_loop import small
from tests.stages.command_line import small_frames, type_in

from nlcwfs.commands.reconstruct_report import frame_warnings
from nlcwfs.config import Config, digest, load_config
from nlcwfs.curvature_sensor.membrane import moments_of_model
from nlcwfs.errors import FileFormatError, SettingsError
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.interop import read_frames
from nlcwfs.interop.frame_times import FrameTimes
from nlcwfs.interop.frames_reconstruction import FramesReconstructor
from nlcwfs.interop.frames_sensor import sensor_geometry
from nlcwfs.interop.sequence_reconstruction import SequenceRun
from nlcwfs.interop.simulated_frames import Shot, frames_of
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.sensor import build_sensor
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of

SINE = {
    "curvature_sensor__membrane": "sine",
    "curvature_sensor__membrane_dead_share": 0.5,
    "curvature_sensor__distances_km": "[-1000, 1000]",
    "mirror__cutoff_cpa": 4,
}
FOLLOWED = "estimation.map.membrane_moments=6"
HEADER = {"BUNIT": "electron", "WAVELEN": 0.85e-6, "PIXSCALE": 0.8, "TELDIAM": 8.0, "ZPLANE1": -2e6, "ZPLANE2": 2e6}


def written(path, **more):
    light = np.random.default_rng(3).poisson(40.0, (2, 12, 14)).astype(float)
    fits.writeto(path, light, fits.Header({**HEADER, **more}), overwrite=True)
    return path


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    path = tmp_path_factory.mktemp("membrane") / "frames.fits"
    return path, small_frames(path, **SINE)


def test_simulate_tells_the_motion_and_the_light_that_is_left(simulated):
    path, result = simulated
    header = fits.getheader(path)
    assert (header["MEMBRANE"], header["MEMBDEAD"]) == ("sine", 0.5)
    assert header["PHOTONS"] == pytest.approx(1e4)  # half of 2e4 falls into the dead time
    assert "moments; a model follows it with" in result.output
    assert "50% of the light lost in its dead time" in result.output
    geometry = sensor_geometry(read_frames(path), moments=6)
    assert (geometry.motion, geometry.moments, geometry.dead_share) == ("sine", 6, 0.5)


def test_without_a_membrane_the_header_and_the_settings_are_as_they_were(tmp_path):
    small_frames(tmp_path / "f.fits")
    assert not {"MEMBRANE", "MEMBDEAD"} & set(fits.getheader(tmp_path / "f.fits"))
    assert digest(load_config(None, ["estimation.map.membrane_moments=1"])) == digest(Config())
    assert digest(load_config(None, [FOLLOWED])) != digest(Config())
    assert "membrane_moments" not in MapSettings().model_dump(mode="json")


def test_frames_and_loops_make_the_same_model_of_the_same_sensor(tmp_path):
    """Two colours, five moments: the light of the file's header is that of the settings."""
    band = ("beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.2", "curvature_sensor.lenses=ideal")
    model = ("estimation.map.membrane_moments=5", "estimation.map.wavelengths=2", "beam.spectrum.wavelengths=2")
    sine = ("curvature_sensor.membrane=sine", "curvature_sensor.membrane_dead_share=0.2")
    config = small(*band, *model, *sine)
    simulator = ExposureSimulator.build(config)
    known = geometry_of(config, simulator)
    frames = frames_of(config, simulator, [Shot.of(simulator.expose(frame_key(seed=0, frame=0)))])
    told = sensor_geometry(frames, wavelengths=2, moments=5)
    ours, theirs = (one.in_colour(known.frame, dtype="float64") for one in (known, told))
    assert ours.transfer.shape[:2] == (10, 4)
    np.testing.assert_allclose(theirs.spectrum.shares, ours.spectrum.shares, rtol=1e-9)
    np.testing.assert_allclose(theirs.transfer, ours.transfer, atol=1e-9)
    assert known.in_motion(known.frame, dtype="float64").transfer.shape[:2] == (5, 4)


def test_reconstruct_follows_the_membrane_if_it_is_asked_to(simulated):
    frames = read_frames(simulated[0])
    twice = {name: np.repeat(getattr(frames, name), 2, 0) for name in ("electrons", "masked")}
    frames = dataclasses.replace(frames, **twice, has_frame_axis=True, rate_hz=100.0)
    light = {"distance_m": 1e6, "wavelength_m": 0.65e-6, "diameter_m": 8.0, "dead_share": 0.5}
    needed = moments_of_model("sine", **light)
    for moments in (1, 9):
        settings = EstimationSettings(map=MapSettings(membrane_moments=moments))
        single = FramesReconstructor.build(frames, settings).solver
        movie = SequenceRun.build(frames, settings, FrameTimes(0.01, (0, 1))).solver
        assert (single.level.moment_count, movie.solver.level.moment_count) == (moments, moments)
        assert (movie.ffts > 500) == (moments > 1)  # of each moment as many as of one
        warned = [one for one in frame_warnings(frames, settings) if one.startswith("MEMBRANE")]
        rule = "the planes are taken to rest; method map follows the sine, estimation.map.membrane_moments="
        assert warned == ([] if moments > 1 else [f"MEMBRANE: {rule}{needed}"])


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"MEMBRANE": "triangle"}, "MEMBRANE: must be 'sine' or 'square', got 'triangle'"),
        ({"MEMBRANE": True}, "MEMBRANE: must be 'sine' or 'square', got True"),
        ({"MEMBRANE": "sine", "MEMBDEAD": 1.0}, "MEMBDEAD: must be a share of at least 0 and below 1, got 1"),
        ({"MEMBDEAD": 0.1}, "MEMBDEAD: must be left out without MEMBRANE, got 0.1"),
        (
            {"MEMBRANE": "sine", "ZPLANE2": 3e6},
            "ZPLANE1..2: must be pairs with MEMBRANE, one plane at +z for each at -z, got -2e+06, 3e+06",
        ),
    ],
)
def test_a_header_that_no_membrane_writes_is_refused(tmp_path, more, told):
    with pytest.raises(FileFormatError) as refusal:
        read_frames(written(tmp_path / "f.fits", **more))
    assert str(refusal.value) == f"{tmp_path / 'f.fits'}: {told}"


def test_a_square_membrane_rests_in_the_model_too(tmp_path):
    frames = read_frames(written(tmp_path / "f.fits", MEMBRANE="Square", MEMBDEAD=0.2))
    assert (frames.membrane, frames.membrane_dead_share) == ("square", 0.2)
    geometry = sensor_geometry(frames, moments=6)
    assert geometry.in_colour(geometry.frame.finer(2), dtype="float32") is None


@pytest.mark.parametrize("motion", ["sine", "square"])
@pytest.mark.parametrize("sensor", ["pyramid", "shack-hartmann", "linear-curvature"])
def test_sensors_without_such_planes_refuse_it(sensor, motion):
    rule = f'must be "none" with loop.sensor = "{sensor}", got "{motion}"'
    with pytest.raises(SettingsError, match=f"^curvature_sensor.membrane: {rule}$"):
        LoopLight.build(small(f"curvature_sensor.membrane={motion}", f"loop.sensor={sensor}"))


def test_the_matrix_of_the_linear_regime_refuses_it():
    config = small("curvature_sensor.membrane=sine", "loop.handover=true")
    rule = 'must be false with curvature_sensor.membrane = "sine", got true'
    with pytest.raises(SettingsError, match=f"^loop.handover: {rule}$"):
        build_sensor(config, LoopLight.build(config))


@pytest.mark.parametrize("command", ["design", "sensitivity"])
def test_commands_that_know_planes_at_rest_alone_refuse_it(tmp_path, command):
    settings = ("atmosphere.photons_per_s=3e5", "curvature_sensor.membrane=sine")
    result = type_in(command, "--out", tmp_path / "x", *(f"--set={one}" for one in settings))
    assert result.exit_code == 2
    told = f'curvature_sensor.membrane: must be "none" with nlcwfs {command}, got "sine"'
    assert result.stderr.strip().splitlines() == [f"Error: {told}"] or result.stderr.strip().endswith(told)
    assert len(result.stderr.strip().splitlines()) == 1
