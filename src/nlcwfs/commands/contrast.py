"""`nlcwfs contrast`: the halo of each sensor against the angle, at several rates and the best; and that of a loop."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from nlcwfs.commands.console import device, make_folder, say, undisturbed, use_precision, warn
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.interop import Provenance, atomic_write, check_writable
from nlcwfs.simulation.closed_loop.loop import LoopState, Record
from nlcwfs.simulation.closed_loop.run import Watch
from nlcwfs.studies.contrast_figure import draw_contrast
from nlcwfs.studies.contrast_loop import loop_rows, run_behind_coronagraph
from nlcwfs.studies.contrast_report import answer, over_skies, setting_in_words, told_rows, write_report
from nlcwfs.studies.contrast_table import ContrastStudy, read_table, write_table
from nlcwfs.studies.study_table import Row

TABLE, LOOPS, PICTURE, PAGE = "results.ecsv", "loop.ecsv", "contrast.png", "README.md"

IDENTITY = ("sensor", "rate_hz", "photons_per_s", "static_nm", "seed", "angle_mas")
"""Columns that tell one row of the table of loops from another."""

NEEDED = (*IDENTITY, "flux_factor", "contrast", "with_wings", "measured")
"""Columns of the table of loops that are used."""


def contrast(config: Config, out: Path, *, quiet: bool) -> None:
    """Compute the table, draw the figure and write the page; what loops have shown comes in where it is stored.

    Raises:
        NlcwfsError: If settings or a table cannot be used, or the folder cannot be written.
    """
    study = ContrastStudy.of(config)
    _prepare(out)
    loops = read_table(out / LOOPS, NEEDED)
    rows = study.rows()
    stamp = Provenance.collect(config.model_dump(mode="json"), seed=None, device="cpu")
    with undisturbed():
        write_table(out / TABLE, rows, stamp)
        with atomic_write(out / PICTURE) as temporary:
            draw_contrast(rows, over_skies(_of_star(study, loops))).savefig(temporary, dpi=150, format="png")
        write_report(out / PAGE, study, PICTURE, loops)
    for line in study.blind():
        warn(line)
    if not quiet:
        _show(study)
    say(f"{answer(study)}.", quiet=quiet)
    say(f"Wrote {TABLE}, {PICTURE} and {PAGE} in {out}.", quiet=quiet)


def contrast_of_loop(config: Config, out: Path, *, quiet: bool) -> None:
    """Run a loop behind an ideal coronagraph and put what it shows into the table of loops.

    A row replaces that of the same sensor, rate, star, seed and angle.

    Raises:
        NlcwfsError: If settings cannot be used, the loop does not close, or the folder cannot be written.
    """
    if config.loop.sensor == "shack-hartmann":
        raise SettingsError("loop.sensor", "must be curvature or ideal for the halo of a loop", config.loop.sensor)
    if config.beam.pupil_map is not None:
        raise SettingsError("beam.pupil_map", "must be left out of a contrast", config.beam.pupil_map)
    study = ContrastStudy.of(config)
    _prepare(out)
    before = read_table(out / LOOPS, NEEDED)
    use_precision(config.precision)
    say("Making the air, the mirror and the reconstructor ...", quiet=quiet)
    with _watched(config.loop.frames, quiet=quiet) as watch:
        loop, state = run_behind_coronagraph(config, watch)
    rows = loop_rows(config, loop, state, study.told_mas)
    stamp = Provenance.collect(config.model_dump(mode="json"), seed=config.seed, device=device())
    digest = stamp.settings_digest[:16]
    rows = [row | {"commit": stamp.commit, "digest": digest} for row in rows]
    with undisturbed():
        new = {_identity(row) for row in rows}
        write_table(out / LOOPS, [*(row for row in before if _identity(row) not in new), *rows], stamp)
    for row in rows:
        ratio = float(row["measured"]) / float(row["contrast"])
        say(
            f"{row['angle_mas']:g} mas: measured {row['measured']:.2e}, closed form {row['contrast']:.2e}, "
            f"ratio {ratio:.2f}; flux factor {row['flux_factor']:.2f}",
            quiet=quiet,
        )
    say(f"Wrote {out / LOOPS}; without --loop the same command draws it.", quiet=quiet)


def _identity(row: Row) -> tuple:
    return tuple(row[name] for name in IDENTITY)


def _of_star(study: ContrastStudy, loops: list[Row]) -> list[Row]:
    """Loops with the photons of the study."""
    return [row for row in loops if math.isclose(float(row["photons_per_s"]), study.halo.photons_per_s, rel_tol=1e-6)]


def _prepare(out: Path) -> None:
    """Make the folder, and refuse one that cannot be written."""
    make_folder(out)
    check_writable(out / TABLE)


@contextmanager
def _watched(total: int, *, quiet: bool) -> Iterator[Watch]:
    """A bar with what is left of the wavefront; nothing when stderr is not a terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("loop", total=total)

        def watch(state: LoopState, records: list[Record]) -> None:
            bar.update(task, completed=state.frame, description=f"{records[-1].rms_nm:.0f} nm")

        yield watch


def _show(study: ContrastStudy) -> None:
    """The numbers on the terminal."""
    say(setting_in_words(study))
    table = Table(box=None, pad_edge=False)
    for name in ("sensor", "", *(f"{angle:.3g} mas" for angle in study.told_mas)):
        table.add_column(name, justify="left" if name in ("sensor", "") else "right", no_wrap=True)
    before = ""
    for sensor, *cells in told_rows(study):
        table.add_row("" if sensor == before else sensor, *cells)
        before = sensor
    Console(width=60 + 12 * len(study.told_mas)).print(table)
