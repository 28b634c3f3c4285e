"""The table of a study: one row a case or a point, stamped, kept on disk after each, so that a study resumes."""

import io
import math
from pathlib import Path

import astropy.units as u
from astropy.table import Table

from nlcwfs.errors import FileFormatError
from nlcwfs.interop import Provenance, atomic_write

Row = dict[str, str | int | float]

LAST = ("device", "error", "commit", "digest")
"""Columns at the end of the table, whatever columns join later."""

NEEDED = {
    "case": ("case", "group", "digest"),
    "point": ("point", "case", "digest"),
    "factor": ("factor", "sensor", "digest"),
}
"""Columns without which a file is no table of a study, by what a row is about."""


class StudyTable:
    """Rows on disk, one a case; the name and the digest of its settings tell whether a row still holds.

    Attributes:
        path: The ECSV file.
        key: Column of the names: `case`, or what else a row is about.
        rows: What it holds; a row that is older than a column has NaN there, or no text.

    Raises:
        FileFormatError: If the file is there and is no such table.
    """

    def __init__(self, path: Path, key: str = "case") -> None:
        self.path, self.key = path, key
        self.rows: list[Row] = []
        if path.is_file():
            self.rows = _read(path, NEEDED[key])

    def holds(self, name: str, digest: str) -> bool:
        """Whether the table has this case with these settings."""
        return any(row[self.key] == name and row["digest"] == digest for row in self.rows)

    def put(self, row: Row, provenance: Provenance) -> None:
        """Add a row, or replace that of the same name, and write the table."""
        self.put_all([row], provenance)

    def put_all(self, rows: list[Row], provenance: Provenance) -> None:
        """Add rows, or replace those of the same names, and write the table once."""
        names = {row[self.key] for row in rows}
        self.rows = [*(kept for kept in self.rows if kept[self.key] not in names), *rows]
        self._write(provenance)

    def sort(self, names: list[str], provenance: Provenance, *, others: bool = False) -> None:
        """Bring the rows into the order of the study.

        Args:
            names: All that the study asks for.
            provenance: Stamp of a table that changes.
            others: Whether rows that it no longer asks for stay, at the end.
        """
        order = {name: number for number, name in enumerate(names)}
        kept = [row for row in self.rows if others or row[self.key] in order]
        rows = sorted(kept, key=lambda row: order.get(str(row[self.key]), len(order)))
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


def _read(path: Path, needed: tuple[str, ...]) -> list[Row]:
    try:
        table = Table.read(path.read_text(encoding="utf-8").splitlines(), format="ascii.ecsv")
    except Exception as error:  # astropy and its YAML have a dozen kinds
        reason = " ".join(str(error).split())[:200]
        raise FileFormatError(f"{path}: must be the table of a study (delete it to start anew), got {reason}") from None
    names = list(table.colnames)
    missing = [name for name in needed if name not in names]
    if missing:
        listed = f"{', '.join(needed[:-1])} and {needed[-1]}"
        rule = f"must have the columns {listed} (delete it to start anew), got no {missing[0]}"
        raise FileFormatError(f"{path}: {rule}")
    texts = [table[name].dtype.kind == "U" for name in names]  # ECSV reads no text as None, even in a whole column
    columns = [_filled(table[name].tolist(), text=text) for name, text in zip(names, texts, strict=True)]
    return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


def _filled(values: list[str | int | float | None], *, text: bool = False) -> list[str | int | float]:
    """Something for rows that are older than the column."""
    nothing = "" if text or any(isinstance(value, str) for value in values) else math.nan
    return [nothing if value is None else value for value in values]
