"""`nlcwfs sweep`: run the points that a sweep's table does not hold yet, on many workers, and write its page."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import NamedTuple

from distributed import Client
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nlcwfs.commands.console import NOT_A_SUCCESS, complain, make_folder, say, undisturbed, warn
from nlcwfs.interop import Provenance, check_writable
from nlcwfs.studies.image_profiles import keep_profiles
from nlcwfs.studies.study_figures import draw_figures
from nlcwfs.studies.study_table import Row, StudyTable
from nlcwfs.studies.sweep_cluster import connected, cores, local_cluster
from nlcwfs.studies.sweep_figures import check_figures, drawings_of
from nlcwfs.studies.sweep_points import Point, Sweep, read_sweep, sweep_file
from nlcwfs.studies.sweep_report import write_sweep_report
from nlcwfs.studies.sweep_run import WORKERS, missing_points, rows_of, run_sweep

TABLE = "results.ecsv"


class SweepOptions(NamedTuple):
    """What was typed.

    Attributes:
        out: Folder of the table; that of the sweep when left out.
        workers: Processes of this machine; its cores when left out.
        scheduler: Address of a scheduler that has its own workers.
        wait_s: Patience for the first of them.
        quiet: Whether only warnings are told.
    """

    out: Path | None
    workers: int | None
    scheduler: str | None
    wait_s: float
    quiet: bool


def sweep(study: Path, options: SweepOptions) -> int:
    """Run a sweep.

    Returns:
        Exit code: 0 when every point has its numbers, 1 when some failed.

    Raises:
        NlcwfsError: If the sweep's file or its table cannot be used, or there is nobody to compute.
    """
    asked, points = read_sweep(study)
    check_figures(sweep_file(study), asked.figures)
    folder = options.out or sweep_file(study).parent
    make_folder(folder)
    check_writable(folder / TABLE)
    table = StudyTable(folder / TABLE, key="point")
    missing = missing_points(points, table)
    say(f"{len(points)} points, {len(points) - len(missing)} done before.", quiet=options.quiet)
    if missing:
        try:
            with _cluster(options, len(missing)) as client, _told(len(missing), quiet=options.quiet) as watch:
                say(f"Dashboard: {client.dashboard_link or 'none'}", quiet=options.quiet)
                run_sweep(client, asked, missing, table, watch)
        except KeyboardInterrupt:
            left = len(missing_points(points, table))
            complain(f"{len(points) - left} of {len(points)} points are in {table.path}; the same command goes on")
            raise
    with undisturbed():
        return _written(folder, asked, points, table, quiet=options.quiet)


def _cluster(options: SweepOptions, points: int) -> AbstractContextManager[Client]:
    if options.scheduler is not None:
        return connected(options.scheduler, wait_s=options.wait_s, tell=warn)
    return local_cluster(min(options.workers or cores(), points))


@contextmanager
def _told(total: int, *, quiet: bool) -> Iterator[Callable[[Row], None]]:
    """Tell of every point: with a bar on a terminal, else in a line for each."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("ETA"))
    silent, failed = quiet or not console.is_terminal, []
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=silent, transient=True) as bar:
        task = bar.add_task("points", total=total)

        def watch(row: Row) -> None:
            bar.advance(task)
            done = int(bar.tasks[0].completed)
            if row["error"]:
                failed.append(row)
                bar.update(task, description=f"points, {len(failed)} failed")
                warn(f"[{done}/{total}] {row['point']} failed: {row['error']}")
            elif silent:
                say(f"[{done}/{total}] {_in_words(row)}", quiet=quiet)

        yield watch


def _in_words(row: Row) -> str:
    """What a point found."""
    told = [f"{row['point']}: {row['outcome']}"]
    told += [f"{row['rms_nm']:.1f} nm"] if "rms_nm" in row else []
    told += [f"Strehl {row['strehl']:.3f}"] if "strehl" in row else []
    return f"{', '.join(told)} ({float(row['seconds']) + float(row['build_seconds']):.0f} s)"


def _written(folder: Path, asked: Sweep, points: Sequence[Point], table: StudyTable, *, quiet: bool) -> int:
    """The table in the order of the file, figures and page; the exit code."""
    stamp = Provenance.collect(asked.model_dump(mode="json"), seed=None, device=WORKERS)
    table.sort([point.name for point in points], stamp, others=True)
    rows = rows_of(points, table)
    keep_profiles(folder, rows, stamp)
    pictures = draw_figures(folder, asked.figures, rows, drawings_of(folder))
    page = write_sweep_report(folder, asked, rows, pictures)
    failed = [row for row in rows if row["error"]]
    others = len(table.rows) - len(rows)
    kept = f" {others} rows of points that the file no longer asks for stay in it." if others else ""
    say(f"{len(rows)} points in {table.path}; wrote {page}.{kept}", quiet=quiet)
    if not failed:
        return 0
    warn(f"{len(failed)} of {len(rows)} points failed; the same command tries them again")
    return NOT_A_SUCCESS
