"""The stamp of every file: which code, settings and machine made it."""

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np

from nlcwfs.interop.fits_keywords import Card, Keywords, ascii_line, load_hdus

UNKNOWN = "unknown"

_KEYWORDS = {
    "version": ("NLCWFSV", "version of nlcwfs"),
    "commit": ("GITREV", ""),
    "settings_digest": ("CFGHASH", ""),
    "seed": ("SEED", "seed of the random numbers"),
    "device": ("DEVICE", "where it was computed"),
    "jax_version": ("JAXVER", "version of JAX"),
    "numpy_version": ("NUMPYVER", "version of NumPy"),
    "astropy_version": ("ASTROVER", "version of astropy"),
    "python_version": ("PYTHON", "version of Python"),
    "date_utc": ("DATE", "[UTC] when the file was made"),
}
"""FITS keyword and comment of every field; 40 and 64 hexadecimal digits leave no room for a comment."""


@dataclass(frozen=True)
class Provenance:
    """What made a file.

    Attributes:
        version: Version of nlcwfs.
        commit: Git commit of the code, with `-dirty` after changes; 'unknown' outside a checkout.
        settings_digest: SHA-256 of the settings, see `settings_digest`.
        seed: Seed of the random numbers; None where none were drawn.
        device: Where it was computed, in words.
        date_utc: When, as `2026-01-31T12:00:00`.

    Examples:
        >>> stamp = Provenance.collect({"pixels": 64}, seed=7, device="cpu")
        >>> stamp.seed, [key for key, _, _ in stamp.cards()][:3]
        (7, ['NLCWFSV', 'GITREV', 'CFGHASH'])
    """

    version: str
    commit: str
    settings_digest: str
    seed: int | None
    device: str
    jax_version: str
    numpy_version: str
    astropy_version: str
    python_version: str
    date_utc: str

    @classmethod
    def collect(cls, settings: Mapping[str, Any], *, seed: int | None, device: str) -> "Provenance":
        """The stamp of a file that is made here and now; never fails for what it cannot find out."""
        return cls(
            version=_version("nlcwfs"),
            commit=_commit(),
            settings_digest=settings_digest(settings),
            seed=seed,
            device=device,
            jax_version=_version("jax"),
            numpy_version=_version("numpy"),
            astropy_version=_version("astropy"),
            python_version=platform.python_version(),
            date_utc=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"),
        )

    def cards(self) -> list[Card]:
        """Keyword, value and comment for a FITS header; without a seed there is no SEED."""
        values = self.as_dict().items()
        return [
            (_KEYWORDS[name][0], ascii_line(value) if isinstance(value, str) else value, _KEYWORDS[name][1])
            for name, value in values
            if value is not None
        ]

    def as_dict(self) -> dict[str, str | int | None]:
        """The same for the `meta` of a table or for JSON."""
        return asdict(self)


def read_provenance(path: str | Path) -> Provenance:
    """The stamp of a FITS file that nlcwfs wrote; fields that are missing read 'unknown'.

    Raises:
        FileFormatError: If there is no such file, or if it is not FITS.
    """
    keywords = Keywords(Path(path), load_hdus(path)["PRIMARY"].header)
    found = {name: keywords.value(key) for name, (key, _) in _KEYWORDS.items()}
    seed = found.pop("seed")
    texts = {name: UNKNOWN if value is None else str(value) for name, value in found.items()}
    return Provenance(seed=seed if isinstance(seed, int) else None, **texts)


def settings_digest(settings: Mapping[str, Any]) -> str:
    """SHA-256 of the settings as JSON with sorted keys: the same for the same choices, in any order.

    Args:
        settings: Values that JSON knows, paths, and NumPy numbers and arrays.

    Raises:
        TypeError: If a value is of another kind.

    Examples:
        >>> settings_digest({"a": 1, "b": (2.5, None)}) == settings_digest({"b": [2.5, None], "a": 1})
        True
    """
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"settings: must be made of numbers, texts, lists and tables, got {type(value).__name__}")


def _version(package: str) -> str:
    try:
        return installed_version(package)
    except PackageNotFoundError:
        return UNKNOWN


@cache
def _commit() -> str:
    """The commit this code was checked out from.

    Only the checkout of nlcwfs itself counts: an installed package may lie inside somebody else's repository.
    """
    package = Path(__file__).resolve().parents[1]
    root = package.parents[1]
    if package != root / "src" / "nlcwfs" or not (root / ".git").exists():
        return UNKNOWN
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return commit + ("-dirty" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN


def _git(root: Path, *arguments: str) -> str:
    # A hook of another repository sets GIT_DIR, which would win over the folder.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    finished = subprocess.run(
        ["git", "-C", str(root), *arguments],
        capture_output=True,
        check=True,
        env=environment,
        text=True,
        timeout=5,
    )
    return finished.stdout.strip()
