"""The files that a run of the loop leaves, but for its settings and its checkpoint."""

from pathlib import Path
from typing import Any

from nlcwfs.interop import Provenance
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.simulation.closed_loop.loop import Loop, LoopState, Record
from nlcwfs.studies.loop_picture import draw_loop


def write_run(
    folder: Path, loop: Loop, state: LoopState, records: list[Record], numbers: dict[str, Any], stamp: Provenance
) -> None:
    """Write rows, telemetry, image, picture and summary; the summary is last, and tells that the rest is there.

    Args:
        folder: Of the run.
        loop: The loop.
        state: Where it ended.
        records: What was recorded.
        numbers: See `simulation.closed_loop.run.summary`.
        stamp: Of all the files.
    """
    folder_of.write_records(folder, loop, records, stamp)
    folder_of.write_telemetry(folder, loop, state, records, stamp)
    if int(state.image.exposures):
        folder_of.write_image(folder, state, stamp)
    draw_loop(folder / folder_of.PICTURE, loop, state, records, floor_nm=numbers["bounds"]["floor_nm"])
    folder_of.write_summary(folder, numbers, stamp)
