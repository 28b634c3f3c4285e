"""The frames of a sensor in FITS, as benches write them and as `simulate` does."""

import hashlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.io import fits
from jaxtyping import Float

from nlcwfs.errors import SettingsError
from nlcwfs.interop.fits_keywords import (
    Card,
    Hdu,
    Keywords,
    compact,
    header_of,
    load_hdus,
    position_cards,
    write_hdus,
)
from nlcwfs.interop.frames_checks import PixelRules, examine_frame, frame_warnings
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_header import check_window, detector_fields, optics_fields, unit_and_gain
from nlcwfs.interop.frames_maps import background_map, bad_pixel_map, frame_clock, pupil_map, segment_map, truth_map
from nlcwfs.interop.provenance import Provenance

MAPS = ("PUPIL", "SEGMENTS", "BACKGROUND", "BADPIX", "TRUTH", "TIME")


def read_frames(path: str | Path) -> FramesFile:
    """Read frames, `(plane, y, x)` or `(frame, plane, y, x)`, and judge whether they can be used.

    A frame that cannot be used is listed in `frame_problems`; the file is refused when no frame is left.

    Args:
        path: A FITS file with the image in its primary HDU and the keywords of `docs`.

    Raises:
        FileFormatError: If the file, its header, an image in it or all its frames break a rule.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "frames.fits"
        >>> optics = {"WAVELEN": 0.65e-6, "PIXSCALE": 1.0, "TELDIAM": 8.0, "ZPLANE1": -2e6, "ZPLANE2": 2e6}
        >>> header = fits.Header({"BUNIT": "adu", "GAIN": 2.0, "RDNOISE": 1.5, **optics})
        >>> fits.writeto(path, np.ones((2, 8, 8)), header)
        >>> frames = read_frames(path)
        >>> frames.electrons.shape, float(frames.electrons.max())
        ((1, 2, 8, 8), 2.0)
    """
    path = Path(path)
    parts = load_hdus(path)
    keywords = Keywords(path, parts["PRIMARY"].header)
    raw = _primary_image(keywords, parts["PRIMARY"])
    fields = {**detector_fields(keywords), **optics_fields(keywords, raw.shape[-3])}
    shape = (raw.shape[-3], raw.shape[-2], raw.shape[-1])
    notes = check_window(keywords, shape[1:], fields)
    unit, gain = unit_and_gain(keywords)
    electrons_per_unit = gain if unit == "adu" and gain is not None else 1.0
    electrons = raw.reshape(-1, *shape) * electrons_per_unit
    maps, map_notes = _read_maps(keywords, parts, electrons.shape, fields, electrons_per_unit)
    rules = _pixel_rules(shape, fields, maps)
    reports = [examine_frame(frame, rules) for frame in electrons]
    problems = {number: report.problem for number, report in enumerate(reports) if report.problem is not None}
    if len(problems) == len(reports):
        raise _no_frame_left(keywords, problems)
    return FramesFile(
        electrons=np.where(np.isfinite(electrons), electrons, 0.0),
        masked=np.array([report.masked for report in reports]),
        has_frame_axis=raw.ndim == 4,
        frame_problems=problems,
        warnings=tuple(notes + map_notes + frame_warnings(reports, rules.flux_fractions)),
        source=path.name,
        source_digest=hashlib.sha256(path.read_bytes()).hexdigest()[:16],
        **fields,
        **maps,
    )


def write_frames(
    path: str | Path,
    frames: FramesFile,
    provenance: Provenance,
    *,
    unit: Literal["electron", "adu"] = "electron",
) -> None:
    """Write frames, whole or not at all; `read_frames` gives them back.

    Masked pixels that are neither in `bad_pixels` nor saturated are written as NaN.

    Args:
        unit: Unit of the pixels and of the background in the file.

    Raises:
        FileFormatError: If the file cannot be written.
        SettingsError: If adu are asked for and the gain is unknown.
    """
    if unit == "adu" and frames.gain_electrons_per_adu is None:
        raise SettingsError("frames.gain_electrons_per_adu", "must be known to write adu", None)
    electrons_per_unit = (frames.gain_electrons_per_adu or 1.0) if unit == "adu" else 1.0
    values = _with_gaps(frames) / electrons_per_unit
    image = compact(values if frames.has_frame_axis else values[0])
    cards = [
        ("BUNIT", unit, "unit of the pixels"),
        *_optics_cards(frames),
        *_detector_cards(frames, electrons_per_unit),
        *position_cards(image.shape, frames.pixel_m),
        *provenance.cards(),
    ]
    hdus: list[Any] = [fits.PrimaryHDU(image, header_of(cards))]
    background = None if frames.background is None else frames.background / electrons_per_unit
    bad = None if frames.bad_pixels is None else frames.bad_pixels.astype(np.uint8)
    segments = None if frames.segments is None else (frames.segments + 1).astype(np.int16)
    maps = {
        "PUPIL": frames.pupil,
        "SEGMENTS": segments,
        "BACKGROUND": background,
        "BADPIX": bad,
        "TRUTH": frames.truth_m,
    }
    units = {"BACKGROUND": unit, "TRUTH": "m"}
    for name, data in maps.items():
        if data is not None:
            about = [("BUNIT", units[name], "")] if name in units else []
            header = header_of([*about, *position_cards(data.shape, frames.pixel_m)])
            hdus.append(fits.ImageHDU(data, header, name=name))
    if frames.times_s is not None:
        hdus.append(fits.ImageHDU(frames.times_s, header_of([("BUNIT", "s", "")]), name="TIME"))
    write_hdus(path, hdus)


def _primary_image(keywords: Keywords, part: Hdu) -> Float[np.ndarray, "..."]:
    rule = "must hold an image (plane, y, x) or (frame, plane, y, x)"
    if part.data is None or part.data.dtype.names is not None:
        raise keywords.error("PRIMARY", rule, "no image")
    if part.data.ndim not in (3, 4):
        raise keywords.error("PRIMARY", rule, f"{part.data.ndim} axes {part.data.shape}")
    return np.asarray(part.data, dtype=np.float64)


def _read_maps(
    keywords: Keywords,
    parts: dict[str, Hdu],
    shape: tuple[int, ...],
    fields: dict[str, Any],
    electrons_per_unit: float,
) -> tuple[dict[str, Any], list[str]]:
    """The optional images by the name of their field, and warnings."""
    frame_count, *rest = shape
    planes = (rest[0], rest[1], rest[2])
    maps: dict[str, Any] = {}
    notes: list[str] = []
    if "PUPIL" in parts:
        scale = {name: fields[name] for name in ("diameter_m", "pixel_m")}
        maps["pupil"], notes = pupil_map(keywords, parts["PUPIL"], planes[1:], **scale)
    if "SEGMENTS" in parts:
        maps["segments"] = segment_map(keywords, parts["SEGMENTS"], planes[1:], maps.get("pupil"))
    if "BADPIX" in parts:
        maps["bad_pixels"] = bad_pixel_map(keywords, parts["BADPIX"], planes)
    if "BACKGROUND" in parts:
        maps["background"] = background_map(
            keywords,
            parts["BACKGROUND"],
            planes,
            electrons_per_unit=electrons_per_unit,
            ignored=np.broadcast_to(maps.get("bad_pixels", False), planes),
        )
    if "TRUTH" in parts:
        maps["truth_m"] = truth_map(keywords, parts["TRUTH"], frame_count=frame_count, shape=planes[1:])
    if "TIME" in parts:
        maps["times_s"] = frame_clock(keywords, parts["TIME"], frame_count=frame_count)
    unknown = [name for name in parts if name not in ("PRIMARY", *MAPS)]
    return maps, notes + [f"{name}: is not one of {', '.join(MAPS)}, ignored" for name in unknown]


def _pixel_rules(shape: tuple[int, int, int], fields: dict[str, Any], maps: dict[str, Any]) -> PixelRules:
    level = np.broadcast_to(fields["dark_electrons"] + maps.get("background", 0.0), shape)
    saturation, shares = fields["saturation_electrons"], fields["flux_fractions"]
    return PixelRules(
        level_electrons=level,
        variance_electrons2=fields["read_noise_electrons"] ** 2 + np.maximum(level, 0),
        ignored=np.broadcast_to(maps.get("bad_pixels", False), shape),
        saturation_electrons=np.inf if saturation is None else saturation,
        flux_fractions=np.full(shape[0], 1 / shape[0]) if shares is None else np.array(shares),
        distances_m=fields["distances_m"],
        photons=fields["photons"],
    )


def _no_frame_left(keywords: Keywords, problems: dict[int, str]) -> Exception:
    rule, _, value = problems[0].partition(", got ")
    if len(problems) > 1:
        rule = f"none of {len(problems)} frames can be used; frame 0 {rule}"
    return keywords.error("PRIMARY", rule, value)


def _with_gaps(frames: FramesFile) -> Float[np.ndarray, "frame plane y x"]:
    """The electrons, NaN where a reader could not know that the pixel is masked."""
    full = np.inf if frames.saturation_electrons is None else frames.saturation_electrons
    ignored = False if frames.bad_pixels is None else frames.bad_pixels
    return np.where(frames.masked & ~(ignored | (frames.electrons >= full)), np.nan, frames.electrons)


def _optics_cards(frames: FramesFile) -> list[Card]:
    cards: list[Card] = [
        ("WAVELEN", frames.wavelength_m, "[m] wavelength"),
        ("PIXSCALE", frames.pixel_m, "[m] width of a pixel, telescope scale"),
        ("TELDIAM", frames.diameter_m, "[m] diameter of the telescope"),
        ("CENOBS", frames.obstruction_ratio, "central obstruction over diameter"),
        ("BANDWID", frames.bandwidth_m, "[m] width of the band"),
        ("CHROMLEN", frames.chromatic_lenses, "T: ZPLANE is proportional to 1/wavelength"),
    ]
    if frames.membrane != "none":
        cards.append(("MEMBRANE", frames.membrane, "it moves the planes, ZPLANE is the mean"))
        cards.append(("MEMBDEAD", frames.membrane_dead_share, "share of the time without light"))
    for plane, distance_m in enumerate(frames.distances_m, start=1):
        cards.append((f"ZPLANE{plane}", distance_m, "[m] from the pupil, positive downstream"))
    for plane, share in enumerate(frames.flux_fractions or (), start=1):
        cards.append((f"FLUXFR{plane}", share, "share of the light"))
    return cards


def _detector_cards(frames: FramesFile, electrons_per_unit: float) -> list[Card]:
    saturation = frames.saturation_electrons
    optional: list[Card] = [
        ("GAIN", frames.gain_electrons_per_adu, "[electron/adu]"),
        (
            "SATURATE",
            None if saturation is None else saturation / electrons_per_unit,
            "a pixel is full, in BUNIT",
        ),
        ("EXPTIME", frames.exposure_s, "[s] exposure of a frame"),
        ("SEEING", frames.seeing_arcsec, "[arcsec] at 500 nm"),
        ("RATE", frames.rate_hz, "[Hz] frames per second"),
        ("PHOTONS", frames.photons, "[electron] expected in an exposure"),
    ]
    return [
        ("RDNOISE", frames.read_noise_electrons, "[electron] rms read noise"),
        ("DARK", frames.dark_electrons, "[electron] dark electrons in a pixel"),
        *[card for card in optional if card[1] is not None],
    ]
