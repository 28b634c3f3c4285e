"""The figure of study 12: how often whole wavelengths of steps are right, and whether the estimates know."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column

FAMILIES = {
    "discs": ("C0", "o-", "achromatic lenses"),
    "ideal": ("C1", "s-", "ideal lenses"),
    "gmt": ("C2", "^-", "GMT"),
}
"""First words of the cases FAMILY-PHOTONS: color, mark and label."""

LEAST_TOLD = 1e-4
"""Smaller probabilities are drawn here: so few trials tell no more."""


def draw_turns(table: Sequence[Row]) -> Figure | None:
    """Share of the trials that are right against photons and band; wrong trials against what was told."""
    rows = [row for row in table if float(row.get("turns_right", np.nan)) >= 0]
    if not rows:
        return None
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    photons, band, honest = figure.subplots(1, 3)
    for family, (color, mark, label) in FAMILIES.items():
        of_family = [row for row in rows if str(row["case"]).split("-")[0] == family]
        _shares(photons, column(of_family, "photons"), of_family, color, mark, label)
    photons.set_xscale("log")
    photons.set_xlabel("photons")
    photons.set_ylabel("whole wavelengths right [%]")
    photons.legend(fontsize="small")
    bands = [(_band(row), row) for row in rows if _band(row)]
    _shares(band, np.array([width for width, _ in bands]), [row for _, row in bands], "C0", "o-", "1e5 photons")
    band.set_xlabel("band [% of the wavelength]")
    band.legend(fontsize="small")
    _calibration(honest, rows)
    return figure


def _band(row: Row) -> float:
    """Width of the band in percent: cases are named `band-WIDTH`, and `discs` has half the wavelength; 0 for others."""
    name = str(row["case"])
    return 50.0 if name == "discs" else float(name.removeprefix("band-")) if name.startswith("band-") else 0.0


def _shares(
    panel: Axes, places: Float[np.ndarray, " row"], rows: Sequence[Row], color: str, mark: str, label: str
) -> None:
    """Shares with Wilson's intervals."""
    if not rows:
        return
    order = np.argsort(places)
    right, low, high = (100 * column(rows, f"turns_right{end}")[order] for end in ("", "_low", "_high"))
    bars = np.maximum([right - low, high - right], 0)
    panel.errorbar(places[order], right, bars, fmt=mark, color=color, label=label, capsize=2)
    panel.set_ylim(-3, 103)
    panel.grid(alpha=0.3)


def _calibration(panel: Axes, rows: Sequence[Row]) -> None:
    """Share that is wrong against the mean probability that was told."""
    told = np.maximum(column(rows, "told_wrong"), LEAST_TOLD)
    right, low, high = (column(rows, f"turns_right{end}") for end in ("", "_low", "_high"))
    wrong = np.maximum(1 - right, LEAST_TOLD)
    bars = np.maximum([wrong - (1 - high), (1 - low) - wrong], 0)
    panel.errorbar(told, wrong, bars, fmt="o", color="C0", markersize=4, capsize=2, linewidth=0.8)
    panel.plot([LEAST_TOLD, 1], [LEAST_TOLD, 1], color="black", linewidth=0.8, label="honest")
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlim(LEAST_TOLD / 1.5, 1.5)
    panel.set_ylim(LEAST_TOLD / 1.5, 1.5)
    panel.set_xlabel("told: mean probability of a wrong turn")
    panel.set_ylabel("share that is wrong")
    panel.grid(alpha=0.3)
    panel.legend(fontsize="small")
