"""The map of a telescope's pupil, read from FITS."""

from pathlib import Path

import numpy as np

from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.interop.fits_keywords import Keywords, load_hdus


def read_pupil_shape(path: str | Path, *, diameter_m: float) -> PupilShape:
    """Read a pupil of any shape: the image of the HDU `PUPIL`, or of the first HDU that holds one.

    Its pixels are `PIXSCALE` metres wide; without that keyword the image spans the diameter of the telescope. Its
    centre is the centre of the pupil.

    Args:
        path: FITS file with the amplitude, 0 (dark) to 1 (clear), as `(y, x)`.
        diameter_m: Diameter of the telescope.

    Raises:
        FileFormatError: If there is no such file, no such image, or no amplitude in it.

    Examples:
        >>> import tempfile
        >>> from astropy.io import fits
        >>> path = Path(tempfile.mkdtemp()) / "pupil.fits"
        >>> fits.writeto(path, np.ones((20, 20)))
        >>> read_pupil_shape(path, diameter_m=8.0).map_pixel_m
        0.4
    """
    path = Path(path)
    parts = load_hdus(path)
    images = {
        name: part
        for name, part in parts.items()
        if isinstance(part.data, np.ndarray) and part.data.dtype.names is None
    }
    name = "PUPIL" if "PUPIL" in images else next(iter(images), "PRIMARY")
    keywords = Keywords(path, parts[name].header)
    if name not in images:
        raise keywords.error("PRIMARY", "must hold an image (y, x) of the pupil", "no image")
    amplitude = np.asarray(images[name].data, float)
    if amplitude.ndim != 2:
        raise keywords.error(name, "must hold an image (y, x) of the pupil", f"{amplitude.ndim} axes {amplitude.shape}")
    if not np.all(np.isfinite(amplitude)):
        raise keywords.error(name, "must be finite", f"{int(np.sum(~np.isfinite(amplitude)))} NaN or infinite pixels")
    rounding = 1e-6  # a map in float32, or scaled integers
    if amplitude.min() < -rounding or amplitude.max() > 1 + rounding:
        rule = "must be an amplitude between 0 and 1"
        raise keywords.error(name, rule, f"{amplitude.min():g} to {amplitude.max():g}")
    if amplitude.max() < 0.5:
        raise keywords.error(name, "must let light through", f"{amplitude.max():g} at most")
    pixel_m = keywords.optional_number("PIXSCALE", "must be a positive number of metres per pixel", lambda v: v > 0)
    if pixel_m is None:
        pixel_m = diameter_m / max(amplitude.shape)
    lit = np.nonzero(amplitude >= 0.5)
    extent_m = max(float(np.ptp(index) + 1) for index in lit) * pixel_m
    if abs(extent_m - diameter_m) > 0.1 * diameter_m + 2 * pixel_m:
        rule = f"must be as wide as the telescope, {diameter_m:g} m; is PIXSCALE right?"
        raise keywords.error(name, rule, f"{extent_m:.3g} m")
    return PupilShape(diameter_m, amplitude_map=np.clip(amplitude, 0, 1), map_pixel_m=pixel_m)
