"""Keeping a run of the loop when its folder cannot be written: warn, try again, and save it elsewhere at the end."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from nlcwfs.commands.console import warn
from nlcwfs.config import Config
from nlcwfs.errors import FileFormatError
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop.loop import LoopState, Record

RESCUED = "nlcwfs-loop-"
"""How the names of folders begin that keep what could not be written where it belongs."""


class Checkpoints:
    """Writes where a run stands now and then; a folder that cannot be written is told once, and tried again."""

    def __init__(self, folder: Path, config: Config) -> None:
        self.folder, self.config, self.told = folder, config, False

    def write(self, state: LoopState, records: list[Record]) -> None:
        """One checkpoint, if it can be written."""
        try:
            folder_of.write_checkpoint(self.folder, self.config, state, records)
            self.told = False
        except FileFormatError as error:
            if not self.told:
                warn(f"{error}; the run goes on and tries again")
            self.told = True


def kept(folder: Path, config: Config, write: Callable[[Path], None]) -> None:
    """Write what a run leaves: in its folder, made again if it is gone, or else in a new one for temporary files.

    Args:
        folder: Where it belongs.
        config: Settings of the run; they go into the folder, too.
        write: Writes into the folder that it is given.

    Raises:
        FileFormatError: If it is not where it belongs; the message says why, and where it is.
    """
    try:
        _whole(folder, config, write)
    except FileFormatError as error:
        raise FileFormatError(f"{error}; {_rescued(config, write)}") from None


def _rescued(config: Config, write: Callable[[Path], None]) -> str:
    """Write into a new folder; says where, or why not."""
    rescue = None
    try:
        rescue = Path(tempfile.mkdtemp(prefix=RESCUED))
        _whole(rescue, config, write)
    except (FileFormatError, OSError) as error:
        if rescue is not None:
            shutil.rmtree(rescue, ignore_errors=True)
        reason = str(error) if isinstance(error, FileFormatError) else (error.strerror or error)
        return f"nor can the run be kept elsewhere: {reason}"
    return f"the run is kept in {rescue}"


def _whole(folder: Path, config: Config, write: Callable[[Path], None]) -> None:
    with contextlib.suppress(OSError):  # the first file to be written says what is wrong
        folder.mkdir(parents=True, exist_ok=True)
    if not os.path.exists(folder / folder_of.CONFIG):  # not Path.exists, which raises where it may not look
        folder_of.write_config(folder, config)
    write(folder)
