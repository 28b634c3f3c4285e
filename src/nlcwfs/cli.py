"""The command line: what may be typed; what it does is in `nlcwfs.commands`.

Modules that need JAX are imported inside the commands, so that the help comes at once.
"""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from nlcwfs.commands.console import INTERRUPTED, mendable
from nlcwfs.commands.options import ConfigArgument, QuietOption, SeedOption, SetOption
from nlcwfs.errors import SettingsError

app = typer.Typer(
    name="nlcwfs",
    help="The toolkit of the non-linear curvature wavefront sensor: from defocused pupil images to a wavefront. "
    "New here? Type: nlcwfs demo",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done; 1 done, but a wavefront is not to be believed (written and flagged); 2 something "
    "that you can mend, told in one line; 130 interrupted, what was done is kept.",
)


@app.command()
@mendable
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the files; made if it is not there.")] = Path("demo"),
    seed: SeedOption = None,
) -> None:
    """Simulate a star through an 8 m telescope, reconstruct its wavefront, and draw it: about a minute."""
    from nlcwfs.commands.demo import run_demo

    raise typer.Exit(run_demo(out, seed=seed or 0))


@app.command()
@mendable
def simulate(
    config: ConfigArgument = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="FITS file to write.")] = Path("frames.fits"),
    frames: Annotated[
        int | None, typer.Option(help="How many exposures: each of another sky, or one after the other.")
    ] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Successive exposures of one sky, which the wind moves.")
    ] = False,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Exposures in a second, with --sequence.")] = None,
    adu: Annotated[bool, typer.Option("--adu", help="Write readings (bias removed) instead of electrons.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate frames of a star, with the true wavefront beside them.

    The light travels on a finer and wider grid than any reconstructor's model. In a sequence the true wavefront is
    its mean over each exposure.
    """
    from nlcwfs.commands.simulate import SimulateOptions, read_config
    from nlcwfs.commands.simulate import simulate as run

    chosen = read_config(config, settings or [], frames=frames, seed=seed, rate_hz=rate, sequence=sequence)
    run(chosen, SimulateOptions(out, adu, quiet, sequence=sequence))


@app.command()
@mendable
def reconstruct(
    frames: Annotated[
        Path, typer.Argument(metavar="FRAMES.fits", help="Frames (plane, y, x) or (frame, plane, y, x).")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="FITS file to write.")] = Path("wavefront.fits"),
    plot: Annotated[Path | None, typer.Option(metavar="PICTURE.png", help="Draw frames and wavefront, too.")] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Settings, of which [estimation] counts.")
    ] = None,
    settings: SetOption = None,
    method: Annotated[str | None, typer.Option(help="How: map (default), gerchberg-saxton, or linear.")] = None,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Frames follow each other (RATE or TIME): each starts from the last.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on after an interruption, with the same --out.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Reconstruct the wavefront behind the frames of a sensor.

    Telescope, planes and pixels are read from the header. Each frame is an exposure of its own, unless --sequence says
    that they follow each other. Ctrl-C keeps what is done.
    """
    from nlcwfs.commands.reconstruct import ReconstructOptions, read_estimation
    from nlcwfs.commands.reconstruct import reconstruct as run

    chosen = read_estimation(config, settings or [], method)
    raise typer.Exit(run(chosen, ReconstructOptions(frames, out, plot, resume, quiet, sequence)).exit_code)


@app.command()
@mendable
def config(
    check: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Only say whether a file is good.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the settings to a file.")] = None,
) -> None:
    """Print every setting with its default and its meaning, as a file to start from."""
    from nlcwfs.commands.config_file import check_config, print_config

    if check is not None:
        check_config(check)
    else:
        print_config(out)


@app.command()
@mendable
def figure(
    name: Annotated[str, typer.Argument(metavar="NAME", help="single-frame: the paper's eight panels.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Picture to write; default NAME.png.")] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
) -> None:
    """Draw a figure of Guyon (2010) with our numbers."""
    from nlcwfs.commands.figure import draw_figure

    draw_figure(name, out, seed=seed, overrides=settings or [])


@app.command()
@mendable
def loop(
    config: ConfigArgument = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run; made if it is not there.")] = Path("run"),
    seconds: Annotated[float | None, typer.Option(help="Simulated time.")] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Exposures in a second.")] = None,
    seed: SeedOption = None,
    settings: SetOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Close the loop: air, mirror, sensor, wavefront, command; numbers, telemetry, image and picture in a folder.

    Ends with 1 when the loop is not closed at the end.
    """
    from nlcwfs.commands.loop import loop as run
    from nlcwfs.config import load_config

    named = {"loop.seconds": seconds, "loop.rate_hz": rate, "seed": seed}
    chosen = [*(settings or []), *(f"{key}={value}" for key, value in named.items() if value is not None)]
    raise typer.Exit(run(load_config(config, chosen), out, resume=resume, quiet=quiet))


@app.command()
@mendable
def study(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Holds study.toml, such as studies/01-single-frame.")
    ],
    only: Annotated[
        list[str] | None, typer.Option(metavar="START", help="Only cases whose names start so; repeatable.")
    ] = None,
    screens: Annotated[int | None, typer.Option(min=1, help="Fewer screens, for a quick look.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Run what the table of a study does not hold yet, draw its figures and write its page.

    Each case is on disk as soon as it is done; an interrupted study goes on where it was.
    """
    from nlcwfs.commands.study import study as run

    run(folder, only=tuple(only or ()), screens=screens, quiet=quiet)


@app.command()
@mendable
def sweep(
    study: Annotated[
        Path, typer.Argument(metavar="STUDY", help="Folder with sweep.toml, or such a file: grids of settings.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of table and page; default: that of the sweep.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Processes of this machine; default: its cores.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="Let the workers of a dask scheduler compute.")
    ] = None,
    wait: Annotated[
        float, typer.Option(min=0, metavar="SECONDS", help="Patience for the first worker of a scheduler.")
    ] = 600.0,
    quiet: QuietOption = False,
) -> None:
    """Run the loop at every point of a grid of settings, on many workers; one table, one page.

    Each point is in results.ecsv as soon as it is done, and is not run again. Ends with 1 when points failed.
    """
    from nlcwfs.commands.sweep import SweepOptions
    from nlcwfs.commands.sweep import sweep as run

    if scheduler is not None and workers is not None:
        raise SettingsError("--workers", "must be left out with --scheduler, which has its own", workers)
    raise typer.Exit(run(study, SweepOptions(out, workers, scheduler, wait, quiet)))


@app.command()
@mendable
def contrast(
    config: ConfigArgument = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of table, figure and page.")] = Path("contrast"),
    loop: Annotated[
        bool, typer.Option("--loop", help="Measure it: run the loop of [loop] behind an ideal coronagraph.")
    ] = False,
    settings: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Predict the halo around a star: contrast C2 of lag and photon noise, by angle, rate and sensor.

    Tells the best rate of each angle, and the gain of the last sensor over the first. What --loop has put into the same
    folder is drawn beside it.
    """
    from nlcwfs.commands.contrast import contrast as predict
    from nlcwfs.commands.contrast import contrast_of_loop as measure
    from nlcwfs.config import load_config

    (measure if loop else predict)(load_config(config, settings or []), out, quiet=quiet)


@app.command()
@mendable
def sensitivity(
    study: Annotated[
        Path | None,
        typer.Argument(metavar="[STUDY]", help="Folder with sensitivity.toml, or such a file; default: the paper's."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder of table, figure and page; default: that of the study.")
    ] = None,
    rms_rad: Annotated[
        list[float] | None, typer.Option(metavar="RAD", help="Roughness of the wavefront, rms; repeatable.")
    ] = None,
    cpa: Annotated[list[float] | None, typer.Option(metavar="CYCLES", help="Cycles per aperture; repeatable.")] = None,
    sensor: Annotated[list[str] | None, typer.Option(metavar="TEXT", help="Only sensors named so; repeatable.")] = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Photons that each sensor needs at each spatial frequency, relative to the quantum limit."""
    from nlcwfs.commands.sensitivity import SensitivityOptions
    from nlcwfs.commands.sensitivity import sensitivity as run

    typed = tuple(rms_rad or ()), tuple(cpa or ()), tuple(sensor or ()), tuple(settings or ())
    raise typer.Exit(run(SensitivityOptions(study, out, *typed, quiet)))


@app.command()
@mendable
def design(
    config: ConfigArgument = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the design; made if not there.")] = Path("design"),
    planes: Annotated[int, typer.Option(help="How many planes, 2 or 4, in symmetric pairs.")] = 4,
    window: Annotated[float, typer.Option(help="Width of the detector's window in telescope diameters.")] = 1.45,
    pixels: Annotated[int | None, typer.Option(help="Pixels across the pupil; default 2.75 for each cycle.")] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Exposures in a second; default: the best.")] = None,
    rms_nm: Annotated[float | None, typer.Option("--rms-nm", help="What may be left; told when impossible.")] = None,
    keep_planes: Annotated[bool, typer.Option("--keep-planes", help="Judge the planes that are set.")] = False,
    seed: SeedOption = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Design a sensor: planes, light split, pixels, window and rate for a telescope, star, air and mirror.

    Writes settings for nlcwfs loop, a table and a figure; ends with 2 when a requirement cannot be met.
    """
    from nlcwfs.commands.design import design as run
    from nlcwfs.config import load_config
    from nlcwfs.simulation.design.requirements import Wishes

    chosen = load_config(config, [*(settings or []), *([] if seed is None else [f"seed={seed}"])])
    raise typer.Exit(run(chosen, Wishes(planes, window, pixels, rate, rms_nm, keep_planes), out, quiet=quiet))


def main() -> None:
    """Entry point of the command `nlcwfs`."""
    try:
        app()
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        # JAX may be interrupted in the middle of compiling; taking it down in order then crashes now and then.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
