"""Figures of sweeps of the loop: what is left at each rate, and the star's image."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.studies.image_profiles import ANGLE, read_profiles
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.sweep_report import over_seeds
from nlcwfs.studies.table_axes import column, log_axis

RATE = "loop.rate_hz"

LEAST_RATES = 3
"""Fewer are no curve."""


def draw_rates(folder: Path, rows: Sequence[Row]) -> Figure | None:
    """Residual against the rate, a curve for each case that has several.

    Args:
        folder: Of the sweep; nothing is read from it.
        rows: Of its table.
    """
    figure = Figure(figsize=(8.2, 4.8), layout="constrained")
    axes = figure.subplots()
    drawn = 0
    for case in dict.fromkeys(str(row["case"]) for row in rows):
        told = over_seeds([row for row in rows if row["case"] == case], [RATE])
        told = sorted((row for row in told if int(row["closed"])), key=lambda row: float(row[RATE]))
        if len(told) < LEAST_RATES:
            continue
        _curve(axes, told, f"C{drawn}", case)
        drawn += 1
    if not drawn:
        return None
    axes.set_xlabel("exposures a second")
    axes.set_ylabel("residual wavefront [nm rms]")
    low, high = axes.get_ylim()
    log_axis(axes, [tick for tick in (20, 30, 40, 60, 80, 100, 150, 200, 300, 500, 1000) if low < tick < high])
    axes.set_ylim(low, high)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False, ncols=2)
    return figure


def _curve(axes: Axes, told: Sequence[Row], color: str, label: str) -> None:
    rate, rms = column(told, RATE), column(told, "rms_nm")
    bars = np.stack([rms - column(told, "rms_least_nm"), column(told, "rms_most_nm") - rms])
    axes.errorbar(rate, rms, yerr=bars, color=color, marker="o", markersize=4, capsize=2, linewidth=1.4, label=label)
    axes.plot(rate, column(told, "floor_nm"), color=color, linestyle="--", linewidth=0.8)


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
