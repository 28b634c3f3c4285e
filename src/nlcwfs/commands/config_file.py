"""`nlcwfs config`: the settings as a file."""

from pathlib import Path

from nlcwfs.commands.console import say
from nlcwfs.config import default_toml, load_config
from nlcwfs.errors import FileFormatError, NlcwfsError, SettingsError
from nlcwfs.interop.atomic_write import atomic_write


def print_config(out: Path | None) -> None:
    """Print every setting with its default, or write it to a file that is not there yet.

    Raises:
        SettingsError: If the file exists: somebody may have edited it.
        FileFormatError: If it cannot be written.
    """
    if out is None:
        say(default_toml().rstrip("\n"))
        return
    if out.exists():
        raise SettingsError("--out", "must be a new file", f"the existing {out}")
    with atomic_write(out) as temporary:
        temporary.write_text(default_toml(), encoding="utf-8")
    say(f"Wrote {out}; check it after editing with: nlcwfs config --check {out}")


def check_config(path: Path) -> None:
    """Say that a file is good, or what is wrong with it.

    Raises:
        NlcwfsError: If it is not good.
    """
    try:
        load_config(path)
    except FileFormatError:
        raise
    except NlcwfsError as error:
        raise NlcwfsError("\n".join(f"{path}: {line}" for line in str(error).splitlines())) from None
    say(f"{path}: ok")
