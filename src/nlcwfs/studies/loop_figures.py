"""Figures of sweeps of the loop: what is left at each rate, of each star, in each case, and the star's image."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nlcwfs.studies.image_profiles import ANGLE, read_profiles
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.sweep_report import over_seeds
from nlcwfs.studies.table_axes import column, log_axis

RATE, MAGNITUDE = "loop.rate_hz", "atmosphere.star.magnitude"

LEAST_RATES = 3
"""Fewer are no curve."""

FEWEST_TICKS = 3
"""With fewer of the usual ones an axis has ticks of its own."""


def draw_rates(folder: Path, rows: Sequence[Row]) -> Figure | None:
    """Residual against the rate, a curve for each case that has several.

    Args:
        folder: Of the sweep; nothing is read from it.
        rows: Of its table.
    """
    curves = {}
    for case, members in _by_case(rows).items():
        told = over_seeds(members, [RATE])
        told = sorted((row for row in told if int(row["closed"]) and row[RATE] != ""), key=lambda row: float(row[RATE]))
        curves[case] = told if len(told) >= LEAST_RATES else []
    return _curves(curves, RATE, "exposures a second")


def draw_magnitudes(folder: Path, rows: Sequence[Row]) -> Figure | None:
    """Residual against the star's magnitude, a curve for each case, each star at its best rate.

    Args:
        folder: Of the sweep; nothing is read from it.
        rows: Of its table.
    """
    curves = {case: at_best_rate(members) for case, members in _by_case(rows).items()}
    if any(len(told) > 1 for told in curves.values()):  # a single star beside curves is there for its image
        curves = {case: told for case, told in curves.items() if len(told) > 1}
    return _curves(curves, MAGNITUDE, "magnitude of the star")


def at_best_rate(rows: Sequence[Row]) -> list[Row]:
    """For each magnitude the rate with the most closed loops, and of those the least residual; bright stars first.

    Args:
        rows: Of one case.

    Examples:
        >>> loop = {"outcome": "closed", MAGNITUDE: 15.0}
        >>> rows = [loop | {RATE: 100.0, "rms_nm": 150.0}, loop | {RATE: 200.0, "rms_nm": 130.0}]
        >>> [(told[RATE], told["rms_nm"]) for told in at_best_rate(rows)]
        [('200', 130.0)]
    """
    stars: dict[float, list[Row]] = {}
    for told in over_seeds(rows, [MAGNITUDE, RATE]):
        if told[MAGNITUDE] != "" and int(told["closed"]):
            stars.setdefault(float(told[MAGNITUDE]), []).append(told)
    best = {star: min(told, key=lambda one: (-int(one["closed"]), one["rms_nm"])) for star, told in stars.items()}
    return [best[star] for star in sorted(best)]


def draw_cases(folder: Path, rows: Sequence[Row]) -> Figure | None:
    """Residual of every loop, a line for each case; crosses are loops that closed and were open at their end.

    Args:
        folder: Of the sweep; nothing is read from it.
        rows: Of its table.
    """
    cases = _by_case(rows)
    names = list(cases)
    figure = Figure(figsize=(8.2, 1.4 + 0.36 * len(names)), layout="constrained")
    axes = figure.subplots()
    ended = [row for row in rows if np.isfinite(float(row.get("rms_nm", np.nan)))]
    for marker, closed, label in (("o", True, "closed"), ("x", False, "closed and lost")):
        shown = [row for row in ended if (row["outcome"] == "closed") == closed]
        if not shown:
            continue
        y = np.array([names.index(str(row["case"])) for row in shown]) + _side_by_side(shown)
        axes.plot(column(shown, "rms_nm"), y, marker, color="C0" if closed else "C3", label=label, markersize=5)
    for place, name in enumerate(names):
        floors = column([row for row in ended if row["case"] == name], "floor_nm")
        if len(floors):
            axes.plot([np.median(floors)] * 2, [place - 0.3, place + 0.3], "--", color="0.4", linewidth=1)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), [f"{name}, {_closed_of(members)}" for name, members in cases.items()])
    _residual_axis(axes, along="x")
    axes.legend(fontsize=8, frameon=False)
    return figure


def draw_images(folder: Path, rows: Sequence[Row]) -> Figure | None:
    """Mean profiles of the stars' images that were kept, a curve for each case, its first seed.

    Args:
        folder: Of the sweep; its `profiles.ecsv` is read.
        rows: Of its table.
    """
    profiles = read_profiles(folder)
    figure = Figure(figsize=(8.2, 4.8), layout="constrained")
    axes = figure.subplots()
    seen: set[str] = set()
    for row in rows:
        case, name = str(row["case"]), str(row["point"])
        if name not in profiles or case in seen:
            continue
        seen.add(case)
        label = f"{case}: {float(row['rms_nm']):.0f} nm, Strehl {float(row['strehl']):.2f}"
        axes.semilogy(profiles[ANGLE], profiles[name], linewidth=1.3, label=label)
    if not seen:
        return None
    axes.set_xlabel("angle [arcsec]")
    axes.set_ylabel("mean intensity, peak of a perfect telescope = 1")
    axes.set_xlim(0, float(profiles[ANGLE].max()))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False)
    return figure


def _closed_of(members: Sequence[Row]) -> str:
    outcomes = [row["outcome"] for row in members]
    return f"{outcomes.count('closed')} of {len(outcomes)} closed"


def _side_by_side(rows: Sequence[Row]) -> np.ndarray:
    """Where a loop stands in its column, by its seed."""
    seeds = column(rows, "seed")
    return 0.08 * (seeds - np.mean(seeds))


def _residual_axis(axes: Axes, *, along: Literal["x", "y"] = "y") -> None:
    (axes.set_xlabel if along == "x" else axes.set_ylabel)("residual wavefront [nm rms]")
    low, high = axes.get_xlim() if along == "x" else axes.get_ylim()
    ticks = [tick for tick in (20, 30, 40, 60, 80, 100, 120, 150, 200, 300, 500, 1000, 2000) if low < tick < high]
    if len(ticks) < FEWEST_TICKS:
        ticks = [tick for tick in MaxNLocator(6, integer=True).tick_values(low, high) if low < tick < high]
    log_axis(axes, ticks, along=along)
    (axes.set_xlim if along == "x" else axes.set_ylim)(low, high)
    axes.grid(alpha=0.3)


def _by_case(rows: Sequence[Row]) -> dict[str, list[Row]]:
    names = dict.fromkeys(str(row["case"]) for row in rows)
    return {name: [row for row in rows if row["case"] == name] for name in names}


def _curves(curves: dict[str, list[Row]], x: str, label: str) -> Figure | None:
    """Residual against a setting, a curve for each case that has rows."""
    shown = {case: told for case, told in curves.items() if told}
    if not shown:
        return None
    figure = Figure(figsize=(8.2, 4.8), layout="constrained")
    axes = figure.subplots()
    for number, (case, told) in enumerate(shown.items()):
        _curve(axes, told, f"C{number}", case, x)
    axes.set_xlabel(label)
    _residual_axis(axes)
    axes.legend(fontsize=8, frameon=False, ncols=2)
    return figure


def _curve(axes: Axes, told: Sequence[Row], color: str, label: str, x: str) -> None:
    where, rms = column(told, x), column(told, "rms_nm")
    bars = np.stack([rms - column(told, "rms_least_nm"), column(told, "rms_most_nm") - rms])
    axes.errorbar(where, rms, yerr=bars, color=color, marker="o", markersize=4, capsize=2, linewidth=1.4, label=label)
    axes.plot(where, column(told, "floor_nm"), color=color, linestyle="--", linewidth=0.8)
