"""What figures of tables share: numbers of a column, axes with plain numbers."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from nlcwfs.studies.study_table import Row


def column(rows: Sequence[Row], name: str) -> Float[np.ndarray, " row"]:
    """A column as numbers; NaN where a row lacks it.

    Examples:
        >>> column([{"ffts": 40.0}, {}], "ffts").tolist()
        [40.0, nan]
    """
    return np.array([float(row.get(name, np.nan)) for row in rows])


def log_axis(axes: Axes, ticks: Sequence[int | float], *, along: Literal["x", "y"] = "y") -> None:
    """Make an axis logarithmic, with plain numbers at these places only."""
    axis = axes.xaxis if along == "x" else axes.yaxis
    (axes.set_xscale if along == "x" else axes.set_yscale)("log")
    axis.set_minor_locator(NullLocator())
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
