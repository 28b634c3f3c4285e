"""One picture of a design: the error against distance, rate and pixels, and what flat wavefronts show."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nlcwfs.simulation.design.blind_frequencies import flat_signal
from nlcwfs.simulation.design.design import Design
from nlcwfs.simulation.design.loop_errors import LoopErrors


def draw_design(found: Design) -> Figure:
    """Draw what a design looked at.

    Args:
        found: The design.
    """
    figure = Figure(figsize=(9.5, 6.6), layout="constrained")
    distance, rate, pixels, waves = figure.subplots(2, 2).ravel()
    away_km = np.array([distance_m / 1e3 for distance_m, _ in found.single])
    distance.semilogx(away_km, [1e9 * one.photon_m for _, one in found.single], "o-", ms=3, label="one pair")
    distance.axhline(1e9 * found.errors.photon_m, color="C1", lw=1, label="the design")
    if found.as_set is not None:
        distance.axhline(1e9 * found.as_set[1].photon_m, color="C2", lw=1, ls="--", label="planes as set")
    distance.axhline(1e9 * found.errors.quantum_m, color="0.5", lw=1, ls=":", label="quantum limit")
    for number, one in enumerate(found.planes.distances_m):
        distance.axvline(one / 1e3, color="C1", lw=0.8, ls="--", label=None if number else "its planes")
    ticks = [one * ten for ten in (1, 10, 100, 1000, 10000) for one in (1, 2, 3, 5)]
    shown = [tick for tick in ticks if away_km.min() * 0.9 < tick < away_km.max() * 1.1]
    distance.set_xticks(shown, [f"{tick:g}" for tick in shown])
    distance.minorticks_off()
    distance.set(xlabel="distance on either side [km]", ylabel="left by the photons [nm rms]")
    _errors(rate, [one.rate_hz for one in found.rates], found.rates)
    rate.set(xscale="log", xlabel="exposures a second", ylabel="expected [nm rms]", ylim=(0, None))
    rate.set_xticks([one.rate_hz for one in found.rates], [f"{one.rate_hz:.0f}" for one in found.rates])
    rate.minorticks_off()
    across = [one.pixels.across for one in found.pixels]
    pixels.plot(across, [1e9 * one.errors.total_m for one in found.pixels], "o-", ms=3, label="same window")
    wide = [one.pixels.window for one in found.windows]
    pixels.plot(
        [found.config.detector.pixels_across_pupil] * len(wide),
        [1e9 * one.errors.total_m for one in found.windows],
        "s",
        ms=4,
        color="C3",
        label=f"windows of {', '.join(map(str, wide))}",
    )
    pixels.set(xlabel="pixels across the pupil", ylabel="expected [nm rms]")
    _signals(waves, found)
    for axes in (distance, rate, pixels, waves):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    return figure


def _errors(axes: Axes, x: Sequence[float], errors: Sequence[LoopErrors]) -> None:
    axes.plot(x, [1e9 * one.total_m for one in errors], "o-", ms=3, color="black", label="all")
    for name in ("fitting", "lag", "photon", "quantum"):
        style = ":" if name == "quantum" else "-"
        axes.plot(x, [1e9 * getattr(one, f"{name}_m") for one in errors], style, lw=1, label=name)


def _signals(axes: Axes, found: Design) -> None:
    beam = found.config.beam
    light = {"wavelength_m": beam.wavelength_um * 1e-6, "diameter_m": beam.diameter_m}
    finest = 1.25 * max(found.law.window_m - beam.diameter_m, 0) * beam.diameter_m
    finest /= 2 * max(found.planes.distances_m) * light["wavelength_m"]
    cycles = np.linspace(0, finest, 800)
    axes.plot(cycles, flat_signal(cycles, found.planes.distances_m, **light), color="C1", lw=1.2, label="the design")
    if found.as_set is not None:
        axes.plot(
            cycles, flat_signal(cycles, found.as_set[0].distances_m, **light), "--", color="C2", lw=1, label="as set"
        )
    axes.set(xlabel="cycles per aperture", ylabel="signal of a flat wavefront", ylim=(0, 1.25))
