"""The wavefront that was found, in FITS."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from nlcwfs.interop.fits_keywords import Card, Hdu, Keywords, header_of, load_hdus, position_cards, write_hdus
from nlcwfs.interop.provenance import Provenance
from nlcwfs.interop.wavefront_file import WavefrontFile

_NUMBERS = {
    "RMS_NM": ("rms_nm", "[nm] rms over the pupil"),
    "NITER": ("iterations", "iterations"),
    "NFFT": ("ffts", "fast Fourier transforms"),
    "PREDERR": ("predicted_error_nm", "[nm] predicted 1-sigma error"),
    "RUNTIME": ("runtime_s", "[s] computing time"),
    "ERR_NM": ("error_nm", "[nm] rms of error, no piston"),
    "QLIMIT": ("quantum_limit_nm", "[nm] error at the quantum limit"),
    "PHOTLOSS": ("photon_loss", "photons needed over those at QLIMIT"),
    "WRONGTRN": ("wrong_turn", "probability of a segment whole waves off"),
}
"""Keyword, field of the record and comment; with several frames the field is a column of FRAMES instead."""

_OPTIONAL = ("ERR_NM", "QLIMIT", "PHOTLOSS", "WRONGTRN")
"""Left out where they are not known."""


def write_wavefront(path: str | Path, wavefront: WavefrontFile, provenance: Provenance) -> None:
    """Write a wavefront, whole or not at all.

    With several frames the header carries medians over the frames that ran, and the table FRAMES a row per
    frame. A number that is not known is a keyword without a value, or NaN in a table. Residual and
    amplitude are stored in single precision, far below their noise.

    Raises:
        FileFormatError: If the file cannot be written.

    Examples:
        >>> import tempfile
        >>> from nlcwfs.interop.frames_file import FramesFile
        >>> from nlcwfs.interop.wavefront_file import FrameWavefront
        >>> path = Path(tempfile.mkdtemp()) / "wavefront.fits"
        >>> found = FrameWavefront(
        ...     opd_m=np.eye(4), rms_nm=250.0, outcome="converged", iterations=10, ffts=88,
        ...     predicted_error_nm=30.0, runtime_s=0.1,
        ...     coefficient_m=np.array([1e-7]), sigma_m=np.array([1e-9]),
        ... )
        >>> frames = FramesFile(
        ...     electrons=np.ones((1, 1, 4, 4)), masked=np.zeros((1, 1, 4, 4), bool), has_frame_axis=False,
        ...     pixel_m=2.0, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(2.5e6,),
        ... )
        >>> wavefront = WavefrontFile.from_frames({0: found}, frames, method="gerchberg-saxton", noll=[2])
        >>> write_wavefront(path, wavefront, Provenance.collect({}, seed=None, device="cpu"))
        >>> fits.getval(path, "RMS_NM"), read_wavefront(path).outcomes
        (250.0, ('converged',))
    """
    opd_m = wavefront.opd_m if wavefront.has_frame_axis else wavefront.opd_m[0]
    cards: list[Card] = [
        ("BUNIT", "m", "optical path difference, NaN outside the pupil"),
        *_outcome_cards(wavefront),
        ("WAVELEN", wavefront.wavelength_m, "[m] wavelength"),
        ("PIXSCALE", wavefront.pixel_m, "[m] width of a pixel, telescope scale"),
        ("TELDIAM", wavefront.diameter_m, "[m] diameter of the telescope"),
        *position_cards(opd_m.shape, wavefront.pixel_m),
        *provenance.cards(),
    ]
    if wavefront.source:
        cards.append(("INPUT", wavefront.source, ""))
    if wavefront.source_digest:
        cards.append(("INSHA256", wavefront.source_digest, "first digits, of the input"))
    hdus: list[Any] = [fits.PrimaryHDU(opd_m, header_of(cards))]
    hdus.append(fits.BinTableHDU.from_columns(_mode_columns(wavefront), name="MODES"))
    maps = (("RESIDUAL", wavefront.residual, "electron", "data - model"), ("AMPLITUDE", wavefront.amplitude, "", ""))
    for name, values, unit, meaning in maps:
        if values is not None:
            single = (values if wavefront.has_frame_axis else values[0]).astype(np.float32)
            header = header_of([("BUNIT", unit, meaning), *position_cards(single.shape, wavefront.pixel_m)])
            hdus.append(fits.ImageHDU(single, header, name=name))
    if wavefront.has_frame_axis:
        hdus.append(fits.BinTableHDU.from_columns(_frame_columns(wavefront), name="FRAMES"))
    write_hdus(path, hdus)


def read_wavefront(path: str | Path) -> WavefrontFile:
    """Read what `write_wavefront` wrote.

    Raises:
        FileFormatError: If there is no such file, or if it does not hold a wavefront.
    """
    path = Path(path)
    parts = load_hdus(path)
    keywords = Keywords(path, parts["PRIMARY"].header)
    method = keywords.text("METHOD", "must be the name of a method: is this a wavefront?")
    opd_m = parts["PRIMARY"].data
    if opd_m is None or opd_m.ndim not in (2, 3):
        rule = "must hold an image (y, x) or (frame, y, x)"
        raise keywords.error("PRIMARY", rule, "no image" if opd_m is None else f"{opd_m.ndim} axes")
    has_frame_axis = opd_m.ndim == 3
    opd_m = np.asarray(opd_m, np.float64).reshape(-1, *opd_m.shape[-2:])
    columns = _columns(keywords, parts, len(opd_m)) if has_frame_axis else _columns_of_header(keywords)
    residual = parts["RESIDUAL"].data if "RESIDUAL" in parts else None
    if residual is not None:
        residual = np.asarray(residual, np.float64).reshape(len(opd_m), -1, *opd_m.shape[-2:])
    amplitude = parts["AMPLITUDE"].data if "AMPLITUDE" in parts else None
    if amplitude is not None:
        amplitude = np.asarray(amplitude, np.float64).reshape(opd_m.shape)
    lengths = {
        name: keywords.number(key, "must be a positive length in metres", lambda value: value > 0)
        for name, key in (("pixel_m", "PIXSCALE"), ("wavelength_m", "WAVELEN"), ("diameter_m", "TELDIAM"))
    }
    return WavefrontFile(
        opd_m=opd_m,
        has_frame_axis=has_frame_axis,
        method=method,
        residual=residual,
        amplitude=amplitude,
        source=str(keywords.value("INPUT") or ""),
        source_digest=str(keywords.value("INSHA256") or ""),
        **lengths,
        **columns,
        **_modes(keywords, parts, len(opd_m)),
    )


def _outcome_cards(wavefront: WavefrontFile) -> list[Card]:
    ran = wavefront.ran
    several = wavefront.has_frame_axis
    outcome, sentence = wavefront.outcomes[0], wavefront.sentences[0]
    if several:
        counts = Counter(wavefront.outcomes)
        outcome = ", ".join(f"{count} {name}" for name, count in counts.most_common())
        outcome = wavefront.outcomes[0] if len(counts) == 1 else f"mixed: {outcome}"
        sentence = sentence if len(set(wavefront.sentences)) == 1 else "see FRAMES"
    cards: list[Card] = [("METHOD", wavefront.method, "how it was found"), ("OUTCOME", outcome, "")]
    if sentence:
        cards.append(("OUTNOTE", sentence, ""))
    for key, (name, comment) in _NUMBERS.items():
        values = getattr(wavefront, name)
        if values is None:
            continue
        values = values[ran & np.isfinite(values)]
        median = float(np.median(values)) if values.size else None
        if median is not None and name in ("iterations", "ffts"):
            median = round(median)
        cards.append((key, median, f"{comment}, median" if several else comment))
    if several:
        cards.append(("NFRAMES", len(ran), "frames in the input"))
        cards.append(("NDONE", int(ran.sum()), "frames that ran"))
    return cards


def _mode_columns(wavefront: WavefrontFile) -> list[fits.Column]:
    """A row per mode; with several frames a row per frame and mode, all modes of frame 0 first."""
    frame_count, mode_count = wavefront.coefficient_m.shape
    columns = [
        fits.Column("noll", "J", array=np.tile(wavefront.noll, frame_count)),
        fits.Column("coefficient_m", "D", unit="m", array=wavefront.coefficient_m.ravel()),
        fits.Column("sigma_m", "D", unit="m", array=wavefront.sigma_m.ravel()),
    ]
    if wavefront.has_frame_axis:
        columns.insert(0, fits.Column("frame", "J", array=np.repeat(np.arange(frame_count), mode_count)))
    return columns


def _frame_columns(wavefront: WavefrontFile) -> list[fits.Column]:
    columns = [fits.Column("frame", "J", array=np.arange(len(wavefront.outcomes)))]
    for name in ("outcome", "sentence"):
        texts = [text.encode("ascii", "replace") for text in getattr(wavefront, f"{name}s")]
        columns.append(fits.Column(name, f"{max(1, *map(len, texts))}A", array=np.array(texts)))
    for name, _ in _NUMBERS.values():
        values = getattr(wavefront, name)
        if values is not None:
            unit = {"nm": "nm", "_s": "s"}.get(name[-2:])
            whole = np.issubdtype(values.dtype, np.integer)
            columns.append(fits.Column(name, "J" if whole else "D", unit=None if whole else unit, array=values))
    return columns


def _columns_of_header(keywords: Keywords) -> dict[str, Any]:
    """The fields of a single frame, from the primary header."""
    fields: dict[str, Any] = {
        "outcomes": (keywords.text("OUTCOME", "must be a text"),),
        "sentences": (str(keywords.value("OUTNOTE") or ""),),
    }
    for key, (name, _) in _NUMBERS.items():
        value = keywords.optional_number(key, "must be a number", lambda value: True)
        if name in ("iterations", "ffts"):
            fields[name] = np.array([0 if value is None else int(value)])
        elif key not in _OPTIONAL or key in keywords.header:
            fields[name] = np.array([np.nan if value is None else value])
    return fields


def _columns(keywords: Keywords, parts: dict[str, Hdu], frame_count: int) -> dict[str, Any]:
    """The fields of several frames, from the table FRAMES."""
    needed = ("outcome", "sentence", *[name for key, (name, _) in _NUMBERS.items() if key not in _OPTIONAL])
    table = _table(keywords, parts, "FRAMES", needed, frame_count)
    fields: dict[str, Any] = {
        f"{name}s": tuple(str(text).strip() for text in table[name]) for name in ("outcome", "sentence")
    }
    for name, _ in _NUMBERS.values():
        if name in table.dtype.names:
            kind = np.int64 if name in ("iterations", "ffts") else np.float64
            fields[name] = np.array(table[name], kind)
    return fields


def _modes(keywords: Keywords, parts: dict[str, Hdu], frame_count: int) -> dict[str, Any]:
    table = _table(keywords, parts, "MODES", ("noll", "coefficient_m", "sigma_m"), None)
    if len(table) % frame_count:
        rule = f"must have as many rows for each of {frame_count} frames"
        raise keywords.error("MODES", rule, len(table))
    mode_count = len(table) // frame_count
    fields: dict[str, Any] = {
        name: np.array(table[name], np.float64).reshape(frame_count, mode_count)
        for name in ("coefficient_m", "sigma_m")
    }
    fields["noll"] = np.array(table["noll"][:mode_count], np.int64)
    return fields


def _table(keywords: Keywords, parts: dict[str, Hdu], name: str, columns: tuple[str, ...], rows: int | None) -> Any:
    table = parts[name].data if name in parts else None
    names = None if table is None else table.dtype.names
    if table is None or names is None:
        raise keywords.error(name, "must be a table", "none")
    missing = [column for column in columns if column not in names]
    if missing:
        raise keywords.error(name, f"must have the columns {', '.join(columns)}", f"no {missing[0]}")
    if rows is not None and len(table) != rows:
        raise keywords.error(name, f"must have a row per frame, {rows}", len(table))
    return table
