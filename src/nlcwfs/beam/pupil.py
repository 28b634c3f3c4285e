"""The shape of the telescope: what fraction of every pixel receives light."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.errors import SamplingError, SettingsError

SUBPIXELS = 8
"""Edge pixels are cut into 8 x 8; with `covered` inside each, the area of a disc is right to 2e-5."""


@dataclass(frozen=True)
class Spiders:
    """Vanes that run outward from the centre of the pupil.

    Attributes:
        angles_deg: Direction of every vane, from +x towards +y.
        width_m: Width of a vane.

    Raises:
        SettingsError: If the width or an angle is not a usable number.

    Examples:
        >>> Spiders.evenly(4, width_m=0.05, first_angle_deg=45.0).angles_deg
        (45.0, 135.0, 225.0, 315.0)
    """

    angles_deg: tuple[float, ...]
    width_m: float

    def __post_init__(self) -> None:
        if not (self.width_m > 0 and np.isfinite(self.width_m)):
            raise SettingsError("spiders.width_m", "must be a positive length", self.width_m)
        if not np.all(np.isfinite(self.angles_deg)):
            raise SettingsError("spiders.angles_deg", "must be finite angles", self.angles_deg)

    @classmethod
    def evenly(cls, count: int, *, width_m: float, first_angle_deg: float = 0.0) -> "Spiders":
        """Vanes at equal angles."""
        return cls(tuple(first_angle_deg + 360.0 * i / count for i in range(count)), width_m)


def circular_pupil(
    grid: Grid, *, diameter_m: float, obstruction_ratio: float = 0.0, spiders: Spiders | None = None
) -> Float[np.ndarray, "y x"]:
    """A round telescope, with its central obstruction and the vanes that hold the secondary mirror.

    The amplitude of a pixel on an edge is the fraction of its area that is lit: this is the mean of the
    field over the pixel, and keeps the far field right to second order in the pixel.

    Args:
        obstruction_ratio: Diameter of the obstruction over that of the telescope.

    Returns:
        Amplitude from 0 to 1, centred on the grid.

    Raises:
        SettingsError: If the ratio is outside 0 <= ratio < 1.
        SamplingError: If the diameter is not positive or wider than the grid.

    Examples:
        >>> pupil = circular_pupil(Grid((4, 4), pixel_m=1.0), diameter_m=4.0)
        >>> round(float(pupil.sum()), 2), bool(pupil[0, 0] < pupil[0, 1] < pupil[1, 1])
        (12.57, True)
    """
    _check_diameter(diameter_m, grid)
    if not 0 <= obstruction_ratio < 1:
        raise SettingsError("beam.obstruction_ratio", "must be at least 0 and below 1", obstruction_ratio)

    def lit(y_m: np.ndarray, x_m: np.ndarray, width_m: float) -> np.ndarray:
        radius_m = np.hypot(y_m, x_m)
        fraction = covered(radius_m - diameter_m / 2, width_m)
        if obstruction_ratio > 0:
            fraction = fraction * (1 - covered(radius_m - obstruction_ratio * diameter_m / 2, width_m))
        if spiders is not None:
            fraction = fraction * beside_vanes(y_m, x_m, width_m, spiders)
        return fraction

    return pupil_from_map(_on_grid(lit, grid), grid)


def pupil_of_discs(
    grid: Grid, *, centres_m: list[tuple[float, float]], disc_diameter_m: float
) -> Float[np.ndarray, "y x"]:
    """Round segments that do not overlap: a giant segmented telescope, or a sparse one.

    Args:
        centres_m: Position `(y, x)` of every segment.

    Raises:
        SamplingError: If there is no light on the grid, or the diameter is not positive.

    Examples:
        >>> grid = Grid((8, 16), pixel_m=1.0)
        >>> two = pupil_of_discs(grid, centres_m=[(0.0, -4.0), (0.0, 4.0)], disc_diameter_m=4.0)
        >>> round(float(two.sum() / np.pi), 2)
        8.0
    """
    _check_diameter(disc_diameter_m, grid)

    def lit(y_m: np.ndarray, x_m: np.ndarray, width_m: float) -> np.ndarray:
        discs = (np.hypot(y_m - y0, x_m - x0) - disc_diameter_m / 2 for y0, x0 in centres_m)
        return np.clip(sum(covered(outside_m, width_m) for outside_m in discs), 0, 1)

    return pupil_from_map(_on_grid(lit, grid), grid)


def pupil_from_map(amplitude: np.ndarray, grid: Grid) -> Float[np.ndarray, "y x"]:
    """Any pupil, given as its amplitude on the pixels of the grid.

    Args:
        amplitude: 0 (dark) to 1 (clear); the transmitted light is its square.

    Raises:
        SamplingError: If the map has another shape than the grid.
        SettingsError: If it is not finite, leaves 0..1 or holds no light.

    Examples:
        >>> pupil_from_map(np.array([[0, 1, 1]]), Grid((1, 3), pixel_m=1.0))
        array([[0., 1., 1.]])
    """
    pupil = np.array(amplitude, dtype=np.float64)
    if pupil.shape != tuple(grid.shape):
        raise SamplingError("pupil.shape", f"must be that of the grid, {tuple(grid.shape)}", pupil.shape)
    if not np.all(np.isfinite(pupil)):
        bad = int(np.sum(~np.isfinite(pupil)))
        raise SettingsError("pupil", "must be finite everywhere", f"{bad} pixels that are not")
    if pupil.min() < 0 or pupil.max() > 1:
        raise SettingsError("pupil", "must lie between 0 and 1", f"{pupil.min():g} to {pupil.max():g}")
    if not pupil.any():
        raise SettingsError("pupil", "must let some light through", "zero everywhere")
    return pupil


def inside(pupil: Float[np.ndarray, "y x"]) -> Bool[np.ndarray, "y x"]:
    """Which pixels belong to the pupil when it must be all or nothing: at least half amplitude.

    Examples:
        >>> inside(np.array([[0.2, 0.5, 1.0]]))
        array([[False,  True,  True]])
    """
    return np.asarray(pupil) >= 0.5


def light_weights(pupil: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
    """The share of the light in every pixel, sum 1: the weights of every mean over a pupil.

    Examples:
        >>> light_weights(np.array([[0.0, 0.5, 1.0]]))
        array([[0. , 0.2, 0.8]])
    """
    light = np.asarray(pupil, dtype=np.float64) ** 2
    return light / light.sum()


def _check_diameter(diameter_m: float, grid: Grid) -> None:
    # A rounding error in pixel_m = diameter / pixels must not refuse a pupil that just fits.
    if not 0 < diameter_m <= min(grid.width_m) * (1 + 1e-9):
        rule = f"must be positive and fit on the grid of {min(grid.width_m):g} m"
        raise SamplingError("beam.diameter_m", rule, diameter_m)


def covered(outside_m: np.ndarray, width_m: float) -> np.ndarray:
    """Fraction of a pixel covered by a region whose straight edge passes `outside_m` before its centre.

    Examples:
        >>> covered(np.array([-1.0, 0.25, 1.0]), 1.0).tolist()
        [1.0, 0.25, 0.0]
    """
    return np.clip(0.5 - outside_m / width_m, 0, 1)


def beside_vanes(y_m: np.ndarray, x_m: np.ndarray, width_m: float, spiders: Spiders) -> np.ndarray:
    """Fraction of squares of a width that no vane covers, from their centres.

    Examples:
        >>> beside_vanes(np.zeros(2), np.array([2.0, -2.0]), 1.0, Spiders((0.0,), width_m=0.25)).tolist()
        [0.75, 1.0]
    """
    free = np.ones(np.broadcast_shapes(y_m.shape, x_m.shape))
    for angle_rad in np.deg2rad(spiders.angles_deg):
        along_m = x_m * np.cos(angle_rad) + y_m * np.sin(angle_rad)
        across_m = np.abs(y_m * np.cos(angle_rad) - x_m * np.sin(angle_rad))
        seen_m = width_m * (abs(np.cos(angle_rad)) + abs(np.sin(angle_rad)))  # a square, seen along the vane
        right_m = np.minimum(across_m + seen_m / 2, spiders.width_m / 2)
        left_m = np.maximum(across_m - seen_m / 2, -spiders.width_m / 2)
        hidden = np.clip((right_m - left_m) / seen_m, 0, 1)  # overlap of vane and pixel, across the vane
        free = free * (1 - hidden * covered(-along_m, width_m))
    return free


def antialiased(
    lit: Callable[[np.ndarray, np.ndarray, float], np.ndarray], y_m: np.ndarray, x_m: np.ndarray, pixel_m: float
) -> Float[np.ndarray, "y x"]:
    """Share of every pixel that is lit: its centre tells, or its 8 x 8 parts where it is on an edge.

    Args:
        lit: Share of squares of a width that are lit, from their centres.
        y_m: Centres of the pixels.
        x_m: The same along x.
        pixel_m: Their width.

    Examples:
        >>> y_m, x_m = np.zeros((1, 2)), np.array([[0.0, 1.0]])
        >>> antialiased(lambda y, x, width_m: covered(x - 0.25, width_m), y_m, x_m, 1.0).round(3).tolist()
        [[0.75, 0.0]]
    """
    # Over the diagonal of a pixel no edge can hide: what is neither 0 nor 1 there needs a closer look.
    pupil = lit(y_m, x_m, np.sqrt(2) * pixel_m)
    edge = (pupil > 0) & (pupil < 1)
    part_m = pixel_m / SUBPIXELS
    steps_m = (np.arange(SUBPIXELS) - (SUBPIXELS - 1) / 2) * part_m
    y_parts_m = y_m[edge][:, None, None] + steps_m[:, None]
    x_parts_m = x_m[edge][:, None, None] + steps_m[None, :]
    pupil[edge] = lit(y_parts_m, x_parts_m, part_m).mean(axis=(1, 2))
    return pupil


def _on_grid(lit: Callable[[np.ndarray, np.ndarray, float], np.ndarray], grid: Grid) -> np.ndarray:
    y_m, x_m = np.broadcast_arrays(grid.y_m, grid.x_m)
    return antialiased(lit, y_m, x_m, grid.pixel_m)


def nearest_lit(lit: Bool[np.ndarray, "y x"]) -> Int[np.ndarray, "y x"]:
    """For every pixel the number of the lit one that is nearest, counted along the rows.

    Examples:
        >>> nearest_lit(np.array([[True, False, False, True]])).tolist()
        [[0, 0, 1, 1]]
    """
    number = np.cumsum(lit).reshape(lit.shape) - 1
    row, column = np.asarray(scipy.ndimage.distance_transform_edt(~lit, return_distances=False, return_indices=True))
    return number[row, column]
