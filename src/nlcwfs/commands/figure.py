"""`nlcwfs figure`: the paper's figures with our numbers."""

from collections.abc import Sequence
from pathlib import Path

from nlcwfs.commands.console import say, use_precision, working
from nlcwfs.commands.reconstruct import PICTURES
from nlcwfs.config import load_config
from nlcwfs.errors import SettingsError
from nlcwfs.interop import check_writable
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.studies.single_frame import PAPER_CASE, SingleFrame, single_frame

FIGURES = ("single-frame",)


def draw_figure(name: str, out: Path | None, *, seed: int | None, overrides: Sequence[str]) -> None:
    """Compute and draw a figure.

    Raises:
        NlcwfsError: If there is no such figure, or a setting or the output cannot be used.
    """
    if name not in FIGURES:
        raise SettingsError("NAME", f"must be {' or '.join(FIGURES)}", name)
    path = Path(f"{name}.png") if out is None else out
    check_writable(path)
    if path.suffix.lower() not in PICTURES:
        raise SettingsError("--out", f"must end in {', '.join(PICTURES)}", path)
    config = load_config(None, [*PAPER_CASE, *overrides, *([] if seed is None else [f"seed={seed}"])])
    use_precision(config.precision)
    with working("Simulating and reconstructing"):
        simulator = ExposureSimulator.build(config, pupil_of(config))
        case = single_frame(config, simulator, simulator.expose(frame_key(seed=config.seed, frame=0)))
    from nlcwfs.studies.pictures import draw_single_frame, save_picture

    save_picture(draw_single_frame(case), path)
    for line in case_lines(case):
        say(line)
    say(f"Wrote {path}.")


def case_lines(case: SingleFrame) -> list[str]:
    """The numbers of a single frame."""
    across = case.frames.diameter_m / case.frames.pixel_m
    return [
        f"True wavefront {case.rms_nm:.0f} nm rms, tilt included; {case.frames.photo_electrons().sum():.0f} "
        f"photo-electrons in {case.frames.electrons.shape[1]} planes, {across:.0f} pixels across the pupil.",
        f"Residual {case.residual_rms_nm:.1f} nm rms on the grid of the light, {case.found.error_nm:.1f} nm on the "
        f"pixels; Strehl {case.strehl_before:.2g} before, {case.strehl_after:.2f} after.",
        f"{case.found.sentence[:1].upper()}{case.found.sentence[1:]}.",
    ]
