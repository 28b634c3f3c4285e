"""One point of a sweep: a run of the loop, a row of the table, and the files of the run if they are kept."""

import tempfile
import time
import traceback
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from nlcwfs.config import Config, digest
from nlcwfs.errors import NlcwfsError
from nlcwfs.interop import Provenance
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.closed_loop.loop import Loop, LoopState, Record
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, counted_from, run_loop, summary
from nlcwfs.simulation.closed_loop.seed import reseeded
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.sweep_points import Point

FAILED = "failed"
"""Outcome of a point that gave no numbers."""


class PointResult(NamedTuple):
    """What a worker sends back.

    Attributes:
        row: Of the table.
        files: Content of the files of the run, by name; none unless they are kept.
    """

    row: Row
    files: dict[str, bytes]


class PointRunner:
    """Runs points one after the other; a loop that differs by its seed alone is not built again."""

    def __init__(self) -> None:
        self._family, self._loop = "", None

    def run(self, point: Point) -> PointResult:
        """Run a point; what goes wrong in it is a row, too."""
        jax.config.update("jax_enable_x64", point.config.precision == "double")
        device = str(jax.devices()[0])
        stamp = Provenance.collect(point.config.model_dump(mode="json"), seed=point.config.seed, device=device)
        files: dict[str, bytes] = {}
        try:
            begun = time.perf_counter()
            loop = self._loop_of(point.config)
            built = time.perf_counter()
            state, records = run_loop(loop)
            seconds = time.perf_counter() - built
            numbers = summary(loop, state, records, seconds)
            told = _numbers(loop, state, records, numbers) | {"build_seconds": round(built - begun, 2)}
            if point.keep:
                files = _kept_files(loop, state, records, numbers, stamp)
        except Exception as error:  # whatever it is, the other points go on
            return PointResult(failed_row(point, in_a_line(error), stamp), {})
        return PointResult(_named(point, told, stamp), files)

    def _loop_of(self, config: Config) -> Loop:
        family = digest(config.model_copy(update={"seed": 0}))
        if self._loop is not None and family != self._family:
            self._loop = None
            jax.clear_caches()  # else a long sweep would fill the memory with compiled code
        if self._loop is None:
            self._family, self._loop = family, Loop.build(config, pupil_of(config))
        return self._loop if self._loop.config.seed == config.seed else reseeded(self._loop, config.seed)


def failed_row(point: Point, error: str, stamp: Provenance) -> Row:
    """The row of a point without numbers.

    Args:
        point: The point.
        error: What went wrong, in a line.
        stamp: Of who found out.
    """
    return _named(point, {"outcome": FAILED, "error": error}, stamp)


def in_a_line(error: BaseException) -> str:
    """What an exception says; for one that no user causes also where it comes from.

    Examples:
        >>> from nlcwfs.errors import SettingsError
        >>> in_a_line(SettingsError("loop.rate_hz", "must be higher", 2))
        'loop.rate_hz: must be higher, got 2'
    """
    text = " ".join(str(error).split())[:300]
    if isinstance(error, NlcwfsError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text}{where}"


def _named(point: Point, told: Row, stamp: Provenance) -> Row:
    row: Row = {"point": point.name, "case": point.case} | point.columns
    made = {"device": stamp.device, "commit": stamp.commit, "digest": point.digest}
    return row | {"error": ""} | told | made


def _numbers(loop: Loop, state: LoopState, records: list[Record], numbers: dict) -> Row:
    """The columns of a row; a number that there is not is left out."""
    counted = LoopTelemetry.of(records).rms_nm[counted_from(loop, state) :]
    told = {"outcome": numbers["outcome"], "rms_nm": numbers["rms_nm"]}
    told |= {"worst_nm": round(float(np.max(counted)), 2) if len(counted) else None}
    told |= {f"{name}_nm": value for name, value in numbers["rms_by_group_nm"].items()}
    told |= {name: numbers[name] for name in ("strehl", "frames_to_close")} | numbers["bounds"]
    told |= {name: numbers[name] for name in ("frames", "frames_not_believed", "ffts_per_frame", "seconds")}
    return {name: value for name, value in told.items() if value is not None}


def _kept_files(
    loop: Loop, state: LoopState, records: list[Record], numbers: dict, stamp: Provenance
) -> dict[str, bytes]:
    """The files of `nlcwfs loop`, but for the checkpoint; they travel, for a worker may not see the sweep's folder."""
    from nlcwfs.studies.loop_files import write_run

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder_of.write_config(folder, loop.config)
        write_run(folder, loop, state, records, numbers, stamp)
        return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
