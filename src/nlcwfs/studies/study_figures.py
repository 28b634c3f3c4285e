"""The figures that a study asks for, drawn from its table."""

from collections.abc import Callable, Iterable
from pathlib import Path

from matplotlib.figure import Figure

from nlcwfs.interop import atomic_write
from nlcwfs.studies.accelerator_figures import draw_convergence, draw_light_and_turbulence
from nlcwfs.studies.colour_figures import draw_colours_for_lenses
from nlcwfs.studies.method_figures import draw_calibration, draw_cost
from nlcwfs.studies.segment_figures import draw_segments
from nlcwfs.studies.sky_figures import draw_sky_budgets
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.turn_figures import draw_turns

Drawings = dict[str, tuple[Callable[[list[Row]], Figure | None], str]]
"""What draws a figure, None where its rows are missing, and its caption, by its name."""

FIGURES: Drawings = {
    "convergence": (
        draw_convergence,
        "Captured screens and median error against the FFTs of one plane: D/r0 = 8.2, 2e4 photons, 45 pixels, "
        "light on a grid four times finer. Dashed line: photon bound (Bayesian Cramer-Rao) for the same light.",
    ),
    "photons-and-turbulence": (
        draw_light_and_turbulence,
        "Median error (bars: 5 to 95 % of the screens) against photons at D/r0 = 8.2, and against the rms of the "
        "wavefront at 2e4 photons. Dashed: photon bounds (Bayesian Cramer-Rao) for the same light.",
    ),
    "cost": (
        draw_cost,
        "Error of the mean over each detector pixel (median; bands: 16 to 84 % of the screens) and share of the "
        "screens that are captured, against FFTs of one plane for each frame: D/r0 = 8.2, 45 pixels, light on a "
        "grid four times finer. Dashed: photon bound (Bayesian Cramer-Rao); dotted: quantum limit.",
    ),
    "segments": (
        draw_segments,
        "Error of the pistons of segments modulo the wavelength, and inside the segments (piston of each removed), "
        "against iterations of Gerchberg-Saxton: median, and up to the worst screen. 2e8 photons at 0.65 um, pistons "
        "drawn evenly within half a wave, turbulence of 100 nm rms, light on a grid four times finer than the pixels.",
    ),
    "turns": (
        draw_turns,
        "Whole wavelengths of the steps between segments, one exposure at 0.65 um, steps up to two waves. Left: share "
        "of the trials that are right against photons, band of half the wavelength. Middle: against the band, 1e5 "
        "photons. Right: share that is wrong against the probability that the estimates tell, a point a row of the "
        "table; below 1e-4 at the rim. Bars: Wilson's intervals of 95 %.",
    ),
    "sky-budgets": (
        draw_sky_budgets,
        "Error of the mean over each detector pixel, over that of a steady point without dispersion: median and 16 to "
        "84 % of the skies; the gray line is a tenth more. Open: the model is told. Dashed, and dotted where it "
        "is told: closed forms, added in quadrature.",
    ),
    "colours-for-lenses": (
        draw_colours_for_lenses,
        "Error over that in light of one wavelength with as many photons, against the wavelengths in the model: median "
        "and 16 to 84 % of the skies. Right: FFTs of a frame, a band of 40 % without chromatic lenses.",
    ),
    "calibration": (
        draw_calibration,
        "Error over predicted error, rms over the screens that are believed: 1 is honest, more is too proud. Left: "
        "the most likely wavefront, whole and by the spatial frequency of the modes. Right: every method, whole.",
    ),
}
"""The figures of `nlcwfs study`."""


def draw_figures(folder: Path, names: Iterable[str], rows: list[Row], drawings: Drawings) -> dict[str, str]:
    """Draw the figures whose rows are there.

    Args:
        folder: Where the pictures go.
        names: The figures that a study asks for.
        rows: Of its table.
        drawings: What there is to draw, `FIGURES` or that of sweeps.

    Returns:
        The caption of each picture, by file name.
    """
    captions = {}
    for name in names:
        draw, caption = drawings[name]
        figure = draw(rows)
        if figure is None:
            continue
        with atomic_write(folder / f"{name}.png") as temporary:
            figure.savefig(temporary, dpi=150, format="png")
        captions[f"{name}.png"] = caption
    return captions
