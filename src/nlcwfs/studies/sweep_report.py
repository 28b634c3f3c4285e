"""The page of a sweep: for each case and setting, the median over the seeds and its range."""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path

from nlcwfs.interop import atomic_write
from nlcwfs.studies.study_report import Column, markdown_table
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.sweep_points import SEED, Sweep

COLUMNS: dict[str, Column] = {
    "seeds": ("seeds", "{}"),
    "closed": ("closed", "{}"),
    "failed": ("failed", "{}"),
    "rms, median [nm]": ("rms_nm", "{:.1f}"),
    "least to most [nm]": (("rms_least_nm", "rms_most_nm"), "{:.1f} to {:.1f}"),
    "Strehl": ("strehl", "{:.3f}"),
    "bound [nm]": ("floor_nm", "{:.1f}"),
    "frames to close": ("frames_to_close", "{:.0f}"),
}
"""Columns of the page, behind those of the grid."""


def write_sweep_report(folder: Path, sweep: Sweep, rows: Sequence[Row], pictures: dict[str, str]) -> Path:
    """Write `README.md` beside the table.

    Args:
        folder: Of the table.
        sweep: Its question and answer.
        rows: Of the points that the sweep asks for.
        pictures: Caption of each picture, by file name.
    """
    lines = [f"# {sweep.answer}", "", sweep.question, ""]
    lines += [f"![{caption}]({name})\n\n*{caption}*\n" for name, caption in pictures.items()]
    for case in sweep.case:
        keys = [key for key in sweep.grid_of(case) if key != SEED]
        told = over_seeds([row for row in rows if row["case"] == case.name], keys)
        if told:
            settings: dict[str, Column] = {f"`{key}`": (key, "{}") for key in keys}
            lines += [f"## {case.name}", "", *markdown_table(told, settings | COLUMNS), ""]
    lines += [sweep.notes.strip(), ""]
    path = folder / "README.md"
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
    return path


def over_seeds(rows: Sequence[Row], keys: Sequence[str]) -> list[Row]:
    """One row for each combination of settings, with medians over the points that share it.

    Only loops that are closed at their end have a say in the numbers; how many those are is told beside them.

    Args:
        rows: Of one case.
        keys: Settings of its grid, without the seed.

    Examples:
        >>> rows = [{"loop.rate_hz": 260, "outcome": "closed", "rms_nm": rms} for rms in (80.0, 84.0, 95.0)]
        >>> (told,) = over_seeds(rows, ["loop.rate_hz"])
        >>> told["closed"], told["rms_nm"], told["rms_most_nm"]
        (3, 84.0, 95.0)
    """
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key, "") for key in keys), []).append(row)
    told = []
    for values, members in groups.items():
        closed = [row for row in members if row["outcome"] == "closed"]
        rms = _numbers(closed, "rms_nm")
        counts = {"seeds": len(members), "closed": len(closed)}
        failed = sum(row["outcome"] == "failed" for row in members)
        medians = {name: _median(closed, name) for name in ("rms_nm", "strehl", "floor_nm", "frames_to_close")}
        extremes = {"rms_least_nm": min(rms, default=math.nan), "rms_most_nm": max(rms, default=math.nan)}
        settings = {
            key: f"{value:g}" if isinstance(value, float) else value for key, value in zip(keys, values, strict=True)
        }
        shown = settings | counts | ({"failed": failed} if failed else {})
        told.append(shown | medians | extremes)
    return told


def _numbers(rows: Sequence[Row], name: str) -> list[float]:
    return [value for row in rows if not math.isnan(value := float(row.get(name, math.nan)))]


def _median(rows: Sequence[Row], name: str) -> float:
    return statistics.median(_numbers(rows, name) or [math.nan])
