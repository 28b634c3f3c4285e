"""FITS headers: values under a rule when reading, cards with their units when writing."""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from nlcwfs.errors import FileFormatError
from nlcwfs.interop.atomic_write import atomic_write

Card = tuple[str, Any, str]
"""Keyword, value, comment."""


@dataclass(frozen=True, eq=False)
class Hdu:
    """One part of a FITS file, in memory.

    Attributes:
        data: An image in its FITS order `(..., y, x)`, a table, or None.
    """

    header: fits.Header
    data: Any


def file_error(path: str | Path, where: str, rule: str, value: object) -> FileFormatError:
    """The one line about a file that breaks its contract.

    Examples:
        >>> print(file_error("star.fits", "WAVELEN", "must be in metres", 0.65))
        star.fits: WAVELEN: must be in metres, got 0.65
    """
    return FileFormatError(" ".join(f"{path}: {where}: {rule}, got {value}".split()))


def load_hdus(path: str | Path) -> dict[str, Hdu]:
    """Every part of a FITS file by its name; the first is 'PRIMARY', unnamed ones are 'HDU 1' and so on.

    Raises:
        FileFormatError: If there is no such file, or if it is not readable as FITS from end to end.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise file_error(path, "file", "must be readable as FITS", found)
    parts: dict[str, Hdu] = {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyUserWarning)  # odd cards are judged when they are needed
            warnings.filterwarnings("error", message=".*truncated", category=AstropyUserWarning)
            # Our own stream: astropy leaves its own one open when it finds damage.
            with path.open("rb") as stream, fits.open(stream, memmap=False) as hdus:
                for number, hdu in enumerate(hdus):
                    name = hdu.name.strip().upper() if number else "PRIMARY"
                    parts.setdefault(name or f"HDU {number}", Hdu(hdu.header, hdu.data))
    except Exception as error:  # astropy raises errors of many kinds on damaged bytes
        # The first sentence tells what is wrong; astropy's advice after it is for programmers.
        raise file_error(path, "file", "must be readable as FITS", str(error).split(". If this", 1)[0]) from None
    return parts


@dataclass(frozen=True, eq=False)
class Keywords:
    """The header of a file, read under rules.

    Examples:
        >>> keywords = Keywords(Path("star.fits"), fits.Header({"RATE": -2.0}))
        >>> keywords.number("RATE", "must be positive", lambda value: value > 0)
        Traceback (most recent call last):
        nlcwfs.errors.FileFormatError: star.fits: RATE: must be positive, got -2
    """

    path: Path
    header: fits.Header

    def value(self, key: str) -> Any:
        """The value of a keyword, None where it is missing or empty.

        Raises:
            FileFormatError: If the card cannot be read.
        """
        try:
            value = self.header.get(key)
        except fits.VerifyError:
            raise self.error(key, "must be a FITS value", "a card that cannot be read") from None
        return None if isinstance(value, fits.card.Undefined) else value

    def number(self, key: str, rule: str, holds: Callable[[float], bool]) -> float:
        """A number that must be there and keep a rule.

        Raises:
            FileFormatError: If it is missing, not a finite number, or breaks the rule.
        """
        value = self.value(key)
        if value is None:
            raise self.error(key, f"is required and {rule}", "no such keyword")
        if isinstance(value, bool | np.bool_) or not isinstance(value, int | float):
            raise self.error(key, "must be a number", repr(value))
        value = float(value)
        if not np.isfinite(value) or not holds(value):
            raise self.error(key, rule, f"{value:g}")
        return value

    def optional_number(self, key: str, rule: str, holds: Callable[[float], bool]) -> float | None:
        """The same for a number that may be left out: then None.

        Raises:
            FileFormatError: If it is not a finite number, or breaks the rule.
        """
        return None if self.value(key) is None else self.number(key, rule, holds)

    def flag(self, key: str) -> bool:
        """A yes or no; no when left out.

        Raises:
            FileFormatError: If it is neither T nor F.
        """
        value = self.value(key)
        if value is None:
            return False
        if not isinstance(value, bool | np.bool_):
            raise self.error(key, "must be T or F", repr(value))
        return bool(value)

    def text(self, key: str, rule: str) -> str:
        """A text that must be there.

        Raises:
            FileFormatError: If it is missing or not a text.
        """
        value = self.value(key)
        if value is None:
            raise self.error(key, f"is required and {rule}", "no such keyword")
        if not isinstance(value, str):
            raise self.error(key, rule, repr(value))
        return value.strip()

    def numbered(self, prefix: str) -> dict[int, str]:
        """The keywords `PREFIX1`, `PREFIX2`, ... that are present, by their number."""
        matches = (re.fullmatch(rf"{prefix}(\d+)", key) for key in self.header)
        return {int(match[1]): match[0] for match in matches if match}

    def error(self, where: str, rule: str, value: object) -> FileFormatError:
        """The one line about this file."""
        return file_error(self.path, where, rule, value)


def ascii_line(text: str) -> str:
    """A text that FITS can hold: one line of plain characters."""
    return " ".join(text.encode("ascii", "replace").decode().split())


def header_of(cards: Sequence[Card]) -> fits.Header:
    """A header; what is None, or not finite, is written as a keyword without a value (FITS knows no NaN)."""
    header = fits.Header()
    for key, value, comment in cards:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str):
            value = ascii_line(value)
        if isinstance(value, float) and not np.isfinite(value):
            value = None
        header[key] = (value, comment) if comment else value
    return header


def position_cards(shape: Sequence[int], pixel_m: float) -> list[Card]:
    """Where the pixels of an image `(..., y, x)` lie: metres from its centre, as ds9 shows them.

    Examples:
        >>> [(key, value) for key, value, _ in position_cards((5, 8), 0.5) if key.startswith("CRPIX")]
        [('CRPIX1', 4.5), ('CRPIX2', 3.0)]
    """
    cards: list[Card] = [("WCSNAME", "PUPIL", "positions at the scale of the telescope")]
    for axis, (name, size) in enumerate((("x", shape[-1]), ("y", shape[-2])), start=1):
        cards += [
            (f"CTYPE{axis}", "LINEAR", f"{name} at the scale of the telescope"),
            (f"CUNIT{axis}", "m", ""),
            (f"CRPIX{axis}", (size + 1) / 2, "centre of the image"),
            (f"CRVAL{axis}", 0.0, "[m] position of the centre"),
            (f"CDELT{axis}", float(pixel_m), "[m] width of a pixel"),
        ]
    for axis in range(3, len(shape) + 1):
        cards += [(f"CTYPE{axis}", "LINEAR", "a plain number, from 1")]
        cards += [(f"{key}{axis}", 1.0, "") for key in ("CRPIX", "CRVAL", "CDELT")]
    return cards


def write_hdus(path: str | Path, hdus: Sequence[Any]) -> None:
    """Write a FITS file, whole or not at all.

    Raises:
        FileFormatError: If it cannot be written.
    """
    with atomic_write(path) as temporary:
        fits.HDUList(list(hdus)).writeto(temporary, output_verify="exception")


def compact(array: np.ndarray) -> np.ndarray:
    """The array as float32 where that loses nothing (counts of electrons), else as float64."""
    with np.errstate(over="ignore"):
        small = array.astype(np.float32)
    return small if np.array_equal(small.astype(np.float64), array, equal_nan=True) else array.astype(np.float64)
