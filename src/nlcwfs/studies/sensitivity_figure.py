"""The figure and the page of a table of flux factors: photons needed, relative to the quantum limit."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.interop import atomic_write
from nlcwfs.simulation.sensitivity_settings import SensitivityQuestion
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.table_axes import column

CYCLES, NOLL = "cycles_per_aperture", "noll"

CAPTION = (
    "Photons needed for a signal-to-noise ratio over those of the ideal sensor (quantum limit), each mode alone. "
    "Bands: 16 to 84 % of the wavefronts. Right: the same as Guyon's (2005) beta, the root."
)


def draw_sensitivity(rows: Sequence[Row]) -> Figure:
    """A panel for each roughness, a curve for each sensor.

    Args:
        rows: Of the table.
    """
    levels = sorted({float(row["rms_rad"]) for row in rows})
    names = list(dict.fromkeys(str(row["sensor"]) for row in rows))
    columns = min(2, len(levels))
    lines = math.ceil(len(levels) / columns)
    figure = Figure(figsize=(4.6 * columns + 0.6, 3.7 * lines + 0.9), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, level in zip(panels, levels, strict=False):
        _panel(axes, [row for row in rows if row["rms_rad"] == level], names)
        axes.set_title("flat wavefront" if level == 0 else f"{level:g} rad rms", fontsize=10)
    for axes in panels[len(levels) :]:
        axes.set_visible(False)
    handles = {line.get_label(): line for axes in panels for line in axes.get_lines() if line.get_label() in names}
    shown = [name for name in names if name in handles]
    figure.legend([handles[name] for name in shown], shown, loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _panel(axes: Axes, rows: Sequence[Row], names: Sequence[str]) -> None:
    key = CYCLES if CYCLES in rows[0] and math.isfinite(float(rows[0][CYCLES])) else NOLL
    for number, name in enumerate(names):
        mine = [row for row in rows if row["sensor"] == name]
        if not mine:
            continue
        x, y = column(mine, key), column(mine, "flux_factor")
        seen, style = np.isfinite(y), "-" if mine[0]["reconstruction"] == "non-linear" else "--"
        axes.plot(x[seen], y[seen], style, color=f"C{number}", marker="o", markersize=3, linewidth=1.4, label=name)
        low, high = column(mine, "flux_factor_p16"), column(mine, "flux_factor_p84")
        axes.fill_between(x[seen], low[seen], high[seen], color=f"C{number}", alpha=0.2, linewidth=0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhline(1, color="0.3", linewidth=0.8)
    axes.grid(alpha=0.3)
    axes.set_xlabel("cycles per aperture" if key == CYCLES else "Zernike, Noll's number", fontsize=9)
    axes.set_ylabel("photons over the ideal", fontsize=9)
    beta = axes.secondary_yaxis("right", functions=(np.sqrt, np.square))
    beta.set_ylabel("beta", fontsize=9)
    if key == CYCLES:
        ticks = sorted({float(row[CYCLES]) for row in rows if float(row[CYCLES]).is_integer()})
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()


def write_sensitivity_page(folder: Path, question: SensitivityQuestion, rows: Sequence[Row]) -> Path:
    """Draw the figure and write `README.md` beside the table.

    Args:
        folder: Of the table.
        question: And its answer.
        rows: Of the table.

    Returns:
        The page.
    """
    with atomic_write(folder / "sensitivity.png") as temporary:
        draw_sensitivity(rows).savefig(temporary, dpi=150, format="png")
    lines = [
        f"# {question.answer}",
        "",
        question.question,
        "",
        f"![{CAPTION}](sensitivity.png)",
        "",
        f"*{CAPTION}*",
        "",
    ]
    for level in sorted({float(row["rms_rad"]) for row in rows}):
        lines += [f"## {'Flat wavefront' if level == 0 else f'{level:g} rad rms'}", ""]
        lines += [*factor_table([row for row in rows if row["rms_rad"] == level]), ""]
    path = folder / "README.md"
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join([*lines, question.notes.strip(), ""]), encoding="utf-8")
    return path


def factor_table(rows: Sequence[Row]) -> list[str]:
    r"""Markdown: a line for each sensor, a column for each mode; a sensor that does not see a mode is called blind.

    Args:
        rows: Of one roughness.

    Examples:
        >>> row = {"sensor": "pupil", "cycles_per_aperture": 2.0, "flux_factor": float("inf"), "light": 1.0}
        >>> print("\n".join(factor_table([row])))
        | sensor | light | 2 |
        |---|---|---|
        | pupil | 100 % | blind |
    """
    key = CYCLES if math.isfinite(float(rows[0].get(CYCLES, math.nan))) else NOLL
    modes = sorted({float(row[key]) for row in rows})
    lines = [
        f"| sensor | light | {' | '.join(f'{mode:g}' for mode in modes)} |",
        f"|{'---|' * (len(modes) + 2)}",
    ]
    for name in dict.fromkeys(row["sensor"] for row in rows):
        mine = {float(row[key]): row for row in rows if row["sensor"] == name}
        cells = [_in_words(float(mine[mode]["flux_factor"])) if mode in mine else "" for mode in modes]
        light = next(iter(mine.values()))["light"]
        lines.append(f"| {name} | {light:.0%} | {' | '.join(cells)} |".replace("%", " %"))
    return lines


def _in_words(factor: float) -> str:
    if math.isinf(factor):
        return "blind"
    return f"{factor:.3g}" if factor < 1000 else f"{factor:.0f}"
