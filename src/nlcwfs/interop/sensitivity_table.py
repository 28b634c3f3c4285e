"""The tables of `nlcwfs sensitivity`, as far as others need them: the flux factor of each sensor."""

import math
from pathlib import Path

import numpy as np
from astropy.table import Table

from nlcwfs.errors import FileFormatError
from nlcwfs.science.flux_factor import FluxFactor

COLUMNS = ("sensor", "cycles_per_aperture", "flux_factor")
"""What such a table must have; others are not looked at, but for `ROUGHNESS`."""

ROUGHNESS = "rms_rad"
"""Rms of the wavefronts that a row is about, where a table has several."""


def read_flux_factors(path: str | Path, *, rms_rad: float = 0.0) -> dict[str, FluxFactor]:
    """The flux factor of each sensor of a table (ECSV), by name; rows may be in any order.

    Args:
        path: The table.
        rms_rad: Rms of the wavefronts whose rows are read, where the table has the column.

    Raises:
        FileFormatError: If there is no such table, a column is missing, a number is none (infinite is one: blind), or a
            sensor has two factors at a frequency.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "sensitivity.ecsv"
        >>> rows = [("pyramid", 4.0, 2.1), ("pyramid", 1.0, 2.0)]
        >>> Table(rows=rows, names=COLUMNS).write(path, format="ascii.ecsv")
        >>> read_flux_factors(path)["pyramid"].factor.tolist()
        [2.0, 2.1]
    """
    path = Path(path)
    try:
        table = Table.read(path.read_text(encoding="utf-8").splitlines(), format="ascii.ecsv")
    except OSError as error:
        raise FileFormatError(f"{path}: must be a table of nlcwfs sensitivity, got {error.strerror}") from None
    except Exception as error:  # astropy and its YAML have a dozen kinds
        reason = " ".join(str(error).split())[:200]
        raise FileFormatError(f"{path}: must be a table of nlcwfs sensitivity, got {reason}") from None
    missing = [name for name in COLUMNS if name not in table.colnames]
    if missing:
        raise FileFormatError(f"{path}: must have the columns {', '.join(COLUMNS)}, got no {missing[0]}")
    if ROUGHNESS in table.colnames:
        table = table[np.isclose(np.asarray(table[ROUGHNESS], float), rms_rad)]
        if not len(table):
            raise FileFormatError(f"{path}: must hold rows with {ROUGHNESS} = {rms_rad:g}, got none")
    points: dict[str, dict[float, float]] = {}
    for number, (name, waves, factor) in enumerate(zip(*(table[name].tolist() for name in COLUMNS), strict=True), 1):
        points.setdefault(str(name), {})
        waves, factor = _number(path, number, COLUMNS[1], waves), _number(path, number, COLUMNS[2], factor)
        if math.isinf(waves):
            raise FileFormatError(f"{path}: row {number}: {COLUMNS[1]}: must be finite, got inf")
        if waves in points[str(name)]:
            rule = f"must hold one flux factor for each sensor and frequency, got two of {name} at {waves:g}"
            raise FileFormatError(f"{path}: {rule}")
        points[str(name)][waves] = factor
    return {
        name: FluxFactor(name, np.array(sorted(found)), np.array([found[waves] for waves in sorted(found)]))
        for name, found in points.items()
    }


def _number(path: Path, row: int, name: str, value: object) -> float:
    number = float(value) if isinstance(value, int | float) else math.nan
    if not number > 0:
        raise FileFormatError(f"{path}: row {row}: {name}: must be a positive number, got {value}")
    return number
