"""How far an estimate is from the truth: unwrapped, on the fine grid of the light."""

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from nlcwfs.beam.grid import Grid


def wavefront_error_m(
    estimate_m: Float[np.ndarray, "y x"],
    frame: Grid,
    truth_m: Float[np.ndarray, "Y X"],
    weights: Float[np.ndarray, "Y X"],
    light: Grid,
) -> float:
    """Rms over the light of the pupil of estimate minus truth; piston removed, nothing wrapped, tilt included.

    The estimate is carried to the grid of the light by cubic splines, so what lies between its pixels counts
    as error too.

    Args:
        estimate_m: Wavefront on the frames' pixels; beyond the pupil it should go on smoothly.
        frame: Those pixels.
        truth_m: Wavefront on the grid of the light.
        weights: Share of the light in every cell; zero outside the pupil.
        light: Grid of the light, with the same centre.

    Examples:
        >>> frame, light = Grid((24, 24), 1.0), Grid((48, 48), 0.5)
        >>> coarse = np.broadcast_to(frame.x_m, (24, 24)) * 1e-7 + 5e-6
        >>> fine = np.broadcast_to(light.x_m, (48, 48)) * 1e-7
        >>> middle = np.pad(np.full((8, 8), 1 / 64), 20)
        >>> wavefront_error_m(coarse, frame, fine, middle, light) < 1e-12
        True
    """
    rows = light.y_m.ravel() / frame.pixel_m + (frame.shape[0] - 1) / 2
    columns = light.x_m.ravel() / frame.pixel_m + (frame.shape[1] - 1) / 2
    points = np.meshgrid(rows, columns, indexing="ij")
    fine = scipy.ndimage.map_coordinates(np.asarray(estimate_m, float), points, order=3, mode="nearest")
    share = weights / weights.sum()
    difference = fine - truth_m
    return float(np.sqrt(np.sum(share * (difference - np.sum(share * difference)) ** 2)))
