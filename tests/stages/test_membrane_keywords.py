"""A membrane from the settings to the header of frames and to the model; who refuses it, in a line."""

import numpy as np
import pytest
from astropy.io import fits
from tests.loop.small_loop import small
from tests.stages.command_line import small_frames, type_in

from nlcwfs.config import Config, digest, load_config
from nlcwfs.errors import FileFormatError, SettingsError
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.interop import read_frames
from nlcwfs.interop.frames_sensor import sensor_geometry
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.sensor import build_sensor
from nlcwfs.simulation.exposure import ExposureSimulator
from nlcwfs.simulation.known_sensor import geometry_of

SINE = {"curvature_sensor__membrane": "sine", "curvature_sensor__membrane_dead_share": 0.5}
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


def test_the_loop_s_model_and_that_of_frames_are_told_the_same(simulated):
    told = ["curvature_sensor.membrane=sine", "curvature_sensor.membrane_dead_share=0.5", FOLLOWED]
    config = small(*told)
    known = geometry_of(config, ExposureSimulator.build(config))
    assert (known.motion, known.moments, known.dead_share) == ("sine", 6, 0.5)


def test_reconstruct_follows_the_membrane_if_it_is_asked_to(simulated, tmp_path):
    path, _ = simulated
    error_nm = {}
    for name, words in {"rests": (), "moves": ("--set", FOLLOWED)}.items():
        result = type_in("reconstruct", path, "--out", tmp_path / f"{name}.fits", *words)
        error_nm[name] = fits.getheader(tmp_path / f"{name}.fits")["ERR_NM"]
        warned = "MEMBRANE: the planes are taken to rest; method map follows the sine" in result.stderr
        assert warned == (name == "rests")
    assert result.exit_code == 0
    assert error_nm["moves"] < 0.7 * error_nm["rests"], error_nm


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
