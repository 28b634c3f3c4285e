"""`nlcwfs study`: run what a study's table does not hold yet, then draw and write its page."""

from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from nlcwfs.commands.console import say
from nlcwfs.interop import check_writable
from nlcwfs.studies.study_cases import read_study
from nlcwfs.studies.study_run import run_study, table_path


def study(folder: Path, *, only: tuple[str, ...], screens: int | None, quiet: bool) -> None:
    """Run a study.

    A quick look with fewer screens leaves table, figures and page as they are and says what it found.

    Raises:
        NlcwfsError: If the study's file, its table or the folder cannot be used.
    """
    read_study(folder)
    check_writable(table_path(folder, screens))
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("study", total=None)

        def progress(case: str, done: int, total: int) -> None:
            bar.update(task, description=case, completed=done, total=total)
            if done == total and not console.is_terminal:
                say(f"{case}: {total} screens", quiet=quiet)

        table = run_study(folder, progress=progress, only=only, screens=screens)
    from nlcwfs.studies.study_figures import FIGURES, draw_figures
    from nlcwfs.studies.study_report import quick_lines, write_report

    if screens is not None:
        lines = quick_lines(read_study(folder), table, only)
        say("\n".join([*lines, f"{len(lines)} cases in {table.path}; {screens} screens tell little."]), quiet=quiet)
        return
    chosen = read_study(folder)
    pictures = draw_figures(folder, chosen.figures, table.rows, FIGURES)
    path = write_report(folder, chosen, table, pictures)
    say(
        f"{len(table.rows)} cases in {table.path}; wrote {path} and {', '.join(pictures) or 'no picture'}.", quiet=quiet
    )
