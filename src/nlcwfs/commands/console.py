"""What a command says, and where: results on stdout, warnings, errors and progress on stderr."""

import functools
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, ParamSpec, TypeVar

import typer

from nlcwfs.errors import FileFormatError, NlcwfsError

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells know it: 128 + SIGINT."""

NOT_A_SUCCESS = 1
USER_CAN_MEND = 2

Parameters = ParamSpec("Parameters")
Item = TypeVar("Item")


def say(line: str, *, quiet: bool = False) -> None:
    """A line of the result."""
    if not quiet:
        typer.echo(line)


def warn(line: str) -> None:
    """A line that the user should read even when the results go elsewhere."""
    typer.echo(f"warning: {line}", err=True)


def complain(line: str) -> None:
    """A line about what went wrong."""
    typer.echo(f"nlcwfs: {line}", err=True)


def mendable(command: Callable[Parameters, None]) -> Callable[Parameters, None]:
    """Turn what the user can mend into one line for each problem and exit code 2; other errors stay tracebacks."""

    @functools.wraps(command)
    def checked(*arguments: Parameters.args, **options: Parameters.kwargs) -> None:
        try:
            command(*arguments, **options)
        except NlcwfsError as error:
            for line in str(error).splitlines():
                complain(line)
            raise typer.Exit(USER_CAN_MEND) from None
        except KeyboardInterrupt:
            complain("interrupted")
            raise typer.Exit(INTERRUPTED) from None

    return checked


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let no Ctrl-C in while results are being saved, nor a request to end; signals belong to the main thread."""
    with _answered(signal.SIG_IGN, signal.SIGINT, signal.SIGTERM):
        yield


@contextmanager
def ends_like_ctrl_c() -> Iterator[None]:
    """Let a request to end (SIGTERM: kill, a batch system) do what Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    with _answered(interrupt, signal.SIGTERM):
        yield


@contextmanager
def _answered(answer: Callable[[int, FrameType | None], Any] | signal.Handlers, *numbers: int) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [signal.signal(number, answer) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def working(what: str, *, quiet: bool = False) -> Iterator[None]:
    """Show that something takes its time; nothing when stderr is not a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def tracked(items: Iterable[Item], *, what: str, total: int, quiet: bool = False) -> Iterator[Item]:
    """The items, with a bar and the time that is left; without a bar when stderr is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TextColumn("ETA"), TimeRemainingColumn())
    silent = quiet or not console.is_terminal or total < 2
    with Progress(*columns, console=console, disable=silent, transient=True) as progress:
        task = progress.add_task(what, total=total)
        for item in items:
            yield item
            progress.advance(task)


def use_precision(precision: str) -> str:
    """Let JAX compute in 64 bits if that is asked for; returns the dtype to ask for."""
    if precision == "double":
        import jax

        jax.config.update("jax_enable_x64", True)
        return "float64"
    return "float32"


def device() -> str:
    """Where it is computed, in words."""
    import jax

    return str(jax.devices()[0])


def make_folder(folder: Path) -> None:
    """Make a folder for results, if it is not there.

    Raises:
        FileFormatError: If it cannot be one.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder}: must be a folder that can be written, got {error.strerror}") from None


def percent(fraction: float) -> str:
    """A share for the eye.

    Examples:
        >>> percent(0.0421), percent(0.31), percent(2e-5)
        ('4.2 %', '31 %', 'less than 0.1 %')
    """
    if fraction < 1e-3:
        return "less than 0.1 %"
    return f"{100 * fraction:.2g} %"
