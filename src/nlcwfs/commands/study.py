"""`nlcwfs study`: run what a study's table does not hold yet, then draw and write its page."""

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from nlcwfs.commands.console import say
from nlcwfs.interop import check_writable
from nlcwfs.studies.study_cases import read_study
from nlcwfs.studies.study_run import run_study


def study(folder: Path, *, only: tuple[str, ...], screens: int | None, quiet: bool) -> None:
    """Run a study.

    Raises:
        NlcwfsError: If the study's file or the folder cannot be used.
    """
    read_study(folder)
    check_writable(folder / "results.ecsv")
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("study", total=None)

        def progress(case: str, done: int, total: int) -> None:
            bar.update(task, description=case, completed=done, total=total)
            if done == total and not console.is_terminal:
                say(f"{case}: {total} screens", quiet=quiet)

        table = run_study(folder, progress=progress, only=only, screens=screens)
    from nlcwfs.studies.study_figures import draw_figures
    from nlcwfs.studies.study_report import write_report

    pictures = draw_figures(folder, table)
    path = write_report(folder, read_study(folder), table, pictures)
    say(
        f"{len(table.rows)} cases in {table.path}; wrote {path} and {', '.join(pictures) or 'no picture'}.", quiet=quiet
    )
