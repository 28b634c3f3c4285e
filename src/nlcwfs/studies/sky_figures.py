"""The figure of study 14: what dispersion, the size of the star and scintillation cost, beside their closed forms."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column, log_axis

ALLOWED = 1.1
"""Error over that without the effect, at which the budget ends."""

PHOTONS = {"2e4": "C0", "2e6": "C3"}
"""Colour by number of photons, as it is written in the names of the cases: EFFECT-RMS-PHOTONS-STRENGTH."""


class Effect(NamedTuple):
    """One of the effects, a column of panels.

    Attributes:
        key: Column of the table that says how strong it is.
        label: What that is.
        without: Effect whose case of strength 0 is without it.
    """

    key: str
    label: str
    without: str


EFFECTS = {
    "star": Effect("star_mas", "diameter of the star [mas]", "star"),
    "dispersion": Effect("dispersion_mas", "residual dispersion [mas rms]", "dispersion"),
    "scintillation": Effect("index", "scintillation index of a point", "star"),
}


class Curve(NamedTuple):
    """Errors at growing strength of an effect, over that without it; the first is without it.

    Attributes:
        strength: Of the effect.
        measured: Median error.
        low: 16th percentile.
        high: 84th percentile.
        expected: By the closed form.
        without_nm: The error without the effect.
    """

    strength: Float[np.ndarray, " case"]
    measured: Float[np.ndarray, " case"]
    low: Float[np.ndarray, " case"]
    high: Float[np.ndarray, " case"]
    expected: Float[np.ndarray, " case"]
    without_nm: float


def curve(table: Sequence[Row], effect: str, *, rms: str, photons: str, told: bool = False) -> Curve | None:
    """The cases of an effect, behind one wavefront and at one number of photons; None where they are missing.

    Args:
        table: Rows of the study.
        effect: One of `EFFECTS`.
        rms: Of the wavefront, and ...
        photons: ... photons, as in the names of the cases.
        told: Whether the model knows the effect.
    """
    group = f"{effect}-told" if told else effect
    starts = f"{group}-{rms}-{photons}-"
    key, _, without = EFFECTS[effect]
    rows = [row for row in table if row["group"] == group and str(row["case"]).startswith(starts)]
    found = [row for row in table if row["case"] == f"{without}-{rms}-{photons}-0"]
    if told:  # a model of several colours has an error of its own without the effect
        found = [row for row in rows if str(row["case"]) == f"{starts}0"] or found
    rows = sorted((row for row in rows if _number(row, key) > 0), key=lambda row: _number(row, key))
    if not rows or not found:
        return None
    without_nm = float(found[0]["median_pixels_nm"])
    errors = {name: column([*found, *rows], f"{name}_pixels_nm") / without_nm for name in ("median", "p16", "p84")}
    return Curve(
        strength=np.append(0, column(rows, key)),
        measured=errors["median"],
        low=errors["p16"],
        high=errors["p84"],
        expected=np.hypot(1, np.append(0, column(rows, "added_nm")) / without_nm),
        without_nm=without_nm,
    )


def budget(strength: Float[np.ndarray, " case"], ratio: Float[np.ndarray, " case"]) -> float:
    """How strong an effect may be before the error has grown by a tenth; infinite if it does not within the cases.

    Between cases the square of the error grows as the square of the strength.

    Examples:
        >>> round(budget(np.array([0.0, 2.0]), np.array([1.0, np.hypot(1, 1)])), 2)
        0.92
    """
    beyond = np.flatnonzero(ratio >= ALLOWED)
    if not beyond.size:
        return math.inf
    last = int(beyond[0])
    before, after = ratio[last - 1] ** 2, ratio[last] ** 2
    low, high = strength[last - 1] ** 2, strength[last] ** 2
    return math.sqrt(low + (high - low) * (ALLOWED**2 - before) / (after - before))


def draw_sky_budgets(table: Sequence[Row]) -> Figure | None:
    """Error over that without the effect; a column of panels for each effect, a row for each wavefront."""
    rms = sorted({_parts(row)[0] for row in table if str(row["group"]) in EFFECTS}, key=float)
    rms = [one for one in rms if curve(table, "scintillation", rms=one, photons="2e6")]
    if not rms:
        return None
    figure = Figure(figsize=(10.5, 3.3 * len(rms)), layout="constrained")
    panels = figure.subplots(len(rms), len(EFFECTS), sharey=True, sharex="col", squeeze=False)
    for row, one in zip(panels, rms, strict=True):
        for panel, effect in zip(row, EFFECTS, strict=True):
            _panel(panel, table, effect, one)
        log_axis(row[0], (1, 1.1, 1.5, 2, 3))
        row[0].set_ylabel(f"{one} nm rms: error over that without")
    for panel, effect in zip(panels[-1], EFFECTS.values(), strict=True):
        panel.set_xlabel(effect.label)
    panels[0, 0].set_ylim(0.9, 4)
    return figure


def _panel(panel: Axes, table: Sequence[Row], effect: str, rms: str) -> None:
    for photons, colour in PHOTONS.items():
        found = curve(table, effect, rms=rms, photons=photons)
        if found is None:
            continue
        bars = np.abs(np.array([found.measured - found.low, found.high - found.measured]))
        label = f"{photons} photons, {found.without_nm:.1f} nm without"
        panel.errorbar(found.strength, found.measured, bars, fmt="o-", color=colour, label=label, markersize=4, lw=1)
        panel.plot(found.strength, found.expected, "--", color=colour, lw=1.2)
        told = curve(table, effect, rms=rms, photons=photons, told=True)
        if told is not None:
            label = "the model is told" if photons == "2e6" else None
            panel.plot(told.strength[1:], told.measured[1:], "o", color=colour, mfc="white", label=label)
            panel.plot(told.strength, told.expected, ":", color=colour, lw=1.4)
    panel.axhline(ALLOWED, color="gray", linewidth=0.8)
    panel.grid(alpha=0.3)
    if panel.get_legend_handles_labels()[0]:
        panel.legend(fontsize=7, loc="upper left")


def _parts(row: Row) -> list[str]:
    return str(row["case"]).removeprefix(f"{row['group']}-").split("-")


def _number(row: Row, key: str) -> float:
    value = row.get(key, 0.0)
    return float(value) if isinstance(value, int | float) and value == value else 0.0
