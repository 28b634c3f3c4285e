"""Make measured.fits, the pupil of study 15's cases `map`: uneven vanes, and mirrors that do not reflect evenly.

Amplitude from 0 to 1 on 272 x 272 pixels of 30 mm: a telescope of 8 m with a shadow of 2.2 m and three vanes of
20 cm at uneven angles. A third of it has lost a fifth of its light, as segments do that were not washed, and smooth
ripples of 10 % rms in amplitude lie over all.
"""

from pathlib import Path

import numpy as np
import scipy.ndimage
from astropy.io import fits

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import Spiders, circular_pupil
from nlcwfs.interop.atomic_write import atomic_write

GRID = Grid((272, 272), 0.03)
VANES = Spiders((90.0, 200.0, 320.0), 0.2)


def measured_pupil() -> np.ndarray:
    """The amplitude, as `(y, x)`."""
    shape = circular_pupil(GRID, diameter_m=8.0, obstruction_ratio=0.275, spiders=VANES)
    ripples = scipy.ndimage.gaussian_filter(np.random.default_rng(2010).normal(size=GRID.shape), 0.4 / GRID.pixel_m)
    unwashed = np.abs(np.arctan2(GRID.y_m, GRID.x_m) - 2.0) < np.pi / 3
    reflected = np.clip(0.85 + 0.1 * ripples / ripples.std() - 0.09 * unwashed, 0.3, 1.0)
    return (shape * reflected / reflected.max()).astype(np.float32)


if __name__ == "__main__":
    header = fits.Header({"PIXSCALE": GRID.pixel_m, "EXTNAME": "PUPIL"})
    with atomic_write(Path(__file__).with_name("measured.fits")) as path:
        fits.CompImageHDU(measured_pupil(), header, name="PUPIL", quantize_level=64).writeto(path)
