"""The figure of a study of contrast: the halo against the angle, a panel for each sensor (Guyon 2010, Fig. 12)."""

from collections.abc import Sequence
from functools import partial

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

from nlcwfs.studies.contrast_table import BEST, GIVEN
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column

PANEL_IN = 4.3
"""Width of a panel in inches."""

ANGLE_TICKS_MAS = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
WAVE_TICKS = (1, 2, 4, 8, 16, 32, 64, 128)


def draw_contrast(rows: Sequence[Row], loops: Sequence[Row] = ()) -> Figure:
    """Draw the halo of each sensor at each rate, at the best rate, and what loops have shown.

    Args:
        rows: Of the table of contrast.
        loops: Of the table of loops, see `studies.contrast_loop`; each stands in the panel of its sensor.

    Examples:
        >>> row = {"sensor": "ideal", "rate": "given", "rate_hz": 1e3, "cycles_per_aperture": 1.0, "uncorrected": 1e-2}
        >>> rows = [row | {"angle_mas": angle, "contrast": 1e-5} for angle in (41.0, 82.0)]
        >>> draw_contrast(rows).axes[0].get_title()
        'Ideal'
    """
    sensors = list(dict.fromkeys(str(row["sensor"]) for row in rows))
    figure = Figure(figsize=(PANEL_IN * len(sensors) + 0.6, 4.7), layout="constrained")
    panels = figure.subplots(1, len(sensors), sharey=True, squeeze=False)[0]
    rates = sorted({float(row["rate_hz"]) for row in rows if row["rate"] == GIVEN})
    colors = dict(zip(rates, matplotlib.colormaps["viridis"](np.linspace(0.05, 0.88, len(rates))), strict=True))
    for axes, sensor in zip(panels, sensors, strict=True):
        _draw_panel(axes, [row for row in rows if row["sensor"] == sensor], colors)
        _draw_loops(axes, [row for row in loops if row["sensor"] == sensor])
        axes.set_title(_title(sensor), fontsize=11)
    panels[0].set_ylabel("contrast $C_2$: mean halo over the star's peak")
    values = column(rows, "contrast")
    panels[0].set_ylim(10 ** np.floor(np.log10(values.min()) - 0.1), 20 * values.max())
    shown = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=5, fontsize=8.5, frameon=False)
    return figure


def _draw_panel(axes: Axes, rows: Sequence[Row], colors: dict[float, np.ndarray]) -> None:
    """The curves of one sensor."""
    given = [row for row in rows if row["rate"] == GIVEN]
    first = [row for row in given if row["rate_hz"] == given[0]["rate_hz"]]
    angle_mas, air = column(first, "angle_mas"), column(first, "uncorrected")
    axes.loglog(angle_mas, air, ":", color="0.45", linewidth=1.2, label="not corrected")
    for rate_hz, color in colors.items():
        shown = [row for row in given if float(row["rate_hz"]) == rate_hz]
        label = _in_hz(rate_hz)
        axes.loglog(column(shown, "angle_mas"), column(shown, "contrast"), color=color, linewidth=1.5, label=label)
    best = [row for row in rows if row["rate"] == BEST]
    if best:
        best_mas, least = column(best, "angle_mas"), column(best, "contrast")
        axes.loglog(best_mas, least, "--", color="black", linewidth=1.2, label="best rate of each angle")
    axes.set_xlim(angle_mas.min() / 1.05, angle_mas.max() * 1.05)
    axes.set_xlabel("angle from the star [mas]")
    _ticks(axes, angle_mas, column(first, "cycles_per_aperture"))
    axes.grid(alpha=0.3)


def _draw_loops(axes: Axes, loops: Sequence[Row]) -> None:
    """What loops have shown, and the closed form with their own flux factor."""
    for marker, rate_hz in zip("osD^v", sorted({float(row["rate_hz"]) for row in loops}), strict=False):
        shown = [row for row in loops if float(row["rate_hz"]) == rate_hz]
        angle_mas, name = column(shown, "angle_mas"), f"closed loops at {_in_hz(rate_hz)}"
        style = {"linestyle": "", "marker": marker, "color": "C3", "markersize": 6}
        axes.plot(angle_mas, column(shown, "measured"), **style, label=name)
        axes.plot(angle_mas, column(shown, "contrast"), **style, fillstyle="none", label="closed form of these loops")


def _title(sensor: str) -> str:
    across = sensor.removeprefix("shack-hartmann-")
    return sensor[:1].upper() + sensor[1:] if across == sensor else f"Shack-Hartmann, $D/d$ = {across}"


def _in_hz(rate_hz: float) -> str:
    return f"{rate_hz / 1000:g} kHz" if rate_hz >= 1000 else f"{rate_hz:g} Hz"


def _ticks(axes: Axes, angle_mas: np.ndarray, waves: np.ndarray) -> None:
    """Plain numbers below, cycles per aperture above."""
    axes.xaxis.set_major_locator(FixedLocator(list(ANGLE_TICKS_MAS)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    scale = float(waves[0] / angle_mas[0])
    above = axes.secondary_xaxis("top", functions=(partial(np.multiply, scale), partial(np.multiply, 1 / scale)))
    above.set_xlabel("cycles per aperture", fontsize=9)
    above.xaxis.set_major_locator(FixedLocator(list(WAVE_TICKS)))
    above.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    above.xaxis.set_minor_locator(NullLocator())
    above.tick_params(labelsize=8)
