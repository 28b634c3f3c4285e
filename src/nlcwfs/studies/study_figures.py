"""The figures that a study asks for, drawn from its table."""

from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from nlcwfs.interop import atomic_write
from nlcwfs.studies.accelerator_figures import draw_convergence, draw_light_and_turbulence
from nlcwfs.studies.method_figures import draw_calibration, draw_cost
from nlcwfs.studies.study_cases import Study
from nlcwfs.studies.study_table import Row, StudyTable

FIGURES: dict[str, tuple[Callable[[list[Row]], Figure | None], str]] = {
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
    "calibration": (
        draw_calibration,
        "Error over predicted error, rms over the screens that are believed: 1 is honest, more is too proud. Left: "
        "the most likely wavefront, whole and by the spatial frequency of the modes. Right: every method, whole.",
    ),
}
"""What draws a figure, None where its rows are missing, and its caption."""


def draw_figures(folder: Path, study: Study, table: StudyTable) -> dict[str, str]:
    """Draw every figure of a study whose rows are there.

    Returns:
        The caption of each picture, by file name.
    """
    captions = {}
    for name in study.figures:
        draw, caption = FIGURES[name]
        figure = draw(table.rows)
        if figure is None:
            continue
        with atomic_write(folder / f"{name}.png") as temporary:
            figure.savefig(temporary, dpi=150, format="png")
        captions[f"{name}.png"] = caption
    return captions
