"""Pictures: light in a perceptual map, phase in a cyclic one, small errors in a diverging one; y grows upwards."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle

from nlcwfs.beam.grid import Grid
from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.interop.atomic_write import atomic_write
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_reconstruction import rms_m
from nlcwfs.interop.frames_sensor import pupil_on_frame, scored_pupil, sensor_geometry
from nlcwfs.interop.wavefront_file import WavefrontFile
from nlcwfs.science.point_spread_function import point_spread_function, strehl_ratio
from nlcwfs.studies.board import Board
from nlcwfs.studies.single_frame import PSF_PIXELS, PSF_WIDTH, SingleFrame

INTENSITY, PHASE, HEIGHT, ERROR = "inferno", "twilight", "viridis", "RdBu_r"
PHASE_TICKS = {-np.pi: "\N{MINUS SIGN}π", 0.0: "0", np.pi: "π"}

FAINTEST = 1e-4
"""Images of the star are drawn down to this part of the peak of a perfect telescope."""


def save_picture(figure: Figure, path: Path) -> None:
    """Write a picture, whole or not at all; the ending of its name is its format.

    Raises:
        FileFormatError: If it cannot be written.
    """
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=160, format=path.suffix.lower().lstrip("."))


def draw_single_frame(case: SingleFrame) -> Figure:
    """The paper's figure: frames (a-d), wavefront (e), star before (f), residual (g), star after (h).

    With another number of planes the upper row has as many panels, and the letters go on from there.
    """
    frames, letters = case.frames, _letters()
    board = Board(rows=2, columns=max(4, frames.electrons.shape[1]))
    _draw_frames(board, frames, 0, letters)
    wavelength_m, width_m = frames.wavelength_m, case.light.pixel_m
    phase_rad = np.angle(np.exp(2j * np.pi / wavelength_m * case.opd_m))
    panel = board.panel(1, 0)
    image = _draw_pupil(panel, phase_rad, width_m, PHASE, np.pi)
    _title(panel, f"({next(letters)}) wavefront, {case.rms_nm:.0f} nm rms")
    board.bar(image, 1, 0, f"phase at {_um(wavelength_m)}, rad", ticks=PHASE_TICKS)
    psf = _draw_psf(board.panel(1, 1), case.psf_before, case.psf_pixel_rad)
    _title(board.panel(1, 1), f"({next(letters)}) star before, Strehl {case.strehl_before:.2g}")
    board.bar(psf, 1, 1, "light over the perfect peak")
    panel = board.panel(1, 2)
    image = _draw_pupil(panel, case.residual_m * 1e9, width_m, ERROR, _limit(case.residual_m * 1e9))
    _title(panel, f"({next(letters)}) residual, {case.residual_rms_nm:.1f} nm rms")
    board.bar(image, 1, 2, "true - found, nm")
    psf = _draw_psf(board.panel(1, 3), case.psf_after, case.psf_pixel_rad)
    _title(board.panel(1, 3), f"({next(letters)}) star after, Strehl {case.strehl_after:.2f}")
    board.bar(psf, 1, 3, "light over the perfect peak")
    return board.figure


def draw_reconstruction(frames: FramesFile, wavefront: WavefrontFile, number: int) -> Figure:
    """Frames, what the model leaves of them, and the wavefront; with the true one also its error.

    Args:
        frames: The file.
        wavefront: What was found in it.
        number: Which frame to draw, from 0.
    """
    truth_m = None
    if frames.truth_m is not None:
        truth_m = frames.truth_m if frames.truth_m.ndim == 2 else frames.truth_m[number]
    letters = _letters()
    board = Board(rows=3, columns=max(3 if truth_m is None else 4, frames.electrons.shape[1]))
    _draw_frames(board, frames, number, letters)
    _draw_residuals(board, frames, wavefront, number, letters)
    opd_m, width_m = wavefront.opd_m[number], frames.pixel_m
    panel = board.panel(2, 0)
    image = _draw_pupil(panel, opd_m * 1e9, width_m, HEIGHT, None)
    _title(panel, f"({next(letters)}) wavefront, {wavefront.rms_nm[number]:.0f} nm rms")
    board.bar(image, 2, 0, "optical path difference, nm")
    if truth_m is None:
        phase_rad = np.angle(np.exp(2j * np.pi / frames.wavelength_m * opd_m))
        panel = board.panel(2, 1)
        image = _draw_pupil(panel, phase_rad, width_m, PHASE, np.pi)
        _title(panel, f"({next(letters)}) the same, wrapped")
        board.bar(image, 2, 1, f"phase at {_um(frames.wavelength_m)}, rad", ticks=PHASE_TICKS)
        _draw_star(board, 2, "star behind it", opd_m, frames, letters)
        return board.figure
    _draw_star(board, 1, "star before", truth_m, frames, letters)
    error_m = truth_m - opd_m
    error_m = error_m - np.nanmean(error_m)
    panel = board.panel(2, 2)
    image = _draw_pupil(panel, error_m * 1e9, width_m, ERROR, _limit(error_m * 1e9))
    light = scored_pupil(sensor_geometry(frames)) ** 2
    _title(panel, f"({next(letters)}) residual, {rms_m(error_m, light) * 1e9:.1f} nm rms")
    board.bar(image, 2, 2, "true - found, nm")
    _draw_star(board, 3, "star after", error_m, frames, letters)
    return board.figure


def _letters() -> Iterator[str]:
    """a, b, ..., z, a2, b2, ..."""
    for turn in itertools.count(1):
        for letter in "abcdefghijklmnopqrstuvwxyz":
            yield letter if turn == 1 else f"{letter}{turn}"


def _draw_frames(board: Board, frames: FramesFile, number: int, letters: Iterator[str]) -> None:
    counts = np.where(frames.masked[number], np.nan, frames.photo_electrons()[number])
    top = max(float(np.nanpercentile(counts, 99.7)), 1e-3)
    for column, (plane, distance_m) in enumerate(zip(counts, frames.distances_m, strict=True)):
        panel = board.panel(0, column)
        image = _draw_plane(panel, plane, INTENSITY, 0.0, top)
        _title(panel, f"({next(letters)}) z = {_km(distance_m)}")
        _outline(panel, frames, "white")
        if column == 0:
            board.bar(image, 0, 0, "photo-electrons in a pixel", last=len(counts) - 1)
    _scale(board.panel(0, 0), frames.diameter_m / frames.pixel_m, f"{frames.diameter_m:g} m", "white")


def _draw_residuals(
    board: Board, frames: FramesFile, wavefront: WavefrontFile, number: int, letters: Iterator[str]
) -> None:
    if wavefront.residual is None:
        return
    residual = wavefront.residual[number]
    top = _limit(residual)
    for column, plane in enumerate(residual):
        panel = board.panel(1, column)
        image = _draw_plane(panel, plane, ERROR, -top, top)
        _title(panel, f"({next(letters)}) frame - model, {_km(frames.distances_m[column])}")
        _outline(panel, frames, "black")
        if column == 0:
            board.bar(image, 1, 0, "photo-electrons in a pixel", last=len(residual) - 1)


def _draw_plane(
    panel: Axes, values: Float[np.ndarray, "y x"], colours: str, low: float | None, high: float | None
) -> AxesImage:
    image = panel.imshow(values, origin="lower", cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    panel.set_facecolor("0.75")
    panel.set_xticks([])
    panel.set_yticks([])
    for side in panel.spines.values():
        side.set_linewidth(0.5)
    return image


def _draw_pupil(
    panel: Axes, values: Float[np.ndarray, "y x"], pixel_m: float, colours: str, limit: float | None
) -> AxesImage:
    """Something on the pupil, cut to the pupil and a rim; symmetric about zero if there is a limit."""
    reach = _half_width(np.isfinite(values))
    values = _middle(values, reach)
    image = _draw_plane(panel, values, colours, None if limit is None else -limit, limit)
    panel.set_facecolor("white")
    bar_m = _round_length(reach * pixel_m / 2)
    _scale(panel, bar_m / pixel_m, f"{bar_m:g} m", "black")
    return image


def _draw_psf(panel: Axes, psf: Float[np.ndarray, "v u"], pixel_rad: float) -> AxesImage:
    image = panel.imshow(
        np.maximum(psf, FAINTEST), origin="lower", cmap=INTENSITY, norm=LogNorm(FAINTEST, 1), interpolation="nearest"
    )
    panel.set_xticks([])
    panel.set_yticks([])
    width_arcsec = len(psf) * pixel_rad / ARCSEC_RAD
    bar_arcsec = _round_length(width_arcsec / 4)
    _scale(panel, bar_arcsec * ARCSEC_RAD / pixel_rad, f'{bar_arcsec:g}"', "white")
    return image


def _draw_star(
    board: Board, column: int, name: str, opd_m: Float[np.ndarray, "y x"], frames: FramesFile, letters: Iterator[str]
) -> None:
    """The star through a wavefront that is known on the frames' pixels."""
    geometry = sensor_geometry(frames)
    pupil = np.where(np.isfinite(opd_m), pupil_on_frame(geometry), 0)
    filled = jnp.asarray(np.nan_to_num(opd_m))
    angle_rad = frames.wavelength_m / frames.diameter_m * PSF_WIDTH / PSF_PIXELS
    angles = Grid((PSF_PIXELS + 1, PSF_PIXELS + 1), angle_rad)
    light = {"wavelength_m": frames.wavelength_m}
    psf = point_spread_function(pupil, filled, pixel_m=frames.pixel_m, angles=angles, **light)
    panel = board.panel(2, column)
    image = _draw_psf(panel, np.asarray(psf, float), angle_rad)
    _title(panel, f"({next(letters)}) {name}, Strehl {float(strehl_ratio(pupil, filled, **light)):.2g}")
    board.bar(image, 2, column, "light over the perfect peak")


def _title(panel: Axes, text: str) -> None:
    panel.set_title(text, fontsize=9, pad=4)


def _outline(panel: Axes, frames: FramesFile, colour: str) -> None:
    """The pupil in focus, thin: how far the light has spread."""
    centre = ((frames.electrons.shape[3] - 1) / 2, (frames.electrons.shape[2] - 1) / 2)
    radius = frames.diameter_m / frames.pixel_m / 2
    panel.add_patch(Circle(centre, radius, fill=False, linewidth=0.5, linestyle=(0, (4, 3)), edgecolor=colour))


def _scale(panel: Axes, pixels: float, label: str, colour: str) -> None:
    """A bar of known length in the lower left corner."""
    left, right = panel.get_xlim()
    bottom, top = panel.get_ylim()
    x, y = left + 0.05 * (right - left), bottom + 0.05 * (top - bottom)
    panel.plot([x, x + pixels], [y, y], color=colour, linewidth=1.6, solid_capstyle="butt")
    panel.text(x + pixels / 2, y + 0.02 * (top - bottom), label, color=colour, fontsize=7.5, ha="center", va="bottom")
    panel.set_xlim(left, right)
    panel.set_ylim(bottom, top)


def _middle(values: Float[np.ndarray, "y x"], reach: int) -> Float[np.ndarray, "v u"]:
    rows, columns = ((max(size // 2 - reach, 0), min((size + 1) // 2 + reach, size)) for size in values.shape)
    return values[rows[0] : rows[1], columns[0] : columns[1]]


def _half_width(lit: np.ndarray) -> int:
    """Pixels from the centre of the array to the rim of what is lit, and 6 % more."""
    reach = max(
        max(size / 2 - index.min(), index.max() + 1 - size / 2)
        for size, index in zip(lit.shape, np.nonzero(lit), strict=True)
    )
    return int(np.ceil(1.06 * reach))


def _limit(values: np.ndarray) -> float:
    """A symmetric range that shows all but the wildest half per cent."""
    return max(float(np.nanpercentile(np.abs(values), 99.5)), 1e-12)


def _round_length(length: float) -> float:
    """The nearest of 1, 2 and 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (5, 2, 1) if step * power <= length * (1 + 1e-9)))


def _km(distance_m: float) -> str:
    return f"{distance_m / 1e3:+g} km".replace("-", "\N{MINUS SIGN}")


def _um(wavelength_m: float) -> str:
    return f"{wavelength_m * 1e6:.4g} µm"
