"""The sampling of a plane: how many pixels, how large, and where their centres lie."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nlcwfs.errors import SamplingError


@dataclass(frozen=True)
class Grid:
    """Square pixels that sample a plane at the scale of the telescope.

    Arrays on a grid are `(y, x)`; row 0 is at the smallest y and pixel i has its centre at
    `(i - (n - 1) / 2) * pixel_m`, for odd and even n alike (see `docs/decisions`).

    Attributes:
        shape: Number of pixels along y and along x.
        pixel_m: Width of a pixel.

    Raises:
        SamplingError: If a length or a number of pixels is not positive.

    Examples:
        >>> Grid((2, 3), pixel_m=0.5).x_m
        array([[-0.5,  0. ,  0.5]])
    """

    shape: tuple[int, int]
    pixel_m: float

    def __post_init__(self) -> None:
        if min(self.shape) < 1:
            raise SamplingError("grid.shape", "must be at least one pixel along each axis", self.shape)
        if not self.pixel_m > 0 or not np.isfinite(self.pixel_m):
            raise SamplingError("grid.pixel_m", "must be a positive length", self.pixel_m)

    @property
    def y_m(self) -> Float[np.ndarray, "y 1"]:
        """Position of every row."""
        return _centres(self.shape[0], self.pixel_m)[:, None]

    @property
    def x_m(self) -> Float[np.ndarray, "1 x"]:
        """Position of every column."""
        return _centres(self.shape[1], self.pixel_m)[None, :]

    @property
    def fy_per_m(self) -> Float[np.ndarray, "y 1"]:
        """Spatial frequency of every row of a Fourier transform, in the order of `numpy.fft`."""
        return np.fft.fftfreq(self.shape[0], self.pixel_m)[:, None]

    @property
    def fx_per_m(self) -> Float[np.ndarray, "1 x"]:
        """Spatial frequency of every column of a Fourier transform, in the order of `numpy.fft`."""
        return np.fft.fftfreq(self.shape[1], self.pixel_m)[None, :]

    @property
    def width_m(self) -> tuple[float, float]:
        """Width of the whole grid along y and x."""
        return self.shape[0] * self.pixel_m, self.shape[1] * self.pixel_m

    def finer(self, factor: int) -> "Grid":
        """The same window, cut into `factor` times more pixels along each axis."""
        return Grid((self.shape[0] * factor, self.shape[1] * factor), self.pixel_m / factor)

    def padded(self, shape: tuple[int, int]) -> "Grid":
        """The same pixels in a window of another size."""
        return Grid(shape, self.pixel_m)


def _centres(count: int, pixel_m: float) -> Float[np.ndarray, " n"]:
    return (np.arange(count) - (count - 1) / 2) * pixel_m
