"""Figures of study 01: what each accelerator buys, and how photons and turbulence rule the error."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column, log_axis

CURVES = {
    "flat-serial": "plain, from flat",
    "tilt-serial": "plain, from the tilt",
    "tilt-serial-fast-forward": "+ fast-forward",
    "tilt-serial-binned": "+ binned images first",
    "tilt-serial-low-pass": "+ low-pass at 16 CPA",
    "tilt-averaged": "averaged over planes",
    "tilt-averaged-fast-forward": "averaged + fast-forward",
    "ladder": "default: coarse to fine, filtered",
}
"""Families of the group `convergence`, by the start of their names."""


def family(name: str) -> tuple[str, int]:
    """The curve a case belongs to, and its number.

    Examples:
        >>> family("tilt-serial-binned-40")
        ('tilt-serial-binned', 40)
    """
    start, _, number = name.rpartition("-")
    return start, int(number)


def draw_convergence(table: Sequence[Row]) -> Figure | None:
    """Captured screens and error against FFTs, a curve for each family of the group `convergence`."""
    rows = [row for row in table if row["group"] == "convergence"]
    if not rows:
        return None
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, (start, label) in enumerate(CURVES.items()):
        curve = sorted((r for r in rows if family(str(r["case"]))[0] == start), key=lambda r: float(r["ffts"]))
        if not curve:
            continue
        style = {"color": f"C{number}", "marker": "o", "markersize": 3.5, "label": label}
        if start == "ladder":
            style |= {"color": "black", "linewidth": 2.2}
        left.plot(column(curve, "ffts"), 100 * column(curve, "captured"), **style)
        right.plot(column(curve, "ffts"), column(curve, "median_nm"), **style)
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_xlabel("FFTs of one plane")
        axes.grid(alpha=0.3)
    left.set_ylabel("screens below 60 nm [%]")
    left.set_ylim(0, 102)
    right.set_ylabel("median error of all screens [nm]")
    log_axis(right, (20, 30, 50, 100, 200))
    bound = [float(row["bound_nm"]) for row in table if row["case"] == "paper-8.2"]
    if bound and np.isfinite(bound[0]):
        right.axhline(bound[0], color="gray", linestyle="--", linewidth=1)
        right.annotate("photon bound", (0.02, bound[0] * 1.03), xycoords=("axes fraction", "data"), color="gray")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def draw_light_and_turbulence(table: Sequence[Row]) -> Figure | None:
    """Error against photons and against the rms of the wavefront, from the groups `photons` and `rms`."""
    photons, rms = ([row for row in table if row["group"] == group] for group in ("photons", "rms"))
    if not photons or not rms:
        return None
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for color, ending, label in (("C0", "45px", "default, 45 pixels"), ("C1", "90px", "default, 90 pixels"),
                                 ("C2", "45px-plain", "plain GS, 45 pixels")):  # fmt: skip
        rows = [row for row in photons if str(row["case"]).split("-", 2)[2] == ending]
        _curve(left, rows, column(rows, "photons"), color, label)
    left.set_xscale("log")
    left.set_xlabel("photons in the exposure")
    for color, plain, label in (("C0", False, "default, 45 pixels"), ("C2", True, "plain GS, 45 pixels")):
        ending = ["plain"] if plain else []
        rows = [row for row in rms if str(row["case"]).split("-")[2:] == ending]
        at_nm = np.array([float(str(row["case"]).split("-")[1]) for row in rows])
        _curve(right, rows, at_nm, color, label)
    right.set_xlabel("mean rms of the wavefront, tilt included [nm]")
    for axes in (left, right):
        axes.set_ylabel("error [nm rms]")
        log_axis(axes, (5, 10, 20, 30, 50, 100, 200))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    return figure


def _curve(axes: Axes, rows: Sequence[Row], at: np.ndarray, color: str, label: str) -> None:
    if not rows:
        return
    median = column(rows, "median_nm")
    bars = np.stack([median - column(rows, "p5_nm"), column(rows, "p95_nm") - median])
    axes.errorbar(at, median, yerr=bars, color=color, marker="o", markersize=4, capsize=2, linewidth=1.2, label=label)
    bound = column(rows, "bound_nm")
    known = np.isfinite(bound)
    if known.any():
        axes.plot(at[known], bound[known], color=color, linestyle="--", linewidth=1)
