"""Figures of study 02: error and success against FFTs for every method, and whether predicted errors are honest."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column, log_axis

METHODS = {
    "plain": ("C7", "Gerchberg-Saxton, plain"),
    "fast-forward": ("C4", "+ fast-forward"),
    "averaged": ("C2", "averaged over planes"),
    "ladder": ("C0", "coarse to fine, filtered"),
    "linear": ("C1", "linear, with updates"),
    "map": ("black", "most likely wavefront (default)"),
}
"""Colour and label of the families of the group `methods`, whose cases are `PHOTONS-FAMILY-BUDGET`."""

SHOWN = {"plain": "40", "fast-forward": "40", "averaged": "40", "ladder": "8-20", "linear": "1", "map": "3-4"}
"""The budget of each family in the figure of predicted errors."""

GROUPS = {
    "": ("black", "o", "whole"),
    "_low": ("C3", "v", "below 4 cycles per aperture"),
    "_middle": ("C1", "s", "4 to 12"),
    "_high": ("C0", "^", "above 12"),
}
"""Colour, marker and label of the columns `error_over_predicted`."""


def parts(name: str) -> tuple[str, str, str]:
    """Photons, family and budget of a case of the group `methods`.

    Examples:
        >>> parts("2e4-fast-forward-40"), parts("2e5-ladder-8-20")
        (('2e4', 'fast-forward', '40'), ('2e5', 'ladder', '8-20'))
    """
    photons, rest = name.split("-", 1)
    family = next((one for one in METHODS if rest.startswith(f"{one}-")), rest)
    return photons, family, rest[len(family) + 1 :]


def draw_cost(table: Sequence[Row]) -> Figure | None:
    """Error and captured share against FFTs of a frame, a column of panels for each number of photons."""
    rows = [row for row in table if row["group"] == "methods"]
    lights = sorted({float(row["photons"]) for row in rows})
    if not lights:
        return None
    width = max(6.5, 0.6 + 3.1 * len(lights))
    figure = Figure(figsize=(width, 6.4), layout="constrained")
    panels = figure.subplots(2, len(lights), sharex=True, sharey="row", squeeze=False, height_ratios=(1.6, 1))
    for upper, lower, photons in zip(*panels, lights, strict=True):
        same = [row for row in rows if float(row["photons"]) == photons]
        for family, (color, label) in METHODS.items():
            curve = [row for row in same if parts(str(row["case"]))[1] == family]
            _cost_curve(upper, lower, curve, color, label)
        _bounds(upper, same)
        upper.set_title(f"{_power(photons)} photons", fontsize=10)
        lower.set_xlabel("FFTs of one plane")
        for axes in (upper, lower):
            axes.set_xscale("log")
            axes.grid(alpha=0.3)
    log_axis(panels[0, 0], (5, 10, 20, 50, 100, 200, 500))
    panels[0, 0].set_ylabel("error on the pixels [nm rms]")
    panels[1, 0].set_ylabel("captured [%]")
    panels[1, 0].set_ylim(-3, 103)
    # A table that is still growing has not every method in every panel.
    shown = {label: line for axes in panels[0] for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(list(shown.values()), list(shown), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def draw_calibration(table: Sequence[Row]) -> Figure | None:
    """Error over predicted error: of `map` for every sky by frequency, of every method for every number of photons."""
    told = [row for row in table if row.get("method") == "map" and _is_shown(row)]
    if not told:
        return None
    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1), sharey=True)
    for ending, (color, marker, label) in GROUPS.items():
        values = column(told, f"error_over_predicted{ending}")
        left.plot(range(len(told)), values, marker, color=color, label=label, markersize=5)
    left.set_xticks(range(len(told)), [_sky(row) for row in told], rotation=60, ha="right", fontsize=7.5)
    methods = [row for row in table if row["group"] == "methods" and _is_shown(row)]
    for family, (color, label) in METHODS.items():
        curve = sorted((r for r in methods if parts(str(r["case"]))[1] == family), key=lambda r: float(r["photons"]))
        if curve:
            values = column(curve, "error_over_predicted")
            right.plot(column(curve, "photons"), values, "o-", color=color, label=label, markersize=4, linewidth=1)
    right.set_xscale("log")
    right.set_xlabel("photons in the exposure")
    left.set_ylabel("error over predicted error")
    log_axis(left, (0.5, 0.7, 1, 1.5, 2, 3, 5))
    for axes in (left, right):
        axes.axhline(1, color="gray", linewidth=1)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7.5, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return figure


def _cost_curve(upper: Axes, lower: Axes, rows: list[Row], color: str, label: str) -> None:
    rows = sorted(rows, key=lambda row: float(row["ffts"]))
    if not rows:
        return
    ffts = column(rows, "ffts")
    upper.plot(ffts, column(rows, "median_pixels_nm"), "o-", color=color, markersize=3.5, linewidth=1.4, label=label)
    low, high = column(rows, "p16_pixels_nm"), column(rows, "p84_pixels_nm")
    if len(rows) == 1:
        upper.vlines(ffts, low, high, color=color, alpha=0.4)
    upper.fill_between(ffts, low, high, color=color, alpha=0.15, linewidth=0)
    lower.plot(ffts, 100 * column(rows, "captured_pixels"), "o-", color=color, markersize=3.5, linewidth=1.4)


def _bounds(axes: Axes, rows: list[Row]) -> None:
    for name, style, label in (("bound_pixels_nm", "--", "photon bound"), ("quantum_pixels_nm", ":", "quantum limit")):
        known = column(rows, name)
        known = known[np.isfinite(known)]
        if known.size:
            axes.axhline(known[0], color="gray", linestyle=style, linewidth=1.2, label=label)


def _is_shown(row: Row) -> bool:
    """Whether this is its family's budget for the figure of predicted errors; other groups have one each."""
    if row["group"] != "methods":
        return True
    _, family, budget = parts(str(row["case"]))
    return SHOWN.get(family) == budget


def _sky(row: Row) -> str:
    """A case in a few words."""
    if row["group"] == "methods":
        return f"{_power(float(row['photons']))} photons"
    return str(row["case"]).removesuffix("-map")


def _power(photons: float) -> str:
    """2e4 as `2 10^4`, typeset."""
    exponent = math.floor(math.log10(photons))
    return rf"${photons / 10**exponent:g} \times 10^{exponent}$"
