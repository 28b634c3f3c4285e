"""The figure of study 11: how soon the steps between segments are found, and how well."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import log_axis

PUPILS = {"discs": "four discs of 2.4 m in 8 m", "gmt": "seven mirrors in 25.4 m"}
"""First words of the cases of the group `iterations`, PUPIL-FAMILY-ITERATIONS, and what they are."""

FAMILIES = {"plain": ("C7", "Gerchberg-Saxton, plain"), "forward": ("C0", "+ fast-forward")}
"""Color and label."""


def draw_segments(table: Sequence[Row]) -> Figure | None:
    """Errors of the steps modulo the wavelength, and inside the segments, against the iterations of the field."""
    rows = [row for row in table if row["group"] == "iterations"]
    if not rows:
        return None
    figure = Figure(figsize=(7.2, 5.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey="row")
    for (upper, lower), (name, title) in zip(panels.T, PUPILS.items(), strict=True):
        upper.set_title(title)
        for panel, key in ((upper, "piston_modulo"), (lower, "inside")):
            for family, (color, label) in FAMILIES.items():
                _curve(panel, rows, f"{name}-{family}-", key, color, label)
            likely = [row for row in rows if row["case"] == f"{name}-map"]
            if likely:
                panel.axhline(float(likely[0][f"{key}_nm"]), color="black", label="most likely wavefront (50 first)")
            panel.grid(alpha=0.3)
        log_axis(upper, (0.1, 1, 10, 100))
        log_axis(lower, (1, 3, 10, 30, 100))
        lower.set_xscale("log")
        lower.set_xticks((5, 10, 20, 50, 100), ("5", "10", "20", "50", "100"))
        lower.xaxis.set_minor_locator(NullLocator())
        lower.set_xlabel("iterations")
    panels[0, 0].set_ylabel("steps modulo the wavelength [nm]")
    panels[1, 0].set_ylabel("inside the segments [nm]")
    panels[0, 0].legend(fontsize="small")
    return figure


def _curve(panel: Axes, rows: list[Row], start: str, key: str, color: str, label: str) -> None:
    """Median, and up to the worst screen."""
    found = sorted((int(str(row["case"])[len(start) :]), row) for row in rows if str(row["case"]).startswith(start))
    if not found:
        return
    iterations = np.array([one for one, _ in found])
    median, worst = (np.array([float(row[f"{key}{end}"]) for _, row in found]) for end in ("_nm", "_worst_nm"))
    panel.plot(iterations, median, "o-", color=color, label=label)
    panel.fill_between(iterations, median, worst, color=color, alpha=0.15, linewidth=0)
