"""The table of a study: one row a case, stamped, kept on disk after each, so that a study resumes."""

import io
import math
from pathlib import Path

import astropy.units as u
from astropy.table import Table

from nlcwfs.errors import FileFormatError
from nlcwfs.interop import Provenance, atomic_write

Row = dict[str, str | int | float]

LAST = ("commit", "digest")
"""Columns at the end of the table, whatever columns join later."""


class StudyTable:
    """Rows on disk, one a case; the name and the digest of its settings tell whether a row still holds.

    Attributes:
        path: The ECSV file.
        rows: What it holds; a row that is older than a column has NaN there, or no text.

    Raises:
        FileFormatError: If the file is there and is no such table.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[Row] = []
        if path.is_file():
            self.rows = _read(path)

    def holds(self, name: str, digest: str) -> bool:
        """Whether the table has this case with these settings."""
        return any(row["case"] == name and row["digest"] == digest for row in self.rows)

    def put(self, row: Row, provenance: Provenance) -> None:
        """Add a row, or replace that of the same case, and write the table."""
        self.rows = [*(kept for kept in self.rows if kept["case"] != row["case"]), row]
        self._write(provenance)

    def sort(self, names: list[str], provenance: Provenance) -> None:
        """Bring the rows into the order of the study; rows of cases that no longer exist go."""
        order = {name: number for number, name in enumerate(names)}
        rows = sorted((row for row in self.rows if row["case"] in order), key=lambda row: order[str(row["case"])])
        if rows != self.rows:  # a table that was left as it is keeps the stamp of who made it
            self.rows = rows
            self._write(provenance)

    def _write(self, provenance: Provenance) -> None:
        names = list(dict.fromkeys(name for row in self.rows for name in row if name not in LAST))
        names += [name for name in LAST if name in self.rows[0]]
        columns = {name: _filled([row.get(name) for row in self.rows]) for name in names}
        units = {name: u.nm for name in columns if name.endswith("_nm")}
        text = io.StringIO()
        table = Table(columns, units=units, meta={"provenance": provenance.as_dict()})
        table.write(text, format="ascii.ecsv")
        with atomic_write(self.path) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")


def _read(path: Path) -> list[Row]:
    try:
        table = Table.read(path.read_text(encoding="utf-8").splitlines(), format="ascii.ecsv")
    except Exception as error:  # astropy and its YAML have a dozen kinds
        reason = " ".join(str(error).split())[:200]
        raise FileFormatError(f"{path}: must be the table of a study (delete it to start anew), got {reason}") from None
    names = list(table.colnames)
    missing = [name for name in ("case", "group", "digest") if name not in names]
    if missing:
        rule = f"must have the columns case, group and digest (delete it to start anew), got no {missing[0]}"
        raise FileFormatError(f"{path}: {rule}")
    columns = [_filled(table[name].tolist()) for name in names]  # numbers of Python; ECSV reads no text as None
    return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


def _filled(values: list[str | int | float | None]) -> list[str | int | float]:
    """Something for rows that are older than the column."""
    nothing = "" if any(isinstance(value, str) for value in values) else math.nan
    return [nothing if value is None else value for value in values]
