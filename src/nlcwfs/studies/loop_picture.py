"""One picture of a run of the loop: the residual in time, where it is, and the star's image."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.interop.atomic_write import atomic_write
from nlcwfs.simulation.closed_loop.loop import GROUPS, Loop, LoopState, Record
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, counted_from


def draw_loop(path: Path, loop: Loop, state: LoopState, records: list[Record], *, floor_nm: float) -> None:
    """Draw a run.

    Args:
        path: PNG to write.
        loop: The loop.
        state: Where it ended.
        records: What was recorded.
        floor_nm: Bound to draw beside the residual.
    """
    told = LoopTelemetry.of(records)
    time_s = np.arange(len(records)) / loop.config.loop.rate_hz
    figure = Figure(figsize=(11, 7), layout="constrained")
    cells = figure.add_gridspec(2, 2, height_ratios=(1, 1.1), width_ratios=(1.3, 1))
    top, left, right = (figure.add_subplot(cells[place]) for place in ((0, slice(None)), (1, 0), (1, 1)))
    top.semilogy(time_s, told.rms_nm, color="black", lw=1, label="residual")
    top.axhline(floor_nm, color="gray", ls="--", lw=1, label="mirror, lag and quantum limit")
    first = counted_from(loop, state)
    if first < len(records):
        top.axvspan(time_s[first], time_s[-1], color="tab:blue", alpha=0.08, label="counted")
    doubted = ~told.closed
    top.semilogy(time_s[doubted], told.rms_nm[doubted], "o", ms=3, color="tab:orange", label="not followed")
    top.set(xlabel="time [s]", ylabel="rms [nm]", title=f"{loop.config.loop.rate_hz:g} Hz")
    top.legend(fontsize=8, ncols=4)
    for place, name in enumerate(GROUPS):
        if not told.group_nm[:, place].any():
            continue
        left.semilogy(time_s, np.maximum(told.group_nm[:, place], 0.1), lw=1, label=name.replace("_", "-"))
    left.set(xlabel="time [s]", ylabel="rms by group [nm]")
    left.legend(fontsize=8, ncols=2)
    image = np.asarray(state.image.image)
    if np.isfinite(image).all():
        half = image.shape[0] / 2 * state.image.angles.pixel_m / ARCSEC_RAD
        shown = right.imshow(
            np.log10(np.maximum(image, 1e-6)), origin="lower", cmap="inferno", extent=(-half, half, -half, half)
        )
        right.set(
            xlabel="arcsec", title=f"Strehl {float(state.image.strehl):.2f} at {state.image.wavelength_m * 1e6:g} um"
        )
        figure.colorbar(shown, ax=right, label="log10 of the perfect peak")
    else:
        right.set_axis_off()
        right.text(0.5, 0.5, "never settled", ha="center")
    with atomic_write(path) as name:
        figure.savefig(name, dpi=120)
