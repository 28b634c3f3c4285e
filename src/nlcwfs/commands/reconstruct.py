"""`nlcwfs reconstruct`: from the frames of a sensor to wavefronts, with what can be said about their errors."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlcwfs.commands.console import (
    INTERRUPTED,
    NOT_A_SUCCESS,
    complain,
    device,
    percent,
    say,
    tracked,
    undisturbed,
    use_precision,
    warn,
    working,
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
from nlcwfs.interop.frames_reconstruction import FramesReconstructor, is_success

METHODS = ("gerchberg-saxton",)
PICTURES = (".png", ".pdf", ".svg", ".jpg")
OWN_KEYS = ("estimation", "precision")
"""What frames do not say of themselves."""

FEW_FRAMES = 20
"""Up to here each frame gets a line, beyond only those that failed."""


@dataclass(frozen=True)
class ReconstructOptions:
    """What the user typed."""

    frames: Path
    out: Path
    plot: Path | None = None
    resume: bool = False
    quiet: bool = False


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
    for line in frame_warnings(frames):
        warn(f"{options.frames}: {line}")
    reconstructor = FramesReconstructor.build(frames, config.estimation, dtype=use_precision(config.precision))
    settings = {"estimation": reconstructor.settings.model_dump(mode="json"), "precision": config.precision}
    done = finished_before(options, frames, settings_digest(settings)) if options.resume else {}
    for line in header_lines(frames, reconstructor, already=len(done)):
        say(line, quiet=options.quiet)
    interrupted = run(reconstructor, done, quiet=options.quiet)
    with undisturbed():
        wavefront = WavefrontFile.from_frames(done, frames, method=config.estimation.method, noll=reconstructor.noll)
        if done:
            write_wavefront(options.out, wavefront, Provenance.collect(settings, seed=None, device=device()))
    if interrupted:
        left = wavefront.outcomes.count("not run")
        kept = f"{len(done)} frames are in {options.out}, {left} are not run; go on with --resume"
        complain(f"interrupted: {kept}" if done else "interrupted before the first frame: nothing was written")
        return Result(frames, wavefront, INTERRUPTED)
    for line in result_lines(wavefront, light_lost(reconstructor, done)):
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


def read_estimation(path: Path | None, overrides: Sequence[str], method: str | None) -> Config:
    """The settings of a reconstruction; what the frames say of themselves cannot be set.

    Raises:
        NlcwfsError: If the file cannot be read, or a setting breaks its rule or belongs to the frames.
    """
    if method is not None and method not in METHODS:
        raise SettingsError("--method", f"must be {' or '.join(METHODS)}", method)
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


def frame_warnings(frames: FramesFile) -> list[str]:
    """What the user should know about the frames before believing a wavefront."""
    found = list(frames.warnings)
    if frames.bandwidth_m > 0:
        found.append(f"BANDWID: {frames.bandwidth_m:g} m are treated as one colour, {frames.wavelength_m:g} m")
    found += [f"frame {number} is left out: it {problem}" for number, problem in frames.frame_problems.items()][:10]
    if len(frames.frame_problems) > 10:
        found.append(f"{len(frames.frame_problems) - 10} more frames are left out")
    return found


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


def run(reconstructor: FramesReconstructor, done: dict[int, FrameWavefront], *, quiet: bool) -> bool:
    """Reconstruct the frames that are not done, in place; returns whether the user interrupted."""
    frames = reconstructor.frames
    waiting = [n for n in range(len(frames.electrons)) if n not in done and n not in frames.frame_problems]
    if not waiting:
        return False
    try:
        with working("Compiling for this sensor", quiet=quiet):
            seconds = reconstructor.compile()
        say(f"Compiled for this sensor in {seconds:.1f} s.", quiet=quiet)
        for number in tracked(waiting, what="Reconstructing", total=len(waiting), quiet=quiet):
            done[number] = reconstructor.reconstruct(number)
    except KeyboardInterrupt:
        return True
    return False


def light_lost(reconstructor: FramesReconstructor, done: dict[int, FrameWavefront]) -> np.ndarray | None:
    """Share of the light of each plane that misses the window, mean over the first successes."""
    good = [each.opd_m for each in done.values() if is_success(each.outcome)][:10]
    return reconstructor.light_outside(good) if good else None


def header_lines(frames: FramesFile, reconstructor: FramesReconstructor, *, already: int) -> list[str]:
    """What is about to be reconstructed."""
    count, planes, rows, columns = frames.electrons.shape
    usable = [number for number in range(count) if number not in frames.frame_problems]
    electrons = np.median(reconstructor.photo_electrons[usable].sum(axis=(1, 2, 3)))
    masked = int(frames.masked.sum())
    seeing = reconstructor.settings.seeing_arcsec
    prior = "measured from each frame" if seeing is None else f"seeing {seeing:.2g} arcsec (estimation.seeing_arcsec)"
    return [
        f"Frames: {count} of {planes} planes of {rows} x {columns} pixels, {frames.diameter_m / frames.pixel_m:.3g} "
        f"across the pupil; {electrons:.0f} electrons in a frame{f', {masked} pixels masked' if masked else ''}.",
        f"Strength of the turbulence: {prior}.",
        *([f"Done before: {already} frames."] if already else []),
    ]


def result_lines(wavefront: WavefrontFile, lost: np.ndarray | None) -> list[str]:
    """How it went: a line per frame for a few, a summary for many."""
    lines = []
    if lost is not None:
        shares = ", ".join(percent(float(share)) for share in lost)
        lines.append(f"Light outside the window: about {shares} of planes 1 to {len(lost)}.")
    numbers = range(len(wavefront.outcomes))
    failed = [number for number in numbers if not is_success(wavefront.outcomes[number])]
    several = len(numbers) > FEW_FRAMES
    for number in failed[:FEW_FRAMES] if several else numbers:
        lines.append(frame_line(wavefront, number))
    if several and len(failed) > FEW_FRAMES:
        lines.append(f"... and {len(failed) - FEW_FRAMES} more that are no success")
    if len(numbers) > 1:
        lines += summary_lines(wavefront)
    return lines


def frame_line(wavefront: WavefrontFile, number: int) -> str:
    """One frame in one line."""
    name = f"Frame {number}" if wavefront.has_frame_axis else "Wavefront"
    if not wavefront.ran[number]:
        sentence = wavefront.sentences[number]
        return f"{name}: {wavefront.outcomes[number]}{f': {sentence}' if sentence else ''}."
    error = ""
    if wavefront.error_nm is not None and np.isfinite(wavefront.error_nm[number]):
        error = f"error {wavefront.error_nm[number]:.1f} nm rms (against TRUTH), "
    return (
        f"{name}: {wavefront.rms_nm[number]:.1f} nm rms, {error}"
        f"predicted {wavefront.predicted_error_nm[number]:.1f} nm; {wavefront.sentences[number]} "
        f"({wavefront.iterations[number]} iterations, {wavefront.ffts[number]} FFTs, "
        f"{1e3 * wavefront.runtime_s[number]:.0f} ms)."
    )


def summary_lines(wavefront: WavefrontFile) -> list[str]:
    """All frames in a few lines."""
    counts = Counter(wavefront.outcomes)
    lines = [f"Outcomes: {', '.join(f'{count} {name}' for name, count in counts.most_common())}."]
    columns = {"rms": wavefront.rms_nm, "error": wavefront.error_nm, "predicted error": wavefront.predicted_error_nm}
    for name, values in columns.items():
        known = np.empty(0) if values is None else values[np.isfinite(values)]
        if known.size:
            low, middle, high = np.percentile(known, [10, 50, 90])
            lines.append(
                f"{name.capitalize()}: median {middle:.1f} nm, 80 % of frames from {low:.1f} to {high:.1f} nm."
            )
    return lines
