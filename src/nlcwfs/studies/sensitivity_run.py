"""Flux factors of many sensors behind wavefronts of many roughnesses: a row for each mode, as soon as it is known."""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.interop import Provenance
from nlcwfs.simulation.sensitivity_curve import Curve, sensitivity_curve
from nlcwfs.simulation.sensitivity_optics import check_case
from nlcwfs.simulation.sensitivity_settings import SensitivityCase, SensitivityQuestion
from nlcwfs.studies.study_table import Row, StudyTable


class CurvePoint(NamedTuple):
    """One sensor behind wavefronts of one roughness.

    Attributes:
        case: The sensor.
        config: Its settings.
        rms_rad: The roughness.
        digest: Fingerprint of all that the numbers follow from.
    """

    case: SensitivityCase
    config: Config
    rms_rad: float
    digest: str

    @property
    def name(self) -> str:
        """In words, for progress."""
        return f"{self.case.name}, {self.rms_rad:g} rad"


def curve_points(question: SensitivityQuestion) -> tuple[CurvePoint, ...]:
    """What a question asks to compute, the smoothest wavefronts first.

    Raises:
        SettingsError: If the settings of a sensor are impossible; names the case.

    Examples:
        >>> points = curve_points(SensitivityQuestion(question="?", rms_rad=(0, 20)))
        >>> len(points), points[0].name
        (17, 'Shack-Hartmann, D/d 16, 0 rad')
    """
    asked = sorted({rms for case in question.case for rms in _asked(case, question)})
    configs = {case.name: case.config(None, question.set) for case in question.case}
    for case in question.case:
        check_case(case, configs[case.name])
    return tuple(
        CurvePoint(case, configs[case.name], rms, _digest(case, configs[case.name], question, rms))
        for rms in asked
        for case in question.case
        if rms in _asked(case, question)
    )


def missing_curves(points: Sequence[CurvePoint], table: StudyTable) -> list[CurvePoint]:
    """Points that the table does not hold."""
    done = {row["digest"] for row in table.rows}
    return [point for point in points if point.digest not in done]


def run_curve(
    point: CurvePoint, question: SensitivityQuestion, table: StudyTable, progress: Callable[[int, int], None]
) -> list[Row]:
    """Compute one point and put its rows into the table.

    Args:
        point: What to compute.
        question: Whose settings stamp the table.
        table: Gets the rows.
        progress: Told after every wavefront.

    Raises:
        NlcwfsError: If the point is impossible, or the table cannot be written; the table keeps what it has.
    """
    curve = sensitivity_curve(point.case, point.config, question, rms_rad=point.rms_rad, progress=progress)
    device = str(jax.devices()[0])
    stamp = Provenance.collect(question.model_dump(mode="json"), seed=question.seed, device=device)
    rows = _rows(point, question, curve, device, stamp.commit)
    table.put_all(rows, stamp)
    return rows


def _asked(case: SensitivityCase, question: SensitivityQuestion) -> tuple[float, ...]:
    return question.rms_rad if case.rms_rad is None else case.rms_rad


def _rows(point: CurvePoint, question: SensitivityQuestion, curve: Curve, device: str, commit: str) -> list[Row]:
    """A row for each mode."""
    modes: list[Row] = [{"cycles_per_aperture": float(cycles)} for cycles in question.cycles_per_aperture]
    if question.zernikes is not None:
        modes = [{"noll": noll} for noll in range(2, question.zernikes + 1)]
    return [
        {
            "factor": f"{point.name}, {next(iter(mode))} {next(iter(mode.values())):g}",
            "sensor": point.case.name,
            "reconstruction": point.case.reconstruction,
            "rms_rad": point.rms_rad,
            **mode,
            "flux_factor": _rounded(curve.factor[number]),
            "flux_factor_p16": _rounded(curve.low[number]),
            "flux_factor_p84": _rounded(curve.high[number]),
            "flux_factor_all_unknown": _rounded(curve.together[number]),
            "beta_p": _rounded(math.sqrt(curve.factor[number])),
            "wavefronts": curve.wavefronts,
            "light": round(curve.light, 4),
            "cells_across_pupil": (question.rough if point.rms_rad else question.flat).across_pupil,
            "device": device,
            "error": "",
            "commit": commit,
            "digest": point.digest,
        }
        for number, mode in enumerate(modes)
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _digest(case: SensitivityCase, config: Config, question: SensitivityQuestion, rms_rad: float) -> str:
    """Of all that the numbers follow from; words do not count."""
    words = {"question", "answer", "notes", "case", "rms_rad", "set"}
    told = {
        "case": case.model_dump(mode="json", exclude={"rms_rad", "set"}),
        "config": config.model_dump(mode="json", exclude_defaults=True),
        "asked": question.model_dump(mode="json", exclude=words),
        "rms_rad": rms_rad,
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


def table_of(folder: Path) -> StudyTable:
    """The table in a folder.

    Raises:
        FileFormatError: If there is one that cannot be read.

    Examples:
        >>> table_of(Path("nowhere")).rows
        []
    """
    return StudyTable(folder / "results.ecsv", "factor")


def rows_of_points(points: Sequence[CurvePoint], table: StudyTable) -> list[Row]:
    """The rows of these points, in their order.

    Raises:
        SettingsError: If there are none.
    """
    rows = {point.digest: [row for row in table.rows if row["digest"] == point.digest] for point in points}
    found = [row for point in points for row in rows[point.digest]]
    if not found:
        raise SettingsError("sensitivity", "must have computed a sensor", "no rows")
    return found
