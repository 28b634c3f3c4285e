"""Running the points of a sweep that its table does not hold yet, on the workers of dask."""

import secrets
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from distributed import Client, Future, KilledWorker, as_completed

from nlcwfs.errors import FileFormatError
from nlcwfs.interop import Provenance
from nlcwfs.studies.point_run import PointResult, failed_row, in_a_line
from nlcwfs.studies.study_table import Row, StudyTable
from nlcwfs.studies.sweep_cluster import ClusterError
from nlcwfs.studies.sweep_points import Point, Sweep
from nlcwfs.studies.sweep_worker import run_on_worker

RUNS = "runs"
"""Folder of the runs that are kept, beside the table; no repository keeps it."""

WORKERS = "workers of dask, see the rows"
"""Device in the stamp of a table."""

Watch = Callable[[Row], None]


def missing_points(points: Sequence[Point], table: StudyTable) -> list[Point]:
    """Points that the table does not hold, or holds as failed."""
    done = {(row["point"], row["digest"]) for row in table.rows if not row["error"]}
    return [point for point in points if (point.name, point.digest) not in done]


def rows_of(points: Sequence[Point], table: StudyTable) -> list[Row]:
    """Rows of these points with these settings, in this order; the table may hold others."""
    rows = {(row["point"], row["digest"]): row for row in table.rows}
    return [rows[point.name, point.digest] for point in points if (point.name, point.digest) in rows]


def run_sweep(client: Client, sweep: Sweep, points: Sequence[Point], table: StudyTable, watch: Watch) -> None:
    """Run points; each is in the table as soon as it is done.

    A point that fails, or that takes its worker down too often, has a row that tells why.

    Args:
        client: Of the workers.
        sweep: Whose settings stamp the table.
        points: To run.
        table: Gets the rows.
        watch: Called with each row.

    Raises:
        ClusterError: If the scheduler goes away.
        FileFormatError: If the table or a run cannot be written.
    """
    settings = sweep.model_dump(mode="json")
    # The rows of a table may come from many machines and seeds, which they tell themselves.
    stamp = Provenance.collect(settings, seed=None, device=WORKERS)
    futures = client.map(run_on_worker, list(points), pure=False)
    waiting = {future.key: point for future, point in zip(futures, points, strict=True)}
    try:
        for future in as_completed(futures):
            point = waiting.pop(future.key)
            if future.cancelled():
                raise ClusterError("the scheduler must stay until the end, got no answer from it any more")
            result = _result(future, point, stamp)
            if result.files:
                keep_run(table.path.parent / RUNS / point.name, result.files)
            row = result.row
            table.put(row, stamp)
            watch(row)
            future.release()
    finally:
        client.cancel([future for future in futures if future.key in waiting])


def keep_run(folder: Path, files: dict[str, bytes]) -> None:
    """Write the folder of a run, whole or not at all; one that is there goes.

    Raises:
        FileFormatError: If it cannot be written.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "runs" / "all,seed=0"
        >>> keep_run(folder, {"summary.json": b"{}"})
        >>> [path.name for path in folder.parent.iterdir()], (folder / "summary.json").read_text()
        (['all,seed=0'], '{}')
    """
    temporary = folder.with_name(f".{secrets.token_hex(4)}-{folder.name}")
    try:
        temporary.mkdir(parents=True)
        for name, content in files.items():
            (temporary / name).write_bytes(content)
        if folder.exists():
            shutil.rmtree(folder)
        temporary.rename(folder)
    except OSError as error:
        raise FileFormatError(f"{folder}: cannot be written, got {error.strerror or error}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _result(future: Future, point: Point, stamp: Provenance) -> PointResult:
    """What a worker sent back, or why none did."""
    error: Any = future.exception()
    if error is None:
        return future.result()
    text = in_a_line(error)
    if isinstance(error, KilledWorker):
        text = f"{error.allowed_failures + 1} workers died over it; their logs may tell why, or too little memory"
    return PointResult(failed_row(point, text, stamp), {})
