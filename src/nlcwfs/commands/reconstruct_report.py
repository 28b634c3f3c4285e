"""The lines of `nlcwfs reconstruct`: what is about to be done, and how it went."""

from collections import Counter

import numpy as np

from nlcwfs.beam.pupil import inside
from nlcwfs.commands.console import percent
from nlcwfs.curvature_sensor.membrane import moments_of_model
from nlcwfs.curvature_sensor.step_visibility import SeenPlanes, unseen_step
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.interop import FramesFile, WavefrontFile
from nlcwfs.interop.frame_times import FrameTimes
from nlcwfs.interop.frames_reconstruction import FramesReconstructor, is_success
from nlcwfs.interop.frames_sensor import pupil_on_frame, sensor_geometry
from nlcwfs.interop.mirror_twin import twin_warning
from nlcwfs.interop.sequence_reconstruction import FOLLOWED
from nlcwfs.simulation.segment_score import segment_score

FEW_FRAMES = 20
"""Up to here each frame gets a line, beyond only those that failed."""

SURE = 5e-5
"""Probabilities of a wrong turn below this are not told apart: a likelihood is no better than its model."""


def frame_warnings(frames: FramesFile, settings: EstimationSettings) -> list[str]:
    """What the user should know about the frames before believing a wavefront."""
    found = list(frames.warnings)
    if frames.bandwidth_m > 0 and (settings.method != "map" or settings.map.wavelengths == 1):
        told = f"BANDWID: {frames.bandwidth_m:g} m are treated as one colour, {frames.wavelength_m:g} m"
        found.append(f"{told}; method map takes more, estimation.map.wavelengths")
    found += motion_warning(frames, settings)
    usable = [number for number in range(len(frames.electrons)) if number not in frames.frame_problems]
    found += step_warning(frames, float(np.median(frames.photo_electrons()[usable].sum(axis=(1, 2, 3)))))
    twin = twin_warning(frames)
    found += [] if twin is None else [twin]
    found += [f"frame {number} is left out: it {problem}" for number, problem in frames.frame_problems.items()][:10]
    if len(frames.frame_problems) > 10:
        found.append(f"{len(frames.frame_problems) - 10} more frames are left out")
    return found


def motion_warning(frames: FramesFile, settings: EstimationSettings) -> list[str]:
    """Which planes are taken to rest though a membrane moves them, or are followed in too few moments."""
    farthest_m = max(map(abs, frames.distances_m))
    light = {"wavelength_m": frames.wavelength_m, "diameter_m": frames.diameter_m}
    dead_share = frames.membrane_dead_share
    needed = moments_of_model(frames.membrane, distance_m=farthest_m, dead_share=dead_share, **light)
    has = settings.map.membrane_moments if settings.method == "map" else 1
    if has >= needed:
        return []
    told = "the planes are taken to rest" if has == 1 else f"{has} moments are few"
    return [f"MEMBRANE: {told}; method map follows the {frames.membrane}, estimation.map.membrane_moments={needed}"]


def header_lines(frames: FramesFile, reconstructor: FramesReconstructor, *, already: int) -> list[str]:
    """What is about to be reconstructed."""
    count, planes, rows, columns = frames.electrons.shape
    usable = [number for number in range(count) if number not in frames.frame_problems]
    electrons = np.median(reconstructor.photo_electrons[usable].sum(axis=(1, 2, 3)))
    masked, settings = int(frames.masked.sum()), reconstructor.settings
    return [
        f"Frames: {count} of {planes} planes of {rows} x {columns} pixels, {frames.diameter_m / frames.pixel_m:.3g} "
        f"across the pupil; {electrons:.0f} electrons in a frame{f', {masked} pixels masked' if masked else ''}.",
        f"Method: {settings.method}. Strength of the turbulence: {strength_told(settings)}.",
        *([f"Done before: {already} frames."] if already else []),
    ]


def strength_told(settings: EstimationSettings) -> str:
    """Where the strength of the turbulence comes from.

    Examples:
        >>> strength_told(EstimationSettings(method="linear", seeing_arcsec=0.6))
        'seeing 0.6 arcsec (estimation.seeing_arcsec)'
    """
    told = None
    if settings.seeing_arcsec is not None:
        told = f"seeing {settings.seeing_arcsec:.2g} arcsec (estimation.seeing_arcsec)"
    if settings.method != "map":
        return told or "measured from each frame"
    prior = settings.prior
    if prior.fried_m is not None:
        told = f"r0 = {prior.fried_m:.2g} m at 0.5 um (estimation.prior.fried_m)"
    if prior.cutoff_cpa is not None:
        return f"{told or 'usual'}, behind a loop up to {prior.cutoff_cpa:g} cycles per aperture"
    return "measured from each frame" + (f", starting at {told}" if told else "")


def sequence_line(times: FrameTimes, ffts: int) -> str:
    """How a sequence is followed.

    Examples:
        >>> sequence_line(FrameTimes(0.002, (0, 1, 4)), 97)
        'Sequence: 3 frames at 500 Hz, 2 intervals without a frame; 97 FFTs for each frame that follows another.'
    """
    missing = sum(times.missing(number) for number in range(1, len(times.steps)))
    gaps = f", {missing} intervals without a frame" if missing else ""
    return (
        f"Sequence: {len(times.steps)} frames at {1 / times.interval_s:.5g} Hz{gaps}; "
        f"{ffts} FFTs for each frame that follows another."
    )


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
    followed = sum(sentence.startswith(FOLLOWED) for sentence in wavefront.sentences)
    if followed:
        lines.append(f"Followed: {followed} frames; reconstructed alone: {int(wavefront.ran.sum()) - followed}.")
    return lines


def step_warning(frames: FramesFile, electrons: float) -> list[str]:
    """Segments whose light meets that of no other on any plane: nothing tells their step."""
    geometry = sensor_geometry(frames)
    labels = geometry.pupil.labels(geometry.frame)
    if labels is None:
        return []
    planes = SeenPlanes(frames.distances_m, frames.wavelength_m, frames.flux_fractions)
    found = unseen_step(pupil_on_frame(geometry), labels, geometry.frame, photons=electrons, planes=planes)
    if found is None:
        return []
    return [
        f"SEGMENTS: the step of segment {found[0] + 1} is not observable, {found[1]:.2g} electrons tell it: its light "
        "meets that of no other segment on these planes"
    ]


def step_lines(frames: FramesFile, wavefront: WavefrontFile) -> list[str]:
    """What is known of the steps between segments: modulo the wavelength, and how good where there is a TRUTH."""
    if frames.segments is None:
        return []
    count, nm = int(frames.segments.max()) + 1, frames.wavelength_m * 1e9
    good = [number for number, outcome in enumerate(wavefront.outcomes) if is_success(outcome)]
    lines = [f"Segments: {count}. {turn_sentence(wavefront, good, nm)}"]
    if frames.truth_m is None or not good:
        return lines
    pupil = np.ones(frames.segments.shape) if frames.pupil is None else frames.pupil
    weights = np.where(inside(pupil), pupil**2, 0)
    truths_m = np.broadcast_to(frames.truth_m, wavefront.opd_m.shape)
    scores = [
        segment_score(wavefront.opd_m[number] - truths_m[number], weights, frames.segments, wavelength_m=nm * 1e-9)
        for number in good
    ]
    piston_nm, inside_nm = (
        np.median([getattr(one, name) for one in scores]) * 1e9 for name in ("piston_modulo_m", "inside_m")
    )
    off = sum(any(one.turns) for one in scores)
    return [
        *lines,
        f"Steps: error {piston_nm:.2g} nm rms modulo the wavelength, {inside_nm:.1f} nm inside the segments (median, "
        f"against TRUTH); whole wavelengths off in {off} of {len(scores)} frames.",
    ]


def turn_sentence(wavefront: WavefrontFile, good: list[int], nm: float) -> str:
    """Whether the whole wavelengths of the steps are known, of the frames with a wavefront."""
    if wavefront.wrong_turn is None or not good:
        return f"One color tells the steps between them only up to whole wavelengths of {nm:.0f} nm."
    wrong = float(np.max(wavefront.wrong_turn[good]))
    least = "0.9999 or more" if wrong < SURE else f"{1 - wrong:.4f}"
    where = "" if len(good) == 1 else " in the worst frame"
    return f"Whole wavelengths of the steps are right with probability {least}{where}."


def frame_line(wavefront: WavefrontFile, number: int) -> str:
    """One frame in one line."""
    name = f"Frame {number}" if wavefront.has_frame_axis else "Wavefront"
    if not wavefront.ran[number]:
        sentence = wavefront.sentences[number]
        return f"{name}: {wavefront.outcomes[number]}{f': {sentence}' if sentence else ''}."
    error = ""
    if wavefront.error_nm is not None and np.isfinite(wavefront.error_nm[number]):
        error = f"error {wavefront.error_nm[number]:.1f} nm rms (against TRUTH), "
    limit = ""
    if wavefront.quantum_limit_nm is not None and np.isfinite(wavefront.quantum_limit_nm[number]):
        limit = f" (quantum limit {wavefront.quantum_limit_nm[number]:.1f} nm)"
    return (
        f"{name}: {wavefront.rms_nm[number]:.1f} nm rms, {error}"
        f"predicted {wavefront.predicted_error_nm[number]:.1f} nm{limit}; {wavefront.sentences[number]} "
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
