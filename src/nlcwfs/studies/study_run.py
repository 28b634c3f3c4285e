"""Running a study: for every case, many screens through light, detector and reconstructor, scored on the fine grid."""

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import light_weights
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.detector.read import Detector
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.reconstructor import TYPICAL_SEEING_ARCSEC, GerchbergSaxton
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.interop import Provenance
from nlcwfs.simulation.exposure import (
    ExposureSimulator,
    _lit_part,
    distances_m,
    frame_key,
    seeing_arcsec,
    turbulence,
    wavelength_m,
)
from nlcwfs.simulation.score import wavefront_error_m
from nlcwfs.studies.case_bound import LightInformation, case_bound, light_information
from nlcwfs.studies.study_cases import Case, read_study
from nlcwfs.studies.study_table import Row, StudyTable

Progress = Callable[[str, int, int], None]
"""Called with the case, the screens done and the screens in all."""


class Screen(NamedTuple):
    """One exposure, kept while the cases that share it run.

    Attributes:
        truth_m: The wavefront on the grid that scores it.
        counts: What the detector read, photo-electrons.
    """

    truth_m: Float[np.ndarray, "Y X"]
    counts: Float[np.ndarray, "plane y x"]


class Light(NamedTuple):
    """All the screens of one kind of light.

    Attributes:
        screens: The exposures.
        grid: Grid of the truth.
        weights: Share of the light in its cells.
    """

    screens: list[Screen]
    grid: Grid
    weights: Float[np.ndarray, "Y X"]


def run_study(
    folder: Path, *, progress: Progress, only: tuple[str, ...] = (), screens: int | None = None
) -> StudyTable:
    """Run what the table of a study does not hold yet.

    Args:
        folder: Holds `study.toml`; the table goes beside it.
        progress: Called after each screen.
        only: Run only the cases whose names start so.
        screens: Replaces the number of screens, for a quick look; such rows do not pass as the study's.

    Returns:
        The table, also on disk as `results.ecsv`.

    Raises:
        FileFormatError: If the study's file is missing or wrong.
        SettingsError: If a case is impossible.
    """
    study = read_study(folder)
    configs = {case.name: study.config_of(case) for case in study.case}
    table = StudyTable(folder / "results.ecsv")
    seeds = {config.seed for config in configs.values()}
    seed = seeds.pop() if len(seeds) == 1 else None  # cases may each have their own: it is in their settings
    stamp = Provenance.collect(study.model_dump(mode="json"), seed=seed, device=jax.devices()[0].device_kind)
    lights: dict[str, Light] = {}
    bounds: dict[str, LightInformation] = {}
    for case in study.case:
        if only and not case.name.startswith(only):
            continue
        config, count = configs[case.name], screens or study.screens_of(case)
        digest = _digest(case, config, count, study.captured_nm)
        if table.holds(case.name, digest):
            continue
        kind = _light_kind(case, config, count)
        if kind not in lights:
            lights.clear()  # one kind at a time: memory
            lights[kind] = make_light(case, config, count, progress)
        row = run_case(case, config, study.captured_nm, lights[kind], progress)
        row |= _bound_columns(case, config, bounds)
        table.put({"case": case.name, "group": case.group} | row | {"commit": stamp.commit, "digest": digest}, stamp)
    if not only and table.rows:
        table.sort([case.name for case in study.case], stamp)
    return table


def make_light(case: Case, config: Config, count: int, progress: Progress) -> Light:
    """Expose the detector to `count` skies."""
    simulator = ExposureSimulator.build(config)
    cut = _lit_part(np.asarray(simulator.weights))
    weights = np.asarray(simulator.weights, float)[cut]
    grid = simulator.light.padded(weights.shape)
    matched = matched_model(config, simulator) if case.light == "matched" else None
    screens = []
    for number in range(count):
        exposure = simulator.expose(frame_key(seed=config.seed, frame=number))
        truth_m = np.asarray(exposure.opd_m)[cut]
        counts = np.asarray(exposure.frames.electrons)
        if matched is not None:
            truth_m = np.nan_to_num(np.asarray(exposure.truth_m))
            photons = matched.images(jnp.asarray(truth_m), config.atmosphere.photons).photons
            key = jax.random.fold_in(frame_key(seed=config.seed, frame=number), 1)
            counts = np.asarray(simulator.detector.read(photons, key).electrons)
        screens.append(Screen(truth_m, counts - simulator.detector.background_electrons))
        progress(f"{case.name}: light", number + 1, count)
    if matched is not None:
        return Light(screens, simulator.frame, light_weights(np.asarray(matched.pupil)))
    return Light(screens, grid, weights)


def matched_model(config: Config, simulator: ExposureSimulator) -> CurvatureSensor:
    """The sensor on the grid of the reconstructor: the inverse crime, to show what it flatters."""
    return geometry_of(config, simulator).model(simulator.frame, dtype="float32")


def geometry_of(config: Config, simulator: ExposureSimulator) -> SensorGeometry:
    """What the reconstructor knows of the sensor."""
    return SensorGeometry(
        pupil=simulator.shape,
        frame=simulator.frame,
        wavelength_m=wavelength_m(config),
        distances_m=distances_m(config),
        flux_fractions=config.curvature_sensor.flux_fractions,
    )


def build_solver(case: Case, config: Config) -> tuple[GerchbergSaxton, Grid]:
    """The reconstructor of a case, and the pixels of its frames."""
    simulator = ExposureSimulator.build(config)
    geometry, settings = geometry_of(config, simulator), config.estimation
    if case.strength == "known":
        settings = settings.model_copy(update={"seeing_arcsec": seeing_arcsec(simulator.air)})
    basis = None
    if settings.unwrapping == "slopes":
        pupil = simulator.shape.on(geometry.frame)
        basis = modal_basis(pupil, geometry.frame, diameter_m=geometry.pupil.diameter_m, count=settings.modes)
    return GerchbergSaxton.build(geometry, settings, basis=basis), geometry.frame


def run_case(case: Case, config: Config, captured_nm: float, light: Light, progress: Progress) -> Row:
    """Reconstruct all the screens of a case and sum up."""
    solver, frame = build_solver(case, config)
    camera = config.detector
    read_variance = camera.read_noise_electrons**2 / camera.em_gain**2 + Detector(camera).background_electrons

    @eqx.filter_jit
    def reconstruct(solver: GerchbergSaxton, counts: Float[Array, "plane y x"]):
        return solver.estimate(counts, jnp.ones(counts.shape, bool), read_variance=read_variance)

    error_nm, ffts, iterations, predicted_nm, codes, strengths = [], [], [], [], [], []
    for number, screen in enumerate(light.screens):
        found = reconstruct(solver, jnp.asarray(screen.counts))
        opd_m = np.asarray(found.opd_m, float)
        error_nm.append(1e9 * wavefront_error_m(opd_m, frame, screen.truth_m, light.weights, light.grid))
        ffts.append(int(found.ffts))
        iterations.append(int(found.iterations))
        predicted_nm.append(1e9 * float(found.predicted_error_m))
        codes.append(Outcome(int(found.outcome_code)))
        strengths.append(float(found.strength))
        progress(case.name, number + 1, len(light.screens))
    return _summary(np.array(error_nm), captured_nm) | {
        "ffts": float(np.median(ffts)),
        "iterations": float(np.median(iterations)),
        "predicted_nm": round(float(np.median(predicted_nm)), 2),
        "believed": float(np.mean([code.succeeded for code in codes])),
        "believed_wrong": float(
            np.mean([c.succeeded and not e < captured_nm for c, e in zip(codes, error_nm, strict=True)])
        ),
        "doubted_right": float(
            np.mean([not c.succeeded and e < captured_nm for c, e in zip(codes, error_nm, strict=True)])
        ),
        **_sky_columns(case, config, strengths),
    }


def _summary(error_nm: Float[np.ndarray, " screen"], captured_nm: float) -> Row:
    """Statistics over the screens; an estimate that is not finite counts as lost."""
    error_nm = np.where(np.isfinite(error_nm), error_nm, 1e6)
    captured = error_nm < captured_nm
    percentiles = np.percentile(error_nm, [5, 16, 50, 84, 95])
    names = ("p5_nm", "p16_nm", "median_nm", "p84_nm", "p95_nm")
    row: Row = {"screens": len(error_nm), "captured": float(captured.mean())}
    row |= {name: round(float(value), 2) for name, value in zip(names, percentiles, strict=True)}
    among = float(np.median(error_nm[captured])) if captured.any() else math.nan
    return row | {"median_captured_nm": round(among, 2)}


def _sky_columns(case: Case, config: Config, strengths: list[float]) -> Row:
    air = turbulence(config)
    telescope_over_fried = config.beam.diameter_m / air.fried_at(wavelength_m(config))
    options = config.estimation.gerchberg_saxton
    true_seeing = seeing_arcsec(air)
    untold = true_seeing if case.strength == "known" else TYPICAL_SEEING_ARCSEC
    reference = config.estimation.seeing_arcsec or untold
    return {
        "telescope_over_fried": round(telescope_over_fried, 3),
        "photons": config.atmosphere.photons,
        "pixels": config.detector.pixels_across_pupil,
        "window": config.detector.window_pixels,
        "light": case.light,
        "light_oversampling": 1 if case.light == "matched" else config.simulation.light_oversampling,
        "max_iterations": options.iterations,
        "strength_ratio": round(float(np.median(strengths)) * (reference / true_seeing) ** (5 / 3), 3),
    }


def _bound_columns(case: Case, config: Config, known: dict[str, LightInformation]) -> Row:
    if not case.bound:
        return {"bound_nm": math.nan, "quantum_nm": math.nan, "sensor_loss": math.nan}
    same = config.atmosphere.model_copy(update={"photons": 1.0})
    key = _light_kind(case, config.model_copy(update={"atmosphere": same}), 0)
    if key not in known:
        known.clear()
        known[key] = light_information(config)
    return dict(case_bound(config, known[key]))


def _light_kind(case: Case, config: Config, count: int) -> str:
    """Cases with the same text here share their light."""
    parts = config.model_dump(mode="json", exclude={"estimation"})
    return json.dumps([parts, case.light, count], sort_keys=True)


def _digest(case: Case, config: Config, count: int, captured_nm: float) -> str:
    content = json.dumps(
        [case.model_dump(mode="json"), config.model_dump(mode="json"), count, captured_nm], sort_keys=True
    )
    return hashlib.sha256(content.encode()).hexdigest()[:16]
