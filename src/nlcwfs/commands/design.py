"""`nlcwfs design`: propose planes, pixels and rate, and write them down ready for the loop."""

from collections.abc import Sequence
from pathlib import Path

import astropy.units as u
from astropy.table import Table
from rich.console import Console

from nlcwfs.commands.console import device, make_folder, say, undisturbed
from nlcwfs.config import Config, to_toml
from nlcwfs.interop import Provenance, atomic_write
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.design.design import Design
from nlcwfs.simulation.design.design import design as propose
from nlcwfs.simulation.design.loop_errors import LoopErrors
from nlcwfs.simulation.design.requirements import Wishes

SETTINGS, TABLE, FIGURE = "design.toml", "design.ecsv", "design.png"
"""Files of a design's folder."""


def design(config: Config, wishes: Wishes, out: Path, *, quiet: bool) -> int:
    """Design a sensor and write settings, table and figure.

    Returns:
        Exit code, 0.

    Raises:
        NlcwfsError: If a requirement cannot be met, or the folder cannot be written.
    """
    make_folder(out)
    console = Console(stderr=True)
    with console.status("Designing ...") as status:
        found = propose(config, pupil_of(config), wishes, lambda line: status.update(f"Designing: {line} ..."))
    with undisturbed():
        for line in account(found):
            say(line, quiet=quiet)
        _write(found, out, Provenance.collect(config.model_dump(mode="json"), seed=config.seed, device=device()))
    say(f"Wrote {out / SETTINGS}, {TABLE} and {FIGURE}; next: nlcwfs loop {out / SETTINGS}", quiet=quiet)
    return 0


def account(found: Design) -> list[str]:
    """What a design says of itself."""
    errors, sensor, detector = found.errors, found.config.curvature_sensor, found.config.detector
    window_m = found.config.beam.diameter_m * detector.window_pixels / detector.pixels_across_pupil
    split = "shared evenly" if sensor.flux_fractions is None else f"shared {list(sensor.flux_fractions)}"
    lines = [
        f"Planes {', '.join(f'{one:g}' for one in sensor.distances_km)} km, light {split}; "
        f"{errors.rate_hz:g} exposures a second of {found.photons_per_frame:.3g} photons.",
        f"Expected {1e9 * errors.total_m:.1f} nm rms: mirror ({found.modes} modes) {1e9 * errors.fitting_m:.1f}, "
        f"lag {1e9 * errors.lag_m:.1f}, photons {1e9 * errors.photon_m:.1f} ({errors.loss:.1f} times those of the "
        f"quantum limit, which leaves {1e9 * errors.quantum_m:.1f}; with it {1e9 * errors.floor_m:.1f} in all).",
        f"Pixels: {detector.pixels_across_pupil} across the pupil, window {detector.window_pixels} ({window_m:.3g} m). "
        f"All light up to the mirror's finest wave needs {found.law.window_m:.3g} m, two pixels to each speckle "
        f"{found.law.pixels_across_pupil} across.",
    ]
    for name, choices in (("pixels across", found.pixels), ("window pixels", found.windows)):
        told = ", ".join(
            f"{one.pixels.across if name == 'pixels across' else one.pixels.window}: {1e9 * one.errors.total_m:.1f} nm"
            for one in choices
        )
        lines.append(f"Expected with other {name}: {told}.")
    if found.as_set is not None and found.as_set[0] != found.planes:
        planes, as_set = found.as_set
        away = " and ".join(f"{one / 1e3:g}" for one in planes.distances_m)
        lines.append(
            f"The planes as set, {away} km on either side: {1e9 * as_set.total_m:.1f} nm, photons "
            f"{1e9 * as_set.photon_m:.1f}."
        )
    if found.blind_cpa:
        blind = ", ".join(f"{one:.2f}" for one in found.blind_cpa)
        lines.append(f"Flat wavefronts do not show waves of {blind} cycles per aperture; what a loop leaves does.")
    return lines


def rows(found: Design) -> list[dict[str, str | float | int]]:
    """Everything that was looked at, a row each; rms in nm."""
    detector = found.config.detector
    across, window = detector.pixels_across_pupil, detector.window_pixels

    def row(
        kind: str, planes: Sequence[float], errors: LoopErrors, across: int = across, window: int = window
    ) -> dict[str, str | float | int]:
        return {
            "kind": kind,
            "distances_km": " ".join(f"{one / 1e3:g}" for one in planes),
            "pixels_across_pupil": across,
            "window_pixels": window,
            "rate_hz": errors.rate_hz,
            "expected_nm": round(1e9 * errors.total_m, 3),
            "fitting_nm": round(1e9 * errors.fitting_m, 3),
            "lag_nm": round(1e9 * errors.lag_m, 3),
            "photon_nm": round(1e9 * errors.photon_m, 3),
            "quantum_nm": round(1e9 * errors.quantum_m, 3),
        }

    away_m = found.planes.distances_m
    told = [row("design", away_m, found.errors)]
    if found.as_set is not None:
        told.append(row("as set", found.as_set[0].distances_m, found.as_set[1]))
    told += [row("rate", away_m, errors) for errors in found.rates]
    told += [row("one pair", (distance_m,), errors) for distance_m, errors in found.single]
    for kind, choices in (("pixels", found.pixels), ("window", found.windows)):
        told += [row(kind, away_m, one.errors, one.pixels.across, one.pixels.window) for one in choices]
    return told


def _write(found: Design, out: Path, stamp: Provenance) -> None:
    from nlcwfs.studies.design_picture import draw_design

    with atomic_write(out / SETTINGS) as temporary:
        temporary.write_text(to_toml(found.config), encoding="utf-8")
    told = rows(found)
    units = {name: u.nm for name in told[0] if name.endswith("_nm")}
    table = Table(rows=told, units=units, meta={"provenance": stamp.as_dict()})
    with atomic_write(out / TABLE) as temporary:
        table.write(temporary, format="ascii.ecsv")
    figure = draw_design(found)
    with atomic_write(out / FIGURE) as temporary:
        figure.savefig(temporary, dpi=120)
