"""`estimation.map.amplitude` from the settings to the wavefront's file: what is written, left alone and refused."""

import numpy as np
import pytest
from astropy.io import fits
from tests.stages.command_line import small_frames, type_in

TOLD = [
    "estimation.map.amplitude=estimated",
    "estimation.prior.layer_heights_km=[0, 10]",
    "estimation.prior.scintillation_index=0.07",
]
QUICK = ["estimation.map.healings=0", "estimation.modes=40"]
LAYERS = {
    "atmosphere__layer_fractions": [0.5, 0.5],
    "atmosphere__wind_speeds_m_per_s": [5, 10],
    "atmosphere__wind_directions_deg": [0, 0],
    "atmosphere__layer_heights_km": [0, 10],
}


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    path = tmp_path_factory.mktemp("twinkling") / "frames.fits"
    small_frames(path, "--frames", 2, **LAYERS)
    return path


def settings(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


def test_the_amplitude_is_written_when_it_is_asked_for_and_survives_a_resumed_run(frames, tmp_path):
    out = tmp_path / "wavefront.fits"
    done = type_in("reconstruct", frames, "--out", out, *settings(*TOLD, *QUICK))
    assert done.exit_code == 0, done.output
    wavefront, amplitude = np.asarray(fits.getdata(out)), np.asarray(fits.getdata(out, "AMPLITUDE"))
    assert amplitude.shape == wavefront.shape
    np.testing.assert_array_equal(np.isnan(amplitude), np.isnan(wavefront))
    assert np.nanmin(amplitude) > 0
    assert 1e-4 < np.nanstd(amplitude) < 0.1
    light = np.isfinite(amplitude)
    # mean 0 of the logarithm over the light: a few pixels of the rim hold part of one
    assert abs(np.mean(np.log(amplitude[light]))) < 0.1 * np.std(np.log(amplitude[light]))
    again = type_in("reconstruct", frames, "--out", out, "--resume", *settings(*TOLD, *QUICK))
    assert "Done before: 2 frames" in again.output
    np.testing.assert_array_equal(np.asarray(fits.getdata(out, "AMPLITUDE")), amplitude)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            settings(TOLD[0]),
            "estimation.prior.layer_heights_km: must hold a height above 0 with estimation.map.amplitude",
        ),
        (
            [*settings(*TOLD), "--method", "linear"],
            "estimation.map.amplitude: must be known with estimation.method = linear, got estimated",
        ),
        (
            [*settings(*TOLD), "--sequence"],
            "estimation.map.amplitude: must be known with frames that follow each other: only frames on their own",
        ),
    ],
)
def test_where_it_cannot_work_one_line_says_so(frames, tmp_path, options, message):
    if "--sequence" in options:
        frames = tmp_path / "sequence.fits"
        small_frames(frames, "--sequence", "--rate", 250, "--set", "atmosphere.screen_width_m=20", "--frames", 2)
    done = type_in("reconstruct", frames, "--out", tmp_path / "out.fits", *options)
    assert done.exit_code == 2, done.output
    assert message in done.stderr.strip().splitlines()[-1]


def test_a_loop_refuses_it(tmp_path):
    done = type_in("loop", "--out", tmp_path / "loop", *settings(*TOLD))
    assert done.exit_code == 2, done.output
    assert "estimation.map.amplitude: must be known with nlcwfs loop" in done.stderr.strip().splitlines()[-1]
