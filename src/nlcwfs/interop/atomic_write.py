"""Writing a file whole or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nlcwfs.errors import FileFormatError


def check_writable(path: str | Path) -> None:
    """Refuse an output that could not be written; cheap, so ask before a long computation.

    Raises:
        FileFormatError: If the folder is missing or read-only, or if the path is a folder or read-only.

    Examples:
        >>> import tempfile
        >>> check_writable(Path(tempfile.gettempdir()) / "wavefront.fits")
        >>> check_writable("/no/such/wavefront.fits")
        Traceback (most recent call last):
        nlcwfs.errors.FileFormatError: /no/such/wavefront.fits: output folder must exist, got no /no/such
    """
    path = Path(path)
    folder = path.parent
    try:
        if not folder.exists():
            raise FileFormatError(f"{path}: output folder must exist, got no {folder}")
        if not folder.is_dir():
            raise FileFormatError(f"{path}: output folder must be a folder, got the file {folder}")
        if path.is_dir():
            raise FileFormatError(f"{path}: output must be a file, got a folder")
    except OSError as error:  # a name that is too long, a folder that may not be looked into
        raise FileFormatError(f"{path}: output must be reachable, got {error.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise FileFormatError(f"{path}: output folder must be writable, got the read-only {folder}")
    if path.exists() and not os.access(path, os.W_OK):
        raise FileFormatError(f"{path}: output must be writable, got a read-only file")
    trial = _beside(path)
    try:  # permissions do not tell everything: read-only file systems, quotas, special folders
        trial.touch()
    except OSError as error:
        raise FileFormatError(f"{path}: output folder must be writable, got {error.strerror}") from None
    finally:
        _remove(trial)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary name in the same folder, and rename it to `path` when the block ends well.

    A reader sees the old file or the new one, never half of one. After an error or an interruption inside the
    block the old file is untouched and nothing else is left.

    Yields:
        The path to write to; its ending is that of `path`.

    Raises:
        FileFormatError: If the folder cannot be written, or if writing fails (a full disk).

    Examples:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "note.txt"
        >>> with atomic_write(target) as temporary:
        ...     _ = temporary.write_text("done")
        >>> target.read_text(), len(list(target.parent.iterdir()))
        ('done', 1)
    """
    path = Path(path)
    check_writable(path)
    temporary = _beside(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be written, got {error.strerror or error}") from None
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    """Take a temporary file away; where that cannot be done, its folder is gone, or can no longer be written."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    """A name in the same folder that nobody else has, with the same ending."""
    return path.with_name(f".{secrets.token_hex(4)}-{path.name}")
