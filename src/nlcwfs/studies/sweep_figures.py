"""The figures that a sweep asks for, drawn from the rows of its table."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from nlcwfs.errors import FileFormatError
from nlcwfs.studies.loop_figures import draw_cases, draw_images, draw_magnitudes, draw_rates
from nlcwfs.studies.study_figures import Drawings
from nlcwfs.studies.study_table import Row

SWEEP_FIGURES: dict[str, tuple[Callable[[Path, Sequence[Row]], Figure | None], str]] = {
    "rates": (
        draw_rates,
        "What is left against the rate: median and range over the seeds. Dashed, in the same color: the bound of "
        "mirror, lag of one exposure and quantum limit.",
    ),
    "magnitudes": (
        draw_magnitudes,
        "What is left against the magnitude of the star, each at the best of the rates that were tried: median and "
        "range over the seeds. Dashed, in the same color: the bound of mirror, lag of one exposure and quantum limit.",
    ),
    "cases": (
        draw_cases,
        "What is left, a point for each seed. Dashed: the bound of mirror, lag of one exposure and quantum limit.",
    ),
    "images": (
        draw_images,
        "The star behind the loop, mean over rings around the axis, each relative to the peak of a perfect telescope.",
    ),
}
"""What `figures = [...]` of a sweep may name: a drawing and its caption."""


def drawings_of(folder: Path) -> Drawings:
    """The same for the sweep in a folder."""
    return {name: (partial(draw, folder), caption) for name, (draw, caption) in SWEEP_FIGURES.items()}


def check_figures(path: Path, names: tuple[str, ...]) -> None:
    """Refuse a figure that there is not, before anything is computed.

    Args:
        path: The sweep's file, for the message.
        names: Figures that it asks for.

    Raises:
        FileFormatError: If there is no such figure.
    """
    for name in names:
        if name not in SWEEP_FIGURES:
            raise FileFormatError(f"{path}: figures: must be of {sorted(SWEEP_FIGURES)}, got {name}")
