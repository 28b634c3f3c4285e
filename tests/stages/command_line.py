"""What the tests of the commands share: how to type one, and a small sensor that compiles fast."""

from typer.testing import CliRunner

from nlcwfs.cli import app

SMALL = {
    "beam.wavelength_um": 0.65,
    "atmosphere.photons": 2e4,
    "atmosphere.opd_rms_nm": 150,
    "detector.pixels_across_pupil": 24,
    "detector.window_pixels": 36,
}
"""Weak turbulence on 24 pixels: every sky is found."""


def type_in(*words):
    """The result of a command; an error that is not the user's comes out as itself."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def small_frames(path, *options, **changes):
    """Simulate the small sensor; a double underscore in a name stands for the dot."""
    settings = SMALL | {key.replace("__", "."): value for key, value in changes.items()}
    sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    result = type_in("simulate", "--out", path, *sets, *options)
    assert result.exit_code == 0, result.output
    return result
