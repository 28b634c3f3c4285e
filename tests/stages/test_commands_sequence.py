"""`nlcwfs simulate --sequence`: successive exposures of one sky that the wind moves."""

import jax
import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import SMALL, small_frames, type_in

from nlcwfs.atmosphere.settings import AtmosphereSettings
from nlcwfs.config import Config, digest, load_config
from nlcwfs.interop import read_frames
from nlcwfs.interop.provenance import settings_digest
from nlcwfs.simulation.exposure import frame_key
from nlcwfs.simulation.sequence import SequenceSimulator

NARROW = "atmosphere.screen_width_m=20"
"""Air that is drawn fast, and new for more than a second."""

PIXEL_PER_FRAME_HZ = 30.0
"""At 10 m/s the air moves by a third of a metre in an exposure: one pixel of the small sensor."""


def small_sequence(path, rate_hz, *options, **changes):
    return small_frames(path, "--sequence", "--rate", rate_hz, "--set", NARROW, *options, **changes)


def sequence_of(**changes):
    settings = (
        SMALL
        | {"simulation.rate_hz": 250.0, "atmosphere.screen_width_m": 20}
        | {key.replace("__", "."): value for key, value in changes.items()}
    )
    return SequenceSimulator.build(load_config(None, [f"{key}={value}" for key, value in settings.items()]))


@pytest.mark.parametrize(("direction_deg", "axis", "step"), [(0, 2, 1), (90, 1, 1), (180, 2, -1)])
def test_the_true_wavefronts_follow_the_wind_in_the_order_of_time(tmp_path, direction_deg, axis, step):
    path = tmp_path / "f.fits"
    small_sequence(path, PIXEL_PER_FRAME_HZ, "--frames", 4, atmosphere__wind_directions_deg=f"[{direction_deg}]")
    truth_m = fits.getdata(path, "TRUTH")
    assert truth_m.shape == (4, 36, 36)
    moved = np.roll(truth_m, step, axis)[:-1] - truth_m[1:]
    still = truth_m[:-1] - truth_m[1:]
    y, x = np.indices((36, 36)) - 17.5
    inside = np.hypot(y, x) < 10  # a pixel and a half from the rim: whole pixels, before and after
    # Each frame has its own piston; what is left is the interpolation, far below 0.1 nm.
    spread = [(each[inside] - each[inside].mean()).std() for each in moved]
    np.testing.assert_allclose(spread, 0.0, atol=0.1e-9)
    assert min((each[inside] - each[inside].mean()).std() for each in still) > 5e-9


def test_the_header_tells_rate_and_exposure_and_the_file_reads_back(tmp_path):
    path = tmp_path / "f.fits"
    result = small_sequence(path, 250, "--frames", 3, "--seed", 2)
    header = fits.getheader(path)
    assert (header["RATE"], header["EXPTIME"]) == (250.0, 0.004)
    frames = read_frames(path)
    assert (frames.rate_hz, frames.exposure_s, frames.electrons.shape) == (250.0, 0.004, (3, 4, 36, 36))
    assert "3 successive exposures at 250 Hz, 0.012 s of one sky" in result.stdout
    assert "10 m/s towards 0 deg. The light is summed over 4 moments of each exposure of 4 ms" in result.stdout
    small_frames(tmp_path / "single.fits", "--frames", 2)
    assert not {"RATE", "EXPTIME"} & set(fits.getheader(tmp_path / "single.fits"))


def test_the_same_seed_gives_the_same_sequence_however_long(tmp_path):
    for name, frames, seed in (("a", 2, 3), ("b", 4, 3), ("c", 2, 4)):
        small_sequence(tmp_path / f"{name}.fits", 250, "--frames", frames, "--seed", seed)
    short, long, other = (fits.getdata(tmp_path / f"{name}.fits") for name in "abc")
    np.testing.assert_array_equal(short, long[:2])
    assert np.any(other != short)
    short, long = (fits.getdata(tmp_path / f"{name}.fits", "TRUTH") for name in "ab")
    np.testing.assert_array_equal(short, long[:2])


def test_an_exposure_is_the_mean_of_its_moments():
    sequence = sequence_of(simulation__substeps=3, simulation__rate_hz=20.0, precision="double")
    exposure, still = sequence.expose(2), sequence.still
    # Frame 2 of 20 Hz lasts from 0.1 to 0.15 s; the middles of its three parts.
    moments_s = 0.1 + 0.05 * (np.arange(3) + 0.5) / 3
    parts = [still.expose_to(still.on_light(sequence.flow.opd_m(float(t))), jax.random.key(0)) for t in moments_s]
    light = np.mean([np.asarray(part.photons) for part in parts], axis=0)
    np.testing.assert_allclose(exposure.photons, light, rtol=1e-8, atol=1e-8 * light.max())
    opd_m = np.mean([np.asarray(part.opd_m) for part in parts], axis=0)
    np.testing.assert_allclose(exposure.opd_m, opd_m, atol=1e-9 * opd_m.std())
    assert np.abs(np.asarray(parts[0].photons) - light).max() > 0.01 * light.max()  # the air did move
    # The photons are those of the settings, as for one still exposure, and the noise is that of the frame's own key.
    lost = np.asarray(exposure.lost)
    np.testing.assert_allclose(exposure.photons.sum(axis=(1, 2)), 5e3 * (1 - lost), rtol=1e-6)
    again = still.detector.read(exposure.photons, jax.random.split(frame_key(seed=0, frame=2))[1])
    np.testing.assert_array_equal(exposure.frames.electrons, again.electrons)


def test_a_short_exposure_is_a_still_one():
    sequence = sequence_of(simulation__rate_hz=1e5, precision="double")
    still = sequence.still.expose_to(sequence.still.on_light(sequence.flow.opd_m(0.5e-5)), jax.random.key(0))
    photons = np.asarray(still.photons)
    # A tenth of a millimetre of wind; half of it is not seen, and what the mean loses is of second order.
    np.testing.assert_allclose(sequence.expose(0).photons, photons, atol=1e-4 * photons.max())


def test_too_few_moments_are_told(tmp_path):
    result = small_sequence(tmp_path / "f.fits", 5, "--set", "simulation.substeps=1")
    assert "warning: The air moves 2 m between the 1 moments of an exposure" in result.stderr
    result = small_sequence(tmp_path / "f.fits", 250)
    assert "The air moves" not in result.stderr


def test_several_layers_are_named_and_share_the_strength(tmp_path):
    winds = {"layer_fractions": "[0.75,0.25]", "wind_speeds_m_per_s": "[5,20]", "wind_directions_deg": "[30,-60]"}
    changes = {f"atmosphere__{key}": value for key, value in winds.items()}
    told = small_sequence(tmp_path / "f.fits", 250, "--frames", 2, **changes).stdout
    assert "5 m/s towards 30 deg (75 % of the turbulence), 20 m/s towards -60 deg (25 % of the turbulence)" in told
    flow = sequence_of(**changes).flow
    assert [float(np.hypot(*layer.pixels_per_s)) for layer in flow.layers] == pytest.approx([60.0, 240.0])  # 1/12 m


def test_a_sequence_interrupted_leaves_nothing(tmp_path, monkeypatch):
    whole = SequenceSimulator.expose

    def expose(self, frame):
        if frame == 1:
            raise KeyboardInterrupt
        return whole(self, frame)

    monkeypatch.setattr(SequenceSimulator, "expose", expose)
    words = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
    result = type_in(
        "simulate", "--sequence", "--rate", 250, "--frames", 3, "--out", tmp_path / "f.fits", "--set", NARROW, *words
    )
    assert result.exit_code == 130
    assert list(tmp_path.iterdir()) == []


REFUSED = {
    "no rate": ((), "simulation.rate_hz: must be given for a sequence (--rate HZ), got nothing"),
    "rate 0": (("--rate", 0), "simulation.rate_hz: must be a number greater than 0 [Hz], got 0.0"),
    "rate below 0": (("--rate", -5), "simulation.rate_hz: must be a number greater than 0 [Hz], got -5.0"),
    "too long": (
        ("--rate", 10, "--frames", 86),
        "simulation.frames: must be at most 85 at 10 Hz: after 8.54 s this air repeats itself (atmosphere.screen_",
    ),
    "too slow": (("--rate", 0.1), "simulation.rate_hz: must be at least 0.117 Hz: after 8.54 s this air repeats"),
    "narrow air": (
        ("--rate", 10, "--set", "atmosphere.screen_width_m=9"),
        "atmosphere.screen_width_m: must be from 10.67 to 1000 m on cells of 0.0833 m, got 9",
    ),
    "air too wide": (("--rate", 10, "--set", "atmosphere.screen_width_m=2000"), "must be from 10.67 to 1000 m"),
    "two winds for a layer": (
        ("--rate", 10, "--set", "atmosphere.wind_speeds_m_per_s=[1,2]"),
        "atmosphere.wind_speeds_m_per_s: must be one per layer, 1 as in layer_fractions, got [1, 2]",
    ),
    "shares": (
        ("--rate", 10, "--set", "atmosphere.layer_fractions=[0.9]"),
        "layer_fractions: must sum to 1, got [0.9]",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_sequences_that_cannot_be_made_are_refused_in_a_line(tmp_path, name):
    options, rule = REFUSED[name]
    words = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
    result = type_in("simulate", "--sequence", "--out", tmp_path / "f.fits", *words, *options)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert rule in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_rate_without_a_sequence_is_refused(tmp_path):
    result = type_in("simulate", "--rate", 100, "--out", tmp_path / "f.fits")
    assert result.exit_code == 2
    assert result.stderr == "nlcwfs: --rate: must come with --sequence, got 100 without\n"


def test_a_star_shines_into_a_sequence_and_not_into_single_exposures(tmp_path):
    star = {"atmosphere__photons_per_s": 5e6}
    sequence = small_sequence(tmp_path / "s.fits", 250, **star)
    assert fits.getheader(tmp_path / "s.fits")["PHOTONS"] == pytest.approx(5e6 / 250)
    assert "Light: 20000 photons in one exposure" in sequence.stdout
    assert "has no length" not in sequence.stderr
    single = small_frames(tmp_path / "f.fits", **star, atmosphere__photons=3e4)
    assert fits.getheader(tmp_path / "f.fits")["PHOTONS"] == pytest.approx(3e4)
    assert "A single exposure has no length: atmosphere.photons rules" in single.stderr


def test_wind_that_is_default_is_not_in_the_fingerprint_and_any_other_is():
    # Fingerprints that were taken before there was wind still hold.
    assert not {"layer_fractions", "screen_width_m"} & set(AtmosphereSettings().model_dump())
    assert not {"rate_hz", "substeps"} & set(Config().simulation.model_dump(mode="json"))
    for change in ("simulation.rate_hz=10", "simulation.substeps=3", "atmosphere.wind_directions_deg=[1]"):
        changed = load_config(None, [change])
        assert digest(changed) != digest(Config())
        assert settings_digest(changed.model_dump(mode="json")) != settings_digest(Config().model_dump(mode="json"))
        assert Config.model_validate(changed.model_dump()) == changed
