"""`nlcwfs demo`: everything once, with a picture at the end."""

from pathlib import Path

from nlcwfs.commands.console import say, working
from nlcwfs.commands.figure import case_lines
from nlcwfs.commands.reconstruct import ReconstructOptions, reconstruct
from nlcwfs.commands.simulate import SimulateOptions, simulate
from nlcwfs.config import load_config, to_toml
from nlcwfs.errors import FileFormatError
from nlcwfs.interop.atomic_write import atomic_write
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.studies.single_frame import PAPER_CASE, judged


def run_demo(folder: Path, *, seed: int) -> int:
    """Simulate the paper's single frame, reconstruct it from its file, draw it; returns the exit code.

    Raises:
        NlcwfsError: If the folder cannot be made or written.
    """
    config = load_config(None, [*PAPER_CASE, f"seed={seed}"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder}: must be a folder that can be made, got {error.strerror}") from None
    settings, frames, wavefront, picture = (
        folder / name for name in ("config.toml", "frames.fits", "wavefront.fits", "single-frame.png")
    )
    with atomic_write(settings) as temporary:
        temporary.write_text(to_toml(config), encoding="utf-8")
    say("A star through an 8 m telescope in turbulence, as in Guyon (2010), sec. 4.1.\n")
    say("1. Simulate the four images of the pupil out of focus:")
    simulate(config, SimulateOptions(frames, warnings=False))
    say("\n2. Reconstruct the wavefront from these images alone:")
    result = reconstruct(load_config(settings), ReconstructOptions(frames, wavefront))
    found = result.wavefront.finished().get(0)
    if found is None:
        return result.exit_code
    say("\n3. Look at it:")
    with working("Drawing"):
        from nlcwfs.studies.pictures import draw_single_frame, save_picture

        simulator = ExposureSimulator.build(config)
        exposure = simulator.expose(frame_key(seed=seed, frame=0))
        case = judged(simulator, exposure, result.frames, found)
        save_picture(draw_single_frame(case), picture)
    for line in case_lines(case)[:2]:
        say(line)
    say(f"Wrote {picture}.")
    say(
        f"\nError of the wavefront: {case.residual_rms_nm:.1f} nm rms, scored on the grid of the light "
        "(the paper: 34.4 nm, one frame)."
    )
    say(
        "\nWhat next:\n"
        f"  look at {picture}, and at {wavefront} in ds9\n"
        f"  nlcwfs demo --seed {seed + 1}                     another sky\n"
        f"  nlcwfs simulate {settings} --frames 10    more frames, other settings with --set\n"
        "  nlcwfs reconstruct YOUR_FRAMES.fits      frames of your own sensor\n"
        "  nlcwfs config > my.toml                  every setting, explained"
    )
    return result.exit_code
