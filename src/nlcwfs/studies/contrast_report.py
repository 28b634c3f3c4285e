"""What a study of contrast found, in words: for the terminal and for its page."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nlcwfs.interop import atomic_write
from nlcwfs.studies.contrast_table import MAS_RAD, ContrastStudy
from nlcwfs.studies.study_table import Row

BLIND = "blind"

CAPTION = (
    "Halo of time lag and photon noise behind an ideal coronagraph, against the angle from the star, for several rates "
    "of the loop. Dashed: each angle at its best rate. Dotted: without correction. Red: measured in closed loops of "
    "the simulation, behind an ideal coronagraph; open: the closed form with the flux factor of "
    "the sensor in these loops."
)


def setting_in_words(study: ContrastStudy) -> str:
    """Telescope, star and air in a sentence.

    Args:
        study: What is compared.

    Examples:
        >>> from nlcwfs.config import Config
        >>> star = {"atmosphere": {"photons_per_s": 7.8e7}}
        >>> setting_in_words(ContrastStudy.of(Config.model_validate(star)))
        '8 m telescope, 7.8e+07 photons a second at 0.85 um, image at 0.85 um, r0 16.8 cm at 0.5 um, wind 10 m/s.'
    """
    halo = study.halo
    speeds = ", ".join(f"{speed:g}" for _, speed in halo.winds)
    return (
        f"{halo.diameter_m:g} m telescope, {halo.photons_per_s:.3g} photons a second at {1e6 * halo.sensing_m:g} um, "
        f"image at {1e6 * halo.imaging_m:g} um, r0 {100 * halo.air.fried_at(0.5e-6):.1f} cm at 0.5 um, "
        f"wind {speeds} m/s."
    )


def told_rows(study: ContrastStudy) -> list[list[str]]:
    """What is told, a list of cells for each line: sensor, what, and a value for each angle.

    Args:
        study: What is compared.

    Examples:
        >>> from nlcwfs.config import Config
        >>> settings = {"sensors": ["ideal"], "angles_mas": [100.0, 200.0], "rates_hz": [1000.0]}
        >>> config = Config.model_validate({"atmosphere": {"photons_per_s": 7.8e7}, "contrast": settings})
        >>> [line[1] for line in told_rows(ContrastStudy.of(config))]
        ['flux factor', 'C2 at 1000 Hz', 'best rate [Hz]', 'C2 at the best rate']
    """
    halo, angle_rad = study.halo, np.array(study.told_mas) * MAS_RAD
    lines, least = [], []
    for sensor in study.sensors:
        factor = study.factor(sensor, np.array(study.told_mas))
        lines.append([sensor.sensor, "flux factor", *_cells(factor, "{:.3g}")])
        for rate_hz in study.rates_hz:
            lines.append([sensor.sensor, f"C2 at {rate_hz:g} Hz", *_cells(halo.contrast(angle_rad, rate_hz, factor))])
        best_hz = np.where(np.isfinite(factor), halo.best_rate_hz(angle_rad, factor), np.inf)
        lines.append([sensor.sensor, "best rate [Hz]", *_cells(best_hz, "{:.0f}")])
        least.append(halo.best_contrast(angle_rad, factor))
        lines.append([sensor.sensor, "C2 at the best rate", *_cells(least[-1])])
    if len(study.sensors) > 1:
        first, last = study.sensors[0].sensor, study.sensors[-1].sensor
        gain = np.where(np.isfinite(least[-1]), least[0], np.nan) / np.where(np.isfinite(least[-1]), least[-1], 1)
        lines.append([last, f"gain over {first}, best rates", *_cells(gain, "{:.3g}")])
    return lines


def answer(study: ContrastStudy) -> str:
    """The finding in a sentence.

    Args:
        study: What is compared.

    Examples:
        >>> from nlcwfs.config import Config
        >>> settings = {"sensors": ["curvature", "ideal"], "angles_mas": [200.0], "rates_hz": [1000.0]}
        >>> config = Config.model_validate({"atmosphere": {"photons_per_s": 7.8e7}, "contrast": settings})
        >>> answer(ContrastStudy.of(config))  # 2.1 to the power 2/3
        'At 200 mas the halo behind the ideal sensor is 1.64 times fainter than that behind curvature, each at its ...'
    """
    last = told_rows(study)[-1]
    told = [(f"{mas:.3g}", text) for mas, text in zip(study.told_mas, last[2:], strict=True) if text != BLIND]
    if not told:
        return f"The {last[0]} sensor, or the one that it is compared with, sees no wave that is told here"
    angles, texts = (", ".join(part) for part in zip(*told, strict=True))
    if len(study.sensors) == 1:
        return f"At {angles} mas the {last[0]} sensor leaves a halo of {texts} at its best rates"
    first = study.sensors[0].sensor
    return (
        f"At {angles} mas the halo behind the {last[0]} sensor is {texts} times fainter than that "
        f"behind {first}, each at its best rate"
    )


def write_report(path: Path, study: ContrastStudy, picture: str, loops: Sequence[Row]) -> None:
    """Write the page beside the table.

    Args:
        path: The page.
        study: What is compared.
        picture: File name of the figure.
        loops: Of the table of loops, if there is one.
    """
    lines = [f"# {answer(study)}", ""]
    lines += ["How bright a halo do time lag and photon noise leave around a bright star, with each sensor?", ""]
    lines += [setting_in_words(study), "", f"![{CAPTION}]({picture})", "", f"*{CAPTION}*", ""]
    lines += _table(["sensor", "", *(f"{angle:.3g} mas" for angle in study.told_mas)], told_rows(study))
    lines += ["", *(f"{line[:1].upper()}{line[1:]}.\n" for line in study.blind())]
    if loops:
        lines += ["## In closed loop", "", *_loop_lines(loops), ""]
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _loop_lines(loops: Sequence[Row]) -> list[str]:
    """The loops, and what the closed form says of them."""
    header = ["sensor", "rate [Hz]", "photons/s", "skies", "angle [mas]", "flux factor", "measured", "closed form"]
    header += ["with the wings", "measured over closed form"]
    cells = [
        [
            *(str(row["sensor"]), f"{row['rate_hz']:g}", f"{row['photons_per_s']:.2g}", f"{row['seeds']}"),
            *(f"{row['angle_mas']:g}", f"{row['flux_factor']:.2f}", f"{row['measured']:.2e}"),
            *(f"{row['contrast']:.2e}", f"{row['with_wings']:.2e}"),
            f"{float(row['measured']) / float(row['contrast']):.2f}",
        ]
        for row in over_skies(loops)
    ]
    return [
        "Coronagraphic images of closed loops of the simulation, means over the azimuth and the run. The flux factor "
        "is that of the loop's sensor for the wavefront that is left, by Fisher information. The wings are what "
        "the hard edge of the aperture carries from other angles, above all from beyond the mirror."
        + _no_static(loops),
        "",
        *_table(header, cells),
    ]


def _no_static(loops: Sequence[Row]) -> str:
    if any(float(row["static_nm"]) for row in loops):
        return ""
    return " No static aberration is in the arm of the sensor: slow waves need more photons than they do with one."


def over_skies(loops: Sequence[Row]) -> list[Row]:
    """Means over the seeds, a row for each sensor, rate, star, static aberration and angle.

    Args:
        loops: Of the table of loops.

    Examples:
        >>> loop = {"sensor": "curvature", "rate_hz": 1e3, "photons_per_s": 1e7, "static_nm": 0.0, "angle_mas": 83.0}
        >>> halo = {"flux_factor": 2.0, "contrast": 1e-5, "with_wings": 1e-5}
        >>> rows = [loop | halo | {"measured": value} for value in (1e-5, 3e-5)]
        >>> [(row["seeds"], row["measured"]) for row in over_skies(rows)]
        [(2, 2e-05)]
    """
    names = ("sensor", "rate_hz", "photons_per_s", "static_nm", "angle_mas")
    groups: dict[tuple, list[Row]] = {}
    for row in loops:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    means = ("flux_factor", "contrast", "with_wings", "measured")
    return [
        dict(zip(names, shared, strict=True))
        | {"seeds": len(members)}
        | {name: float(np.mean([float(row[name]) for row in members])) for name in means}
        for shared, members in groups.items()
    ]


def _table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *lines)]


def _cells(values: np.ndarray, form: str = "{:.2e}") -> list[str]:
    return [form.format(value).replace("e-0", "e-") if np.isfinite(value) else BLIND for value in values]
