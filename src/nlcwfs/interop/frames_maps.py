"""The optional HDUs of a frames file: PUPIL, SEGMENTS, BACKGROUND, BADPIX, TRUTH and TIME, and their rules."""

import numpy as np
from jaxtyping import Bool, Float, Int

from nlcwfs.beam.pupil import nearest_lit
from nlcwfs.interop.fits_keywords import Hdu, Keywords

OPD_LIMIT_M = 1e-3
"""A wavefront above a millimetre was written in another unit: the worst turbulence stays below 0.1 mm."""

_Shapes = tuple[tuple[int, ...], ...]


def pupil_map(
    keywords: Keywords, part: Hdu, shape: tuple[int, int], *, diameter_m: float, pixel_m: float
) -> tuple[Float[np.ndarray, "y x"], list[str]]:
    """The amplitude of the pupil, and warnings about its size.

    Raises:
        FileFormatError: If it has another shape than a plane, is not finite, leaves 0..1 or holds no light.
    """
    pupil = _image(keywords, "PUPIL", part, (shape,))
    _check_finite(keywords, "PUPIL", pupil)
    rounding = 1e-6  # a map in float32, or scaled integers
    if pupil.min() < -rounding or pupil.max() > 1 + rounding:
        rule = "must be an amplitude between 0 and 1"
        raise keywords.error("PUPIL", rule, f"{pupil.min():g} to {pupil.max():g}")
    pupil = np.clip(pupil, 0, 1)
    if not np.any(pupil >= 0.5):
        raise keywords.error("PUPIL", "must let light through", f"{pupil.max():g} at most")
    extent_m = max(np.ptp(index) + 1 for index in np.nonzero(pupil >= 0.5)) * pixel_m
    if abs(extent_m - diameter_m) > 0.1 * diameter_m + 2 * pixel_m:
        return pupil, [f"PUPIL: is {extent_m:.3g} m wide, but TELDIAM is {diameter_m:g} m; is PIXSCALE right?"]
    return pupil, []


def segment_map(
    keywords: Keywords, part: Hdu, shape: tuple[int, int], pupil: Float[np.ndarray, "y x"] | None
) -> Int[np.ndarray, "y x"]:
    """Segment of every pixel, from 0; pixels of none belong to the nearest.

    Raises:
        FileFormatError: If it has another shape than a plane, holds no whole numbers, or a segment has no light.
    """
    written = _image(keywords, "SEGMENTS", part, (shape,))
    _check_finite(keywords, "SEGMENTS", written)
    rule = "must be whole numbers, 0 for no segment"
    if np.any(written != np.round(written)) or written.min() < 0 or not written.any():
        raise keywords.error("SEGMENTS", rule, f"{written.min():g} to {written.max():g}")
    names = np.unique(written[written > 0])
    for name in names:
        if pupil is not None and not np.any(pupil[written == name] >= 0.5):
            raise keywords.error("SEGMENTS", "must have a pixel with PUPIL >= 0.5 in each segment", f"{name:g} without")
    labels = np.searchsorted(names, written)
    return labels[written > 0][nearest_lit(written > 0)]


def bad_pixel_map(keywords: Keywords, part: Hdu, shape: tuple[int, int, int]) -> Bool[np.ndarray, "..."]:
    """Pixels to ignore, one map for all planes or one per plane.

    Raises:
        FileFormatError: If it has another shape than a plane or the planes, or leaves no pixel of a plane.
    """
    written = _image(keywords, "BADPIX", part, (shape[1:], shape))
    bad = ~np.isfinite(written) | (written != 0)
    if bad.reshape(-1, shape[1] * shape[2]).all(axis=1).any():
        raise keywords.error("BADPIX", "must leave pixels in every plane", "all of a plane ignored")
    return bad


def background_map(
    keywords: Keywords,
    part: Hdu,
    shape: tuple[int, int, int],
    *,
    electrons_per_unit: float,
    ignored: Bool[np.ndarray, "plane y x"],
) -> Float[np.ndarray, "..."]:
    """Background in electrons, one map for all planes or one per plane; 0 for NaN in ignored pixels.

    Raises:
        FileFormatError: If it has another shape than a plane or the planes, another BUNIT, or is not finite.
    """
    own, frames = part.header.get("BUNIT"), keywords.value("BUNIT")
    if own is not None and str(own).strip().lower() != str(frames).strip().lower():
        raise keywords.error("BACKGROUND", f"must have the BUNIT of the frames, {frames!r}", repr(own))
    background = _image(keywords, "BACKGROUND", part, (shape[1:], shape))
    unused = ignored if background.ndim == 3 else ignored.all(axis=0)
    background = np.where(unused & ~np.isfinite(background), 0.0, background)
    _check_finite(keywords, "BACKGROUND", background)
    return background * electrons_per_unit


def truth_map(keywords: Keywords, part: Hdu, *, frame_count: int, shape: tuple[int, int]) -> Float[np.ndarray, "..."]:
    """The true wavefront in metres, one for all frames or one per frame; it may be NaN outside the pupil.

    Raises:
        FileFormatError: If it has another shape, holds no number, or is not in metres.
    """
    unit = part.header.get("BUNIT", "m")
    if str(unit).strip() != "m":
        raise keywords.error("TRUTH", "must have BUNIT 'm'", repr(unit))
    truth_m = _image(keywords, "TRUTH", part, (shape, (frame_count, *shape)))
    finite = np.isfinite(truth_m)
    if not finite.reshape(-1, shape[0] * shape[1]).any(axis=1).all():
        raise keywords.error("TRUTH", "must be finite in the pupil", "no finite pixel")
    largest_m = np.max(np.abs(truth_m[finite]))
    if largest_m > OPD_LIMIT_M:
        raise keywords.error("TRUTH", f"must be in metres, within {OPD_LIMIT_M:g}", f"{largest_m:g}")
    return truth_m


def frame_clock(keywords: Keywords, part: Hdu, *, frame_count: int) -> Float[np.ndarray, " frame"]:
    """When each frame was taken, in seconds.

    Raises:
        FileFormatError: If it is not one number per frame, not in seconds, not finite, or not ascending.
    """
    unit = part.header.get("BUNIT", "s")
    if str(unit).strip() != "s":
        raise keywords.error("TIME", "must have BUNIT 's'", repr(unit))
    rule = f"must hold the seconds of every frame, {frame_count}"
    if not isinstance(part.data, np.ndarray) or part.data.dtype.names is not None:
        raise keywords.error("TIME", rule, "no array of numbers")
    if part.data.shape != (frame_count,):
        raise keywords.error("TIME", rule, _by(part.data.shape))
    times_s = np.array(part.data, dtype=np.float64)
    if not np.all(np.isfinite(times_s)):
        number = int(np.argmin(np.isfinite(times_s)))
        raise keywords.error("TIME", "must be finite", f"{times_s[number]} for frame {number}")
    early = np.flatnonzero(np.diff(times_s) <= 0)
    if early.size:
        later, before = times_s[early[0] + 1], times_s[early[0]]
        raise keywords.error("TIME", "must ascend", f"{later:.10g} s for frame {early[0] + 1} after {before:.10g} s")
    return times_s


def _image(keywords: Keywords, name: str, part: Hdu, shapes: _Shapes) -> Float[np.ndarray, "..."]:
    rule = "must be an image of " + " or ".join(_by(shape) for shape in shapes) + " pixels, as the frames"
    if not isinstance(part.data, np.ndarray) or part.data.dtype.names is not None:
        raise keywords.error(name, rule, "no image")
    if part.data.shape not in shapes:
        raise keywords.error(name, rule, _by(part.data.shape))
    return np.array(part.data, dtype=np.float64)


def _check_finite(keywords: Keywords, name: str, image: np.ndarray) -> None:
    if not np.all(np.isfinite(image)):
        count = int(np.sum(~np.isfinite(image)))
        raise keywords.error(name, "must be finite", f"{count} NaN or infinite pixels")


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape)
