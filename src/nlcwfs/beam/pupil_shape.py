"""A telescope's pupil apart from any grid: drawn on the fine grid of the light and the coarse one of a model alike."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders, circular_pupil, pupil_from_map
from nlcwfs.beam.segments import Segments

SUBPIXELS = 4
"""A pixel of another size than the map's takes the mean of 4 x 4 points of it."""


@dataclass(frozen=True)
class PupilShape:
    """A round telescope, one made of segments, or a map of any pupil.

    Attributes:
        diameter_m: Diameter of the telescope.
        obstruction_ratio: Diameter of the central obstruction over that of the telescope.
        spiders: Vanes that hold the secondary mirror.
        amplitude_map: Amplitude 0 to 1 of a measured pupil; it rules instead of the circle.
        map_pixel_m: Width of a pixel of the map.
        segments: What it is made of; they rule instead of the circle, its obstruction and vanes.
        label_map: Segment of each pixel of the map, from 0.

    Examples:
        >>> shape = PupilShape(diameter_m=8.0)
        >>> shape.on(Grid((10, 10), 1.0)).shape, shape.on(Grid((40, 40), 0.25)).shape
        ((10, 10), (40, 40))
    """

    diameter_m: float
    obstruction_ratio: float = 0.0
    spiders: Spiders | None = None
    amplitude_map: Float[np.ndarray, "y x"] | None = field(default=None, compare=False)
    map_pixel_m: float = 1.0
    segments: Segments | None = None
    label_map: Int[np.ndarray, "y x"] | None = field(default=None, compare=False)

    def on(self, grid: Grid) -> Float[np.ndarray, "y x"]:
        """The amplitude on the pixels of a grid whose centre is the centre of the pupil.

        Raises:
            SettingsError: If the obstruction or the map is impossible.
            SamplingError: If the pupil does not fit on the grid.
        """
        if self.segments is not None:
            return self.segments.amplitude(grid)
        if self.amplitude_map is None:
            return circular_pupil(
                grid,
                diameter_m=self.diameter_m,
                obstruction_ratio=self.obstruction_ratio,
                spiders=self.spiders,
            )
        measured = pupil_from_map(self.amplitude_map, Grid(self.amplitude_map.shape, self.map_pixel_m))
        rows = self._indices(grid.y_m.ravel(), grid.pixel_m, measured.shape[0])
        columns = self._indices(grid.x_m.ravel(), grid.pixel_m, measured.shape[1])
        framed = np.pad(measured, 1)
        points = framed[rows[:, None], columns[None, :]]
        cells = points.reshape(grid.shape[0], SUBPIXELS, grid.shape[1], SUBPIXELS)
        return pupil_from_map(cells.mean(axis=(1, 3)), grid)

    @property
    def is_segmented(self) -> bool:
        """Whether it has segments, which may have steps between them."""
        return self.segments is not None or self.label_map is not None

    def labels(self, grid: Grid) -> Int[np.ndarray, "y x"] | None:
        """The segment that each pixel belongs to, lit or dark; None for a telescope of one piece.

        Examples:
            >>> PupilShape(8.0).labels(Grid((4, 4), 2.0)) is None
            True
        """
        if self.segments is not None:
            return self.segments.labels(grid)
        if self.label_map is None:
            return None
        places = [
            np.clip(np.floor(centres_m.ravel() / self.map_pixel_m + count / 2 + 1e-9).astype(int), 0, count - 1)
            for centres_m, count in zip((grid.y_m, grid.x_m), self.label_map.shape, strict=True)
        ]
        return self.label_map[np.ix_(*places)]

    def _indices(self, centres_m: np.ndarray, pixel_m: float, count: int) -> np.ndarray:
        """Pixels of the framed map under the points of each pixel; 0 and count + 1 are the dark frame."""
        steps_m = ((np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5) * pixel_m
        points_m = (centres_m[:, None] + steps_m[None, :]).ravel()
        index = np.floor(points_m / self.map_pixel_m + count / 2 + 1e-9).astype(int)
        return np.clip(index, -1, count) + 1
