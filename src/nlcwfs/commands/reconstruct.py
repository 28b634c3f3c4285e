"""`nlcwfs reconstruct`: from the frames of a sensor to wavefronts, with what can be said about their errors."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlcwfs.commands.console import (
    INTERRUPTED,
    NOT_A_SUCCESS,
    complain,
    device,
    say,
    tracked,
    undisturbed,
    use_precision,
    warn,
    working,
)
from nlcwfs.commands.reconstruct_report import (
    frame_warnings,
    header_lines,
    result_lines,
    sequence_line,
    step_lines,
)
from nlcwfs.config import Config, load_config
from nlcwfs.errors import FileFormatError, SettingsError
from nlcwfs.interop import (
    FramesFile,
    FrameWavefront,
    Provenance,
    WavefrontFile,
    check_writable,
    read_frames,
    read_provenance,
    read_wavefront,
    settings_digest,
    write_wavefront,
)
from nlcwfs.interop.frame_times import frame_times
from nlcwfs.interop.frames_reconstruction import FramesReconstructor, is_success
from nlcwfs.interop.sequence_reconstruction import SequenceRun

METHODS = ("map", "gerchberg-saxton", "linear")
PICTURES = (".png", ".pdf", ".svg", ".jpg")
OWN_KEYS = ("estimation", "precision")
"""What frames do not say of themselves."""


@dataclass(frozen=True)
class ReconstructOptions:
    """What the user typed."""

    frames: Path
    out: Path
    plot: Path | None = None
    resume: bool = False
    quiet: bool = False
    sequence: bool = False


@dataclass(frozen=True)
class Result:
    """What a run leaves behind."""

    frames: FramesFile
    wavefront: WavefrontFile
    exit_code: int


def reconstruct(config: Config, options: ReconstructOptions) -> Result:
    """Reconstruct every frame of a file, write the wavefronts, and say how it went.

    After Ctrl-C what is done is written, the rest is marked as not run, and `resume` goes on from there.

    Raises:
        NlcwfsError: If the frames, a setting or an output cannot be used; nothing is written then.
    """
    check_outputs(options)
    frames = read_frames(options.frames)
    work = prepared(config, options, frames)
    reconstructor = work.single if isinstance(work, SequenceRun) else work
    for line in frame_warnings(frames, reconstructor.settings):
        warn(f"{options.frames}: {line}")
    settings = {"estimation": config.estimation.model_dump(mode="json"), "precision": config.precision}
    settings |= {"sequence": True} if options.sequence else {}
    done = finished_before(options, frames, settings_digest(settings)) if options.resume else {}
    told = [sequence_line(work.times, work.solver.ffts)] if isinstance(work, SequenceRun) else []
    for line in [*header_lines(frames, reconstructor, already=len(done)), *told]:
        say(line, quiet=options.quiet)
    interrupted = run(work, frames, done, quiet=options.quiet)
    with undisturbed():
        wavefront = WavefrontFile.from_frames(done, frames, method=config.estimation.method, noll=reconstructor.noll)
        if done:
            write_wavefront(options.out, wavefront, Provenance.collect(settings, seed=None, device=device()))
    if interrupted:
        left = wavefront.outcomes.count("not run")
        kept = f"{len(done)} frames are in {options.out}, {left} are not run; go on with --resume"
        complain(f"interrupted: {kept}" if done else "interrupted before the first frame: nothing was written")
        return Result(frames, wavefront, INTERRUPTED)
    for line in [*result_lines(wavefront, light_lost(reconstructor, done)), *step_lines(frames, wavefront)]:
        say(line, quiet=options.quiet)
    written = [str(options.out)]
    if options.plot is not None and done:
        from nlcwfs.studies.pictures import draw_reconstruction, save_picture

        shown = next((number for number, each in done.items() if is_success(each.outcome)), next(iter(done)))
        save_picture(draw_reconstruction(frames, wavefront, shown), options.plot)
        written.append(str(options.plot))
    say(f"Wrote {' and '.join(written)}.", quiet=options.quiet)
    good = all(is_success(outcome) for outcome in wavefront.outcomes)
    return Result(frames, wavefront, 0 if good else NOT_A_SUCCESS)


def prepared(config: Config, options: ReconstructOptions, frames: FramesFile) -> FramesReconstructor | SequenceRun:
    """Everything that the frames share.

    Raises:
        NlcwfsError: If a setting cannot be used, or frames that shall be a sequence have no clock.
    """
    dtype = use_precision(config.precision)
    times = frame_times(frames, options.frames) if options.sequence else None
    with working("Preparing for this sensor", quiet=options.quiet):
        if times is not None:
            return SequenceRun.build(frames, config.estimation, times, dtype=dtype)
        return FramesReconstructor.build(frames, config.estimation, dtype=dtype)


def read_estimation(path: Path | None, overrides: Sequence[str], method: str | None) -> Config:
    """The settings of a reconstruction; what the frames say of themselves cannot be set.

    Raises:
        NlcwfsError: If the file cannot be read, or a setting breaks its rule or belongs to the frames.
    """
    if method is not None and method not in METHODS:
        raise SettingsError("--method", f"must be {', '.join(METHODS[:-1])} or {METHODS[-1]}", method)
    for text in overrides:
        key = text.partition("=")[0].strip()
        if "=" in text and key.partition(".")[0] not in OWN_KEYS:
            raise SettingsError("--set", "must be a key of estimation: the frames say the rest in their header", text)
    chosen = [] if method is None else [f"estimation.method={method}"]
    return load_config(path, [*overrides, *chosen])


def check_outputs(options: ReconstructOptions) -> None:
    """Refuse outputs that could not be written, or that would overwrite the frames, before anything is computed.

    Raises:
        FileFormatError: If an output cannot be written.
        SettingsError: If an output is the input, or a picture's ending is unknown.
    """
    check_writable(options.out)
    outputs = {"--out": options.out}
    if options.plot is not None:
        check_writable(options.plot)
        if options.plot.suffix.lower() not in PICTURES:
            raise SettingsError("--plot", f"must end in {', '.join(PICTURES)}", options.plot)
        outputs["--plot"] = options.plot
    for name, path in outputs.items():
        if path.exists() and options.frames.exists() and os.path.samefile(path, options.frames):
            raise SettingsError(name, "must not overwrite the frames", path)
    if options.plot is not None and options.plot.resolve() == options.out.resolve():
        raise SettingsError("--plot", "must be another file than --out", options.plot)


def finished_before(options: ReconstructOptions, frames: FramesFile, digest: str) -> dict[int, FrameWavefront]:
    """What an interrupted run has already done.

    Raises:
        FileFormatError: If the output is no wavefront, or one of other frames or settings.
    """
    if not options.out.exists():
        return {}
    before, stamp = read_wavefront(options.out), read_provenance(options.out)
    if before.source_digest != frames.source_digest:
        rule = "must be of the same frames to be resumed"
        raise FileFormatError(f"{options.out}: INSHA256: {rule}, got those of {before.source or 'an unknown file'}")
    if stamp.settings_digest != digest:
        raise FileFormatError(f"{options.out}: CFGHASH: must be of the same settings to be resumed, got others")
    return before.finished()


def run(
    work: FramesReconstructor | SequenceRun, frames: FramesFile, done: dict[int, FrameWavefront], *, quiet: bool
) -> bool:
    """Reconstruct the frames that are not done, in place; returns whether the user interrupted."""
    waiting = [n for n in range(len(frames.electrons)) if n not in done and n not in frames.frame_problems]
    if not waiting:
        return False
    try:
        with working("Compiling for this sensor", quiet=quiet):
            seconds = work.compile()
        say(f"Compiled for this sensor in {seconds:.1f} s.", quiet=quiet)
        for number, found in tracked(work.each(waiting), what="Reconstructing", total=len(waiting), quiet=quiet):
            done[number] = found
    except KeyboardInterrupt:
        return True
    return False


def light_lost(reconstructor: FramesReconstructor, done: dict[int, FrameWavefront]) -> np.ndarray | None:
    """Share of the light of each plane that misses the window, mean over the first successes."""
    good = [each.opd_m for each in done.values() if is_success(each.outcome)][:10]
    return reconstructor.light_outside(good) if good else None
