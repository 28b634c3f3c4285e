"""`nlcwfs sensitivity`: photons that sensors need at each spatial frequency, relative to the quantum limit."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from nlcwfs.commands.console import complain, make_folder, say, undisturbed, warn
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.sensitivity_settings import SensitivityQuestion, read_question
from nlcwfs.studies.sensitivity_figure import factor_table, write_sensitivity_page
from nlcwfs.studies.sensitivity_run import curve_points, missing_curves, rows_of_points, run_curve, table_of
from nlcwfs.studies.study_table import Row


@dataclasses.dataclass(frozen=True)
class SensitivityOptions:
    """What was typed.

    Attributes:
        study: Folder or file of a question; None for the sensors of the paper.
        out: Folder of table, figure and page.
        rms_rad: Instead of those of the question.
        cycles: Frequencies instead of those of the question.
        sensors: Only those whose names hold one of these texts.
        settings: Settings of all sensors.
        quiet: Say nothing but warnings.
    """

    study: Path | None
    out: Path | None
    rms_rad: tuple[float, ...]
    cycles: tuple[float, ...]
    sensors: tuple[str, ...]
    settings: tuple[str, ...]
    quiet: bool


def sensitivity(options: SensitivityOptions) -> int:
    """Compute what the table does not hold yet; table, figure and page.

    Returns:
        Exit code.

    Raises:
        NlcwfsError: If something asked is impossible; what was computed is kept.
    """
    asked = question_of(options)
    folder = options.out or _home(options.study)
    points = curve_points(asked)
    make_folder(folder)
    table = table_of(folder)
    missing = missing_curves(points, table)
    say(f"Curves: {len(points)}, {len(points) - len(missing)} done before.", quiet=options.quiet)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    silent = options.quiet or not console.is_terminal
    try:
        with Progress(*columns, console=console, disable=silent, transient=True) as bar:
            whole = bar.add_task("curves", total=len(missing))
            for point in missing:
                one = bar.add_task(point.name, total=None)

                def progress(done: int, total: int, task: TaskID = one) -> None:
                    bar.update(task, completed=done, total=total)

                run_curve(point, asked, table, progress)
                bar.remove_task(one)
                bar.advance(whole)
                if silent:
                    say(point.name, quiet=options.quiet)
    except KeyboardInterrupt:
        left = len(missing_curves(points, table))
        complain(f"{len(points) - left} of {len(points)} curves are in {table.path}; the same command goes on")
        raise
    with undisturbed():
        rows = rows_of_points(points, table)
        page = write_sensitivity_page(folder, asked, rows)
    _account(rows, quiet=options.quiet)
    say(f"Wrote {table.path} and {page}.", quiet=options.quiet)
    return 0


def question_of(options: SensitivityOptions) -> SensitivityQuestion:
    """The question of a file or of the paper, with what was typed.

    Raises:
        NlcwfsError: If the file is wrong, or something typed is impossible.

    Examples:
        >>> options = SensitivityOptions(None, None, (4.0,), (1.0,), ("1000",), (), False)
        >>> asked = question_of(options)
        >>> [case.name for case in asked.case], asked.rms_rad
        (['curvature, 1000 km, linear'], (4.0,))
    """
    asked = read_question(options.study) if options.study is not None else SensitivityQuestion(question=PAPERS)
    cases = [case for case in asked.case if not options.sensors or any(part in case.name for part in options.sensors)]
    if not cases:
        rule = f"must be a part of one of {', '.join(repr(case.name) for case in asked.case)}"
        raise SettingsError("--sensor", rule, " ".join(options.sensors))
    if options.rms_rad:
        _check_rms(options.rms_rad)
        cases = [case.model_copy(update={"rms_rad": None}) for case in cases]
        asked = asked.model_copy(update={"rms_rad": options.rms_rad})
    if options.cycles:
        for value in options.cycles:
            if not 0 < value <= 1000:
                raise SettingsError("--cpa", "must be a number above 0 and at most 1000", value)
        asked = asked.model_copy(update={"cycles_per_aperture": options.cycles})
    return asked.model_copy(update={"case": tuple(cases), "set": (*asked.set, *options.settings)})


PAPERS = "How many photons does each sensor need at each spatial frequency, and behind how rough a wavefront?"
"""The question of Guyon 2010, Fig. 11."""


def _check_rms(values: Sequence[float]) -> None:
    for value in values:
        if not 0 <= value <= 100:
            raise SettingsError("--rms-rad", "must be a number from 0 to 100", value)


def _home(study: Path | None) -> Path:
    if study is None:
        return Path("sensitivity")
    return study if study.is_dir() else study.parent


def _account(rows: Sequence[Row], *, quiet: bool) -> None:
    """The table, and who is blind where."""
    for level in sorted({float(row["rms_rad"]) for row in rows}):
        say(f"\nPhotons over the ideal, {'flat wavefront' if level == 0 else f'{level:g} rad rms'}:", quiet=quiet)
        for line in factor_table([row for row in rows if row["rms_rad"] == level]):
            say(line, quiet=quiet)
    for row in rows:
        if math.isinf(float(row["flux_factor"])):
            warn(f"{row['factor']}: the sensor is blind to this mode, no number of photons is enough")
