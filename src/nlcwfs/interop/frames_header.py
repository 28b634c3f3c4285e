"""What the header of a frames file says about optics and detector, and the rules it must keep."""

from typing import Any

import numpy as np

from nlcwfs.interop.fits_keywords import Keywords

UNITS = {"electron": "electron", "electrons": "electron", "e-": "electron", "e": "electron", "adu": "adu"}
"""What BUNIT may say, in small letters, and what it means."""

FLUX_TOLERANCE = 0.01
"""Shares written by hand with two digits (0.33, 0.33, 0.33) are taken; they are scaled to sum 1."""


def unit_and_gain(keywords: Keywords) -> tuple[str, float | None]:
    """The unit of the pixels, 'electron' or 'adu', and the electrons per adu.

    Raises:
        FileFormatError: If BUNIT is missing or unknown, or if adu come without GAIN.
    """
    rule = "must be 'electron' or 'adu'"
    written = keywords.text("BUNIT", rule)
    unit = UNITS.get(written.lower())
    if unit is None:
        raise keywords.error("BUNIT", rule, repr(written))
    rule = "must be positive, in electrons per adu"
    if unit == "adu":
        return unit, keywords.number("GAIN", rule, _positive)
    return unit, keywords.optional_number("GAIN", rule, _positive)


def optics_fields(keywords: Keywords, plane_count: int) -> dict[str, Any]:
    """Fields of a `FramesFile` about the telescope and the sensor, by name.

    Raises:
        FileFormatError: If a keyword is missing or breaks its rule, or if header and image disagree.
    """
    wavelength_m = keywords.number(
        "WAVELEN", "must be in metres between 1e-7 and 3e-5", lambda value: 1e-7 <= value <= 3e-5
    )
    diameter_m = keywords.number("TELDIAM", "must be a positive number of metres", _positive)
    pixel_m = keywords.number("PIXSCALE", "must be a positive number of metres per pixel", _positive)
    obstruction = keywords.optional_number("CENOBS", "must be a ratio of at least 0 and below 1", _is_ratio)
    bandwidth_m = keywords.optional_number(
        "BANDWID", "must be in metres, at least 0 and below WAVELEN", lambda value: 0 <= value < wavelength_m
    )
    distances_m = _distances_m(keywords, plane_count)
    return {
        "wavelength_m": wavelength_m,
        "diameter_m": diameter_m,
        "pixel_m": pixel_m,
        "distances_m": distances_m,
        "flux_fractions": _flux_fractions(keywords, plane_count),
        "obstruction_ratio": obstruction or 0.0,
        "bandwidth_m": bandwidth_m or 0.0,
        "chromatic_lenses": keywords.flag("CHROMLEN"),
        **_membrane(keywords, distances_m),
        "seeing_arcsec": keywords.optional_number("SEEING", "must be a positive number of arcsec", _positive),
    }


def detector_fields(keywords: Keywords) -> dict[str, Any]:
    """Fields of a `FramesFile` about the detector, by name; `saturation_electrons` in electrons.

    Raises:
        FileFormatError: If a keyword breaks its rule, or if adu come without GAIN or RDNOISE.
    """
    unit, gain = unit_and_gain(keywords)
    rule = "must be at least 0, in electrons"
    if unit == "adu":
        read_noise = keywords.number("RDNOISE", rule, _not_negative)
    else:
        read_noise = keywords.optional_number("RDNOISE", rule, _not_negative)
    saturation = keywords.optional_number("SATURATE", "must be positive, in the unit of BUNIT", _positive)
    if saturation is not None and unit == "adu" and gain is not None:
        saturation = saturation * gain
    return {
        "gain_electrons_per_adu": gain,
        "read_noise_electrons": read_noise or 0.0,
        "dark_electrons": keywords.optional_number("DARK", rule, _not_negative) or 0.0,
        "saturation_electrons": saturation,
        "exposure_s": keywords.optional_number("EXPTIME", "must be a positive number of seconds", _positive),
        "photons": keywords.optional_number("PHOTONS", "must be a positive number of photo-electrons", _positive),
        "rate_hz": keywords.optional_number("RATE", "must be a positive number of hertz", _positive),
    }


def check_window(keywords: Keywords, shape: tuple[int, int], fields: dict[str, Any]) -> list[str]:
    """Refuse a pixel scale that is impossible for the telescope; warn about one that is only doubtful.

    Returns:
        Warnings, each a sentence.

    Raises:
        FileFormatError: If there are fewer than 4 pixels across the telescope, or a window below half of it.
    """
    diameter_m, pixel_m = fields["diameter_m"], fields["pixel_m"]
    if diameter_m / pixel_m < 4:
        raise keywords.error(
            "PIXSCALE",
            f"must give at least 4 pixels across TELDIAM = {diameter_m:g} m",
            f"{pixel_m:g} m per pixel, {diameter_m / pixel_m:.2g} pixels",
        )
    window_m = min(shape) * pixel_m
    if window_m < 0.5 * diameter_m:
        raise keywords.error(
            "PIXSCALE",
            f"must give a window of at least half of TELDIAM = {diameter_m:g} m",
            f"{pixel_m:g} m per pixel, {window_m:.3g} m across {min(shape)} pixels",
        )
    found = []
    # A pixel in PIXSCALE = TELDIAM / pixels is rounded: only a whole pixel less is narrower.
    if window_m < diameter_m - pixel_m / 2:
        found.append(f"PIXSCALE: the window of {window_m:.3g} m is narrower than TELDIAM = {diameter_m:g} m")
    reach_m = np.sqrt(fields["wavelength_m"] * np.max(np.abs(fields["distances_m"])))
    if reach_m < 0.5 * pixel_m:
        found.append(
            f"ZPLANE: light hardly changes on the way, sqrt(WAVELEN ZPLANE) = {reach_m:.2g} m is below half "
            "a pixel; are the distances in metres, at the scale of the telescope?"
        )
    return found


def _distances_m(keywords: Keywords, plane_count: int) -> tuple[float, ...]:
    wanted = range(1, plane_count + 1)
    present = keywords.numbered("ZPLANE")
    if not present:
        raise keywords.error("ZPLANE1", "is required, a signed distance in metres", "no such keyword")
    if set(present) != set(wanted):
        rule = f"must be one per plane of the image, {plane_count}"
        listed = ", ".join(present[number] for number in sorted(present))
        raise keywords.error(f"ZPLANE1..{plane_count}", rule, f"{len(present)} ({listed})")
    distances_m = tuple(keywords.number(present[i], "must be a number of metres", _any) for i in wanted)
    if not any(distances_m):
        raise keywords.error(f"ZPLANE1..{plane_count}", "must hold a plane out of the pupil", "0 for every plane")
    for later, distance_m in enumerate(distances_m):
        first = distances_m.index(distance_m)
        if first < later:
            raise keywords.error(f"ZPLANE{later + 1}", f"must differ from ZPLANE{first + 1}", f"{distance_m:g} in both")
    return distances_m


def _membrane(keywords: Keywords, distances_m: tuple[float, ...]) -> dict[str, Any]:
    """How a membrane moves the planes; nothing where there is none."""
    dead_share = keywords.optional_number("MEMBDEAD", "must be a share of at least 0 and below 1", _is_ratio)
    if keywords.value("MEMBRANE") is None:
        if dead_share:
            raise keywords.error("MEMBDEAD", "must be left out without MEMBRANE", f"{dead_share:g}")
        return {}
    rule = "must be 'sine' or 'square'"
    motion = keywords.text("MEMBRANE", rule).lower()
    if motion not in ("sine", "square"):
        raise keywords.error("MEMBRANE", rule, repr(motion))
    if sorted(distances_m) != sorted(-one for one in distances_m):
        listed = ", ".join(f"{distance_m:g}" for distance_m in distances_m)
        rule = "must be pairs with MEMBRANE, one plane at +z for each at -z"
        raise keywords.error(f"ZPLANE1..{len(distances_m)}", rule, listed)
    return {"membrane": motion, "membrane_dead_share": dead_share or 0.0}


def _flux_fractions(keywords: Keywords, plane_count: int) -> tuple[float, ...] | None:
    wanted = range(1, plane_count + 1)
    present = keywords.numbered("FLUXFR")
    if not present:
        return None
    name = f"FLUXFR1..{plane_count}"
    if set(present) != set(wanted):
        listed = ", ".join(present[number] for number in sorted(present))
        raise keywords.error(name, f"must be one per plane of the image, {plane_count}, or none", listed)
    shares = np.array([keywords.number(present[i], "must be a positive share", _positive) for i in wanted])
    if abs(shares.sum() - 1) > FLUX_TOLERANCE + 1e-9:
        raise keywords.error(name, "must sum to 1", f"{shares.sum():g}")
    return tuple(float(share) for share in shares / shares.sum())


def _positive(value: float) -> bool:
    return value > 0


def _not_negative(value: float) -> bool:
    return value >= 0


def _is_ratio(value: float) -> bool:
    return 0 <= value < 1


def _any(value: float) -> bool:
    return True
