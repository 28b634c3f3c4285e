"""The table of a study: one row a case, stamped, kept on disk after each, so that a study resumes."""

from pathlib import Path

import astropy.units as u
from astropy.table import Table

from nlcwfs.interop import Provenance, atomic_write

Row = dict[str, str | int | float]


class StudyTable:
    """Rows on disk, one a case; the name and the digest of its settings tell whether a row still holds.

    Attributes:
        path: The ECSV file.
        rows: What it holds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[Row] = []
        if path.is_file():
            table = Table.read(path, format="ascii.ecsv")
            names = list(table.colnames)
            self.rows = [dict(zip(names, values, strict=True)) for values in table.iterrows()]

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
        columns = {name: [row[name] for row in self.rows] for name in self.rows[0]}
        units = {name: u.nm for name in columns if name.endswith("_nm")}
        table = Table(columns, units=units, meta={"provenance": provenance.as_dict()})
        with atomic_write(self.path) as temporary:
            table.write(temporary, format="ascii.ecsv", overwrite=True)
