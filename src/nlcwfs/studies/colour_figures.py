"""The figure of study 13: colours in the model in place of chromatic lenses, and what they cost."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column, log_axis

BANDS = {0.1: "C0", 0.2: "C2", 0.4: "C1", 0.6: "C3"}
"""Colour of each width of the band, over the wavelength."""

LENSES = {"ideal": ("s", "ideal lenses"), "doublet": ("^", "doublet")}
"""Marker and label; achromatic ones have a line."""


def draw_colours_for_lenses(table: Sequence[Row]) -> Figure | None:
    """Error over that of one colour, and FFTs over those of its model, against colours in the model."""
    groups = [name for name in dict.fromkeys(str(row["group"]) for row in table) if _alone(table, name)]
    if not groups:
        return None
    figure = Figure(figsize=(4.1 * (len(groups) + 1), 4.4), layout="constrained")
    panels = figure.subplots(1, len(groups) + 1)
    for panel, name in zip(panels, groups, strict=False):
        _errors(panel, [row for row in table if row["group"] == name], _alone(table, name)[0])
    panels[0].set_ylabel("error over that in light of one wavelength")
    panels[0].legend(fontsize=7.5, frameon=False)
    for panel in panels[1:-1]:
        panel.sharey(panels[0])
    _cost(panels[-1], [row for row in table if row["group"] == groups[0]], _alone(table, groups[0])[0])
    for panel in panels:
        panel.set_xlabel("wavelengths in the model")
        panel.set_xticks((1, 3, 5, 9))
        panel.grid(alpha=0.3)
    return figure


def _alone(table: Sequence[Row], group: str) -> list[Row]:
    """The case of light of one wavelength."""
    return [row for row in table if row["group"] == group and str(row["case"]).startswith("one-")]


def _errors(panel: Axes, rows: list[Row], alone: Row) -> None:
    without_nm = float(alone["median_pixels_nm"])
    panel.set_title(f"{alone['group']} nm rms: {without_nm:.1f} nm in one wavelength", fontsize=10)
    panel.axhline(1, color="black", linewidth=1)
    for band, colour in BANDS.items():
        achromatic = _sorted(rows, band, "achromatic")
        if achromatic:
            low, middle, high = (
                column(achromatic, f"{one}_pixels_nm") / without_nm for one in ("p16", "median", "p84")
            )
            told, label = column(achromatic, "model_colours"), f"{band:.0%}, achromatic"
            bars = np.array([middle - low, high - middle])
            panel.errorbar(told, middle, bars, fmt="o-", color=colour, label=label, markersize=4, lw=1.2)
        for lenses, (marker, label) in LENSES.items():
            found = _sorted(rows, band, lenses)
            if found:
                ratio = column(found, "median_pixels_nm") / without_nm
                places = column(found, "model_colours") - 0.25
                shown = f"{band:.0%}, {label}"
                panel.plot(places, ratio, marker, color=colour, mfc="white", label=shown, markersize=6)
    log_axis(panel, (1, 1.2, 1.5, 2, 3, 5))


def _cost(panel: Axes, rows: list[Row], alone: Row) -> None:
    achromatic = _sorted(rows, 0.4, "achromatic")
    told = column(achromatic, "model_colours")
    panel.plot(told, column(achromatic, "ffts") / float(alone["ffts"]), "o-", color="black", label="FFTs", markersize=4)
    panel.plot(told, told, ":", color="gray", label="wavelengths")
    panel.set_ylabel("over a model of one wavelength (band of 40 %)")
    panel.set_ylim(0)
    panel.legend(fontsize=7.5, frameon=False)


def _sorted(rows: list[Row], band: float, lenses: str) -> list[Row]:
    same = [row for row in rows if row.get("band") == band and row.get("lenses") == lenses]
    return sorted(same, key=lambda row: float(row["model_colours"]))
