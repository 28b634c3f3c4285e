"""`nlcwfs loop`: close the loop, and keep what happened."""

import math
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nlcwfs.commands.console import (
    NOT_A_SUCCESS,
    complain,
    device,
    ends_like_ctrl_c,
    say,
    undisturbed,
    use_precision,
    warn,
)
from nlcwfs.commands.loop_keeping import Checkpoints, kept
from nlcwfs.config import Config
from nlcwfs.errors import FileFormatError
from nlcwfs.interop import Provenance
from nlcwfs.interop import loop_folder as folder_of
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.closed_loop.loop import Loop, LoopState, Record
from nlcwfs.simulation.closed_loop.run import run_loop, summary
from nlcwfs.simulation.colours import colour_account
from nlcwfs.simulation.scintillation import scintillation_account

CHECKPOINT_EVERY_S = 20.0
"""Time between two checkpoints, in seconds of the computation."""


def loop(config: Config, out: Path, *, resume: bool, quiet: bool) -> int:
    """Run a loop and write its folder.

    Returns:
        Exit code: 0 when the loop is closed at the end, 1 when not.

    Raises:
        NlcwfsError: If settings contradict each other or the folder cannot be used.
    """
    use_precision(config.precision)
    folder_of.prepare_folder(out, config, resume=resume)
    stopped = folder_of.read_checkpoint(out, config) if resume else None
    say("Making the air, the mirror and the reconstructor ...", quiet=quiet)
    running = Loop.build(config, pupil_of(config))
    air, log_variance = running.light.still.air, running.light.sequence.log_variance
    for line in [*colour_account(config, air), *scintillation_account(config, air, log_variance)]:
        say(line, quiet=quiet)
    state, records = stopped or (None, None)
    if records:
        say(f"Going on at frame {len(records)} of {config.loop.frames}.", quiet=quiet)
    begun = time.perf_counter()
    with ends_like_ctrl_c():
        state, records = _run(running, out, state, records, quiet=quiet)
    with undisturbed():
        numbers = summary(running, state, records, time.perf_counter() - begun)
        for line in account(numbers):  # first, for then they are there whatever becomes of the files
            say(line, quiet=quiet)
        stamp = Provenance.collect(config.model_dump(mode="json"), seed=config.seed, device=device())
        kept(out, config, lambda folder: _write(running, folder, state, records, (numbers, stamp)))
    say(f"Wrote {out}.", quiet=quiet)
    if config.feedback.controller == "kalman" and numbers["wind"] is None:
        warn("no clear wind was found in loop.learn_after_s, or the run ended before: the loop stayed an integrator")
    if numbers["linear_range_nm"] is not None and not numbers["frames_linear"]:
        warn(
            f"the matrix of the linear regime was not used: its range of {numbers['linear_range_nm']:g} nm is too small"
        )
    if numbers["outcome"] != "closed":
        warn(f"the loop is {numbers['outcome']}: {reason(numbers)}")
        return NOT_A_SUCCESS
    return 0


def _run(
    running: Loop, out: Path, state: LoopState | None, records: list[Record] | None, *, quiet: bool
) -> tuple[LoopState, list[Record]]:
    """The exposures, with a bar, and a checkpoint now and then and when interrupted."""
    console, settings = Console(stderr=True), running.config.loop
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    checkpoints, last = Checkpoints(out, running.config), [time.perf_counter(), state, records]
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("loop", total=settings.frames, completed=len(records or []))

        def watch(state: LoopState, records: list[Record]) -> None:
            strehl = f", Strehl {float(state.image.strehl):.2f}" if int(state.image.exposures) else ""
            bar.update(task, completed=state.frame, description=f"{records[-1].rms_nm:.0f} nm{strehl}")
            last[1:] = [state, records]
            if time.perf_counter() - last[0] > CHECKPOINT_EVERY_S:
                checkpoints.write(state, records)
                last[0] = time.perf_counter()

        try:
            state, records = run_loop(running, state=state, records=records, watch=watch)
        except KeyboardInterrupt:
            with undisturbed():
                _keep_part(out, running.config, *last[1:])
            raise
    return state, records


def _keep_part(out: Path, config: Config, state: LoopState | None, records: list[Record] | None) -> None:
    """Where an interrupted run stands, if it has begun."""
    if state is None or records is None:
        return
    try:
        kept(out, config, lambda folder: folder_of.write_checkpoint(folder, config, state, records))
        say(f"Kept {len(records)} frames in {out}; --resume goes on.")
    except FileFormatError as error:
        complain(str(error))


def _write(
    running: Loop, folder: Path, state: LoopState, records: list[Record], made: tuple[dict[str, Any], Provenance]
) -> None:
    """Everything that a run leaves behind."""
    from nlcwfs.studies.loop_files import write_run

    folder_of.write_checkpoint(folder, running.config, state, records)
    write_run(folder, running, state, records, *made)


def account(numbers: dict) -> list[str]:
    """What a run says at its end."""
    bounds, groups = numbers["bounds"], numbers["rms_by_group_nm"]
    star = "" if numbers["magnitude"] is None else f"Star of magnitude {numbers['magnitude']:g}: "
    lines = [
        f"{numbers['frames']} frames at {numbers['rate_hz']:g} Hz: {numbers['outcome']}.",
        f"{star}{numbers['photons_per_s']:.3g} photons a second, {numbers['photons_per_frame']:.3g} a frame.",
    ]
    if numbers["rms_nm"] is not None:
        told = ", ".join(f"{name.replace('_', '-')} {value:.0f}" for name, value in groups.items())
        lines.append(f"Residual {numbers['rms_nm']:.1f} nm rms ({told}); closed at frame {numbers['frames_to_close']}.")
        lines.append(
            f"Bounds: mirror {bounds['fitting_nm']:.0f} nm, lag {bounds['lag_nm']:.0f}, "
            f"quantum limit {bounds['photon_nm']:.0f}, all {bounds['floor_nm']:.0f}; open {bounds['open_loop_nm']:.0f}."
        )
    if numbers["wind"] is not None:
        y, x = numbers["wind"]["y_m_per_s"], numbers["wind"]["x_m_per_s"]
        lines.append(f"Wind {math.hypot(y, x):.1f} m/s towards {math.degrees(math.atan2(y, x)):.0f} deg from +x to +y.")
    if numbers["strehl"] is not None:
        lines.append(f"Strehl {numbers['strehl']:.3f} at {numbers['science_wavelength_um']:g} um.")
    return lines


def reason(numbers: dict) -> str:
    """Why a loop is not closed, as far as it can be told."""
    if numbers["outcome"] == "lost":
        return "it was closed, and is so no longer"
    photons = numbers["photons_per_frame"]
    return f"no wavefront was believed in {numbers['frames']} frames of {photons:g} photons (loop.give_up_s)"
