"""A pupil made of segments: which light each lets through, and which cells follow it when it moves.

The edge of a segment is antialiased in its amplitude, never in its phase. Every cell belongs to exactly one segment,
its label, and has the whole piston of it: a rim pixel with a fraction of a piston would let a reconstructor tell one
wavelength from two by light that no telescope makes.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy.spatial
from jaxtyping import Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders, antialiased, beside_vanes, covered, pupil_from_map
from nlcwfs.errors import SamplingError, SettingsError

TOUCH = 1e-6
"""Segments may overlap, and leave the pupil, by this part of a width: published sizes are rounded."""

NEAREST = 8
"""The segment whose rim is nearest is among the so many whose centres are."""

ROOM_M = 1e-9
"""Rounding errors of positions."""


@dataclass(frozen=True)
class Segment:
    """One mirror of a segmented telescope, or one telescope of a sparse one.

    Attributes:
        y_m: Centre.
        x_m: Centre.
        width_m: Diameter of a disc; of a hexagon the distance of opposite sides.
        sides: 0 for a disc, 6 for a hexagon.
        angle_deg: Direction of the normal of a side of a hexagon, from +x towards +y.
        squeeze: Width towards the centre of the pupil over that across: below 1 for a mirror that is seen askew.

    Examples:
        >>> Segment(0.0, 3.0, 2.0).outside_m(np.array([0.0]), np.array([4.5])).tolist()
        [0.5]
    """

    y_m: float
    x_m: float
    width_m: float
    sides: int = 0
    angle_deg: float = 0.0
    squeeze: float = 1.0

    @property
    def reach_m(self) -> float:
        """Radius of the circle around it."""
        return self.width_m / 2 if self.sides == 0 else self.width_m / np.sqrt(3)

    def outside_m(self, y_m: Float[np.ndarray, "..."], x_m: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """How far points are beyond the rim; negative inside."""
        y_m, x_m = y_m - self.y_m, x_m - self.x_m
        if self.sides:
            angles_rad = np.deg2rad(self.angle_deg + np.array([0.0, 60.0, 120.0]))
            across = [np.abs(x_m * np.cos(one) + y_m * np.sin(one)) for one in angles_rad]
            return np.maximum(np.maximum(across[0], across[1]), across[2]) - self.width_m / 2
        if self.squeeze == 1:
            return np.hypot(y_m, x_m) - self.width_m / 2
        angle_rad = np.arctan2(self.y_m, self.x_m)
        along_m = (x_m * np.cos(angle_rad) + y_m * np.sin(angle_rad)) / self.squeeze
        return np.hypot(along_m, y_m * np.cos(angle_rad) - x_m * np.sin(angle_rad)) - self.width_m / 2

    def corners_m(self) -> Float[np.ndarray, "corner 2"]:
        """Points `(y, x)` of the rim; nothing of the segment is farther from the centre of the pupil than they are."""
        count = self.sides or 720
        angles_rad = np.deg2rad(self.angle_deg + 30.0) + 2 * np.pi * np.arange(count) / count
        y, x = np.sin(angles_rad) * self.reach_m, np.cos(angles_rad) * self.reach_m
        towards = np.arctan2(self.y_m, self.x_m)
        along = x * np.cos(towards) + y * np.sin(towards)
        shorter = (self.squeeze - 1) * along
        return np.stack([self.y_m + y + shorter * np.sin(towards), self.x_m + x + shorter * np.cos(towards)], axis=1)


@dataclass(frozen=True)
class Segments:
    """All the segments of a pupil, none on another.

    Attributes:
        parts: Their order is that of the labels, from 0.
        obstruction_m: Diameter of a round shadow in the middle of the pupil.
        spiders: Vanes in front of them.

    Raises:
        SettingsError: If there is none, a width is not positive, or two overlap.

    Examples:
        >>> two = Segments((Segment(0.0, -2.0, 3.0), Segment(0.0, 2.0, 3.0)))
        >>> grid = Grid((4, 8), 1.0)
        >>> round(float(two.amplitude(grid).sum() / np.pi), 1)
        4.5
        >>> two.labels(grid)[0].tolist()
        [0, 0, 0, 0, 1, 1, 1, 1]
    """

    parts: tuple[Segment, ...]
    obstruction_m: float = 0.0
    spiders: Spiders | None = None

    def __post_init__(self) -> None:
        if not self.parts:
            raise SettingsError("beam.segments.centres_m", "must be at least one", "none")
        for number, part in enumerate(self.parts):
            if not (part.width_m > 0 and np.isfinite(part.width_m)):
                raise SettingsError("beam.segments.widths_m", "must be positive lengths", part.width_m)
            for other in self._neighbours(number):
                _check_apart(number, part, other, self.parts[other])

    @functools.cached_property
    def centres_m(self) -> Float[np.ndarray, "segment 2"]:
        """Position `(y, x)` of every segment."""
        return np.array([(part.y_m, part.x_m) for part in self.parts])

    def check_inside(self, diameter_m: float) -> None:
        """Refuse segments that leave the telescope.

        Raises:
            SettingsError: If one does; says how wide the telescope would have to be.
        """
        reach_m = [float(np.hypot(*part.corners_m().T).max()) for part in self.parts]
        worst = int(np.argmax(reach_m))
        if 2 * reach_m[worst] > diameter_m * (1 + TOUCH) + ROOM_M:
            where = f"must hold all segments; segment {worst} reaches to {2 * reach_m[worst]:.6g} m"
            raise SettingsError("beam.diameter_m", where, f"{diameter_m:g}")

    def amplitude(self, grid: Grid) -> Float[np.ndarray, "y x"]:
        """The amplitude of every cell: the share of its area that is lit.

        Raises:
            SamplingError: If a segment leaves the grid.
            SettingsError: If no light is left.
        """
        lit = np.zeros(grid.shape)
        for number, part in enumerate(self.parts):
            rows, columns = self._window(number, grid)
            y_m, x_m = np.broadcast_arrays(grid.y_m[rows], grid.x_m[:, columns])
            lit[rows, columns] += antialiased(self._light_of(part), y_m, x_m, grid.pixel_m)
        return pupil_from_map(np.clip(lit, 0, 1), grid)

    def labels(self, grid: Grid) -> Int[np.ndarray, "y x"]:
        """The segment that each cell belongs to, lit or dark: the one whose rim is nearest."""
        y_m, x_m = np.broadcast_arrays(grid.y_m, grid.x_m)
        count = min(NEAREST, len(self.parts))
        points = np.stack([y_m.ravel(), x_m.ravel()], axis=1)
        near = scipy.spatial.cKDTree(self.centres_m).query(points, k=range(1, count + 1))[1]  # pyright: ignore
        outside_m = np.full(near.shape, np.inf)
        for number, part in enumerate(self.parts):
            cell, rank = np.nonzero(near == number)
            outside_m[cell, rank] = part.outside_m(points[cell, 0], points[cell, 1])
        # On a line between two the lower number wins, whatever the order of the centres.
        tied = outside_m <= outside_m.min(axis=1, keepdims=True) + ROOM_M
        return np.where(tied, near, len(self.parts)).min(axis=1).reshape(grid.shape)

    def _light_of(self, part: Segment):
        def lit(y_m: np.ndarray, x_m: np.ndarray, width_m: float) -> np.ndarray:
            fraction = covered(part.outside_m(y_m, x_m), width_m)
            if self.obstruction_m > 0:
                fraction = fraction * (1 - covered(np.hypot(y_m, x_m) - self.obstruction_m / 2, width_m))
            if self.spiders is not None:
                fraction = fraction * beside_vanes(y_m, x_m, width_m, self.spiders)
            return fraction

        return lit

    def _window(self, number: int, grid: Grid) -> tuple[slice, slice]:
        """The rows and columns around a segment."""
        part, slices = self.parts[number], []
        for axis, rim_m in enumerate(part.corners_m().T):
            places = rim_m / grid.pixel_m + (grid.shape[axis] - 1) / 2
            least, most = float(places.min()), float(places.max())
            if least < -0.5 - TOUCH * grid.shape[axis] or most > grid.shape[axis] * (1 + TOUCH) - 0.5:
                rule = f"must fit on the grid of {min(grid.width_m):g} m"
                raise SamplingError("beam.segments", rule, f"segment {number} at {(part.y_m, part.x_m)} m")
            slices.append(slice(max(math.floor(least) - 1, 0), min(math.ceil(most) + 2, grid.shape[axis])))
        return slices[0], slices[1]

    @functools.cached_property
    def _reach_m(self) -> Float[np.ndarray, " segment"]:
        return np.array([part.reach_m for part in self.parts])

    def _neighbours(self, number: int) -> list[int]:
        """Those with a lower number that may touch it."""
        away_m = np.hypot(*(self.centres_m[:number] - self.centres_m[number]).T)
        return np.flatnonzero(away_m < self._reach_m[:number] + self._reach_m[number]).tolist()


def _check_apart(number: int, part: Segment, other_number: int, other: Segment) -> None:
    """Refuse two segments that share light: points of one's rim, or its centre, lie inside the other."""
    deepest_m = 0.0
    for one, two in ((part, other), (other, part)):
        points_m = np.concatenate([one.corners_m(), [[one.y_m, one.x_m]]])
        deepest_m = min(deepest_m, float(two.outside_m(points_m[:, 0], points_m[:, 1]).min()))
    if deepest_m < -TOUCH * min(part.width_m, other.width_m) - ROOM_M:
        got = f"segments {other_number} and {number}, {-deepest_m:.3g} m deep"
        raise SettingsError("beam.segments.centres_m", "must keep segments apart; two overlap", got)
