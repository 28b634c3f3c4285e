"""Where the panels of a picture lie, and their bars of colour."""

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

PANEL_IN = 2.35
"""Width of a panel in inches: four of them fill the width of a page."""


class Board:
    """Square panels of equal size in rows, each row with a thin strip below for its bars of colour; in inches.

    Examples:
        >>> board = Board(rows=2, columns=4)
        >>> board.panel(0, 3) is board.panel(0, 3), len(board.figure.axes)
        (True, 1)
    """

    gap, above, below = 0.14, 0.26, 0.50
    strip_from, strip_height = 0.07, 0.08

    def __init__(self, *, rows: int, columns: int) -> None:
        self.width = self.gap + (PANEL_IN + self.gap) * columns
        self.height = (self.above + PANEL_IN + self.below) * rows
        self.figure = Figure(figsize=(self.width, self.height))
        FigureCanvasAgg(self.figure)
        self.panels: dict[tuple[int, int], Axes] = {}

    def panel(self, row: int, column: int) -> Axes:
        """The panel at this place, made when it is first asked for."""
        if (row, column) not in self.panels:
            self.panels[row, column] = self._axes(self._left(column), self._floor(row), PANEL_IN, PANEL_IN)
        return self.panels[row, column]

    def bar(
        self,
        image: AxesImage,
        row: int,
        first: int,
        label: str,
        *,
        last: int | None = None,
        ticks: dict[float, str] | None = None,
    ) -> None:
        """A bar of colour below one panel, or below several."""
        inset = 0.06 * PANEL_IN  # room for the numbers at its ends
        width = self._left(first if last is None else last) + PANEL_IN - self._left(first) - 2 * inset
        bottom = self._floor(row) - self.strip_from - self.strip_height
        strip = self._axes(self._left(first) + inset, bottom, width, self.strip_height)
        bar = self.figure.colorbar(image, cax=strip, orientation="horizontal")
        bar.set_label(label, fontsize=8)
        bar.ax.xaxis.set_label_coords(0.5, -0.17 / self.strip_height)
        bar.ax.tick_params(labelsize=7.5, length=2, pad=1.5)
        bar.ax.minorticks_off()
        if ticks:
            bar.set_ticks(list(ticks), labels=list(ticks.values()))
        elif not isinstance(image.norm, LogNorm):
            bar.locator = MaxNLocator(5 if last is None else 8)
            bar.update_ticks()

    def _left(self, column: int) -> float:
        return self.gap + (PANEL_IN + self.gap) * column

    def _floor(self, row: int) -> float:
        return self.height - (self.above + PANEL_IN) * (row + 1) - self.below * row

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        place = (left / self.width, bottom / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(place)
