"""One case of a study: every screen reconstructed and scored, and the numbers of its row."""

import math
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.config import Config
from nlcwfs.detector.read import Detector
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.method import Reconstructor, build_reconstructor
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.reconstructor import TYPICAL_SEEING_ARCSEC
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.unwrapping_basis import unwrapping_basis
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.interop.frames_reconstruction import rms_m
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.exposure import ExposureSimulator, seeing_arcsec, turbulence, wavelength_m
from nlcwfs.simulation.known_sensor import geometry_of
from nlcwfs.simulation.score import wavefront_error_m
from nlcwfs.simulation.segment_score import SegmentScore
from nlcwfs.studies.mode_calibration import GROUPS_CPA, ModeErrors
from nlcwfs.studies.step_columns import step_columns, step_errors, steps_captured
from nlcwfs.studies.study_cases import Capture, Case
from nlcwfs.studies.study_light import Light, Progress, Screen
from nlcwfs.studies.study_table import Row

LOST_NM = 1e6
"""Error of an estimate that is not finite."""


class Scored(NamedTuple):
    """What became of one screen.

    Attributes:
        fine_nm: Error on the grid of the light.
        pixels_nm: Error of the mean over every detector pixel.
        predicted_nm: Error that the estimate expects.
        outcome: How it ended.
        ffts: FFTs of one plane.
        iterations: As the estimate counts them.
        strength: Of the turbulence, as the estimate tells it.
        milliseconds: Time that it took.
        groups: Squares of the errors of the modes over what was told, by group; NaN where nothing was told.
        steps: Errors of and inside the segments of the pupil; None for one piece.
    """

    fine_nm: float
    pixels_nm: float
    predicted_nm: float
    outcome: Outcome
    ffts: int
    iterations: int
    strength: float
    milliseconds: float
    groups: dict[str, float]
    steps: SegmentScore | None = None


def build_solver(case: Case, config: Config) -> tuple[Reconstructor, SensorGeometry]:
    """The reconstructor of a case, and what it knows of the sensor."""
    simulator = ExposureSimulator.build(config, pupil_of(config))
    geometry, settings = geometry_of(config, simulator), config.estimation
    if case.strength == "known":
        settings = settings.model_copy(update={"seeing_arcsec": seeing_arcsec(simulator.air)})
    basis = None
    if settings.method == "gerchberg-saxton" and settings.unwrapping == "slopes":
        basis = unwrapping_basis(geometry, simulator.shape.on(geometry.frame), modes=settings.modes)
    return build_reconstructor(geometry, settings, basis=basis), geometry


def run_case(case: Case, config: Config, capture: Capture, light: Light, progress: Progress) -> Row:
    """Reconstruct all the screens of a case and sum up."""
    solver, geometry = build_solver(case, config)
    read_variance = Detector(config.detector).variance_without_light
    modes = ModeErrors.of(solver) if isinstance(solver, MaximumAPosteriori) else None

    @eqx.filter_jit
    def reconstruct(solver: Reconstructor, counts: Float[Array, "plane y x"]) -> WavefrontEstimate:
        return solver.estimate(counts, jnp.ones(counts.shape, bool), read_variance=read_variance)

    jax.block_until_ready(reconstruct(solver, jnp.asarray(light.screens[0].counts)))  # compiles: not timed
    scored = []
    for number, screen in enumerate(light.screens):
        counts = jax.block_until_ready(jnp.asarray(screen.counts))
        begun_s = time.perf_counter()
        found = jax.block_until_ready(reconstruct(solver, counts))
        milliseconds = 1e3 * (time.perf_counter() - begun_s)
        scored.append(_scored(found, screen, light, geometry, modes)._replace(milliseconds=milliseconds))
        progress(case.name, number + 1, len(light.screens))
    return _summed_up(scored, capture) | _sky_columns(case, config, [one.strength for one in scored])


def _scored(
    found: WavefrontEstimate, screen: Screen, light: Light, geometry: SensorGeometry, modes: ModeErrors | None
) -> Scored:
    """Compare an estimate with the truth; an error that is not finite counts as `LOST_NM`."""
    opd_m = np.asarray(found.opd_m, float)
    fine_m = wavefront_error_m(opd_m, geometry.frame, screen.truth_m, light.weights, light.grid)
    error_m = opd_m - screen.pixels_m
    whole = bool(np.isfinite(opd_m).all())
    groups = dict.fromkeys(GROUPS_CPA, math.nan)
    if modes is not None and found.error_bars is not None:
        groups = modes.squares_over_told(error_m, found.error_bars)
    return Scored(
        fine_nm=1e9 * fine_m if np.isfinite(fine_m) else LOST_NM,
        pixels_nm=1e9 * rms_m(error_m, light.pixel_weights) if whole else LOST_NM,
        predicted_nm=1e9 * float(found.predicted_error_m),
        outcome=Outcome(int(found.outcome_code)),
        ffts=int(found.ffts),
        iterations=int(found.iterations),
        strength=float(found.strength),
        milliseconds=math.nan,
        groups=groups,
        steps=step_errors(error_m, light.segments, wavelength_m=geometry.wavelength_m),
    )


def _summed_up(scored: list[Scored], capture: Capture) -> Row:
    """Statistics over the screens, lost ones included."""
    fine_nm, pixels_nm = (np.array([getattr(one, name) for one in scored]) for name in ("fine_nm", "pixels_nm"))
    captured = fine_nm < capture.captured_nm
    right = captured if capture.score == "fine" else pixels_nm < capture.captured_nm
    if capture.score == "segments":
        right = steps_captured([one.steps for one in scored], capture.captured_nm)
    believed = np.array([one.outcome.succeeded for one in scored])
    ffts = [one.ffts for one in scored]
    among = float(np.median(fine_nm[captured])) if captured.any() else math.nan
    return {
        "screens": len(scored),
        "captured": float(captured.mean()),
        **_percentiles(fine_nm, "nm"),
        "median_captured_nm": round(among, 2),
        "captured_pixels": float(np.mean(pixels_nm < capture.captured_nm)),
        **_percentiles(pixels_nm, "pixels_nm"),
        "ffts": float(np.median(ffts)),
        "ffts_p95": round(float(np.percentile(ffts, 95)), 1),
        "iterations": float(np.median([one.iterations for one in scored])),
        "ms_per_frame": round(float(np.median([one.milliseconds for one in scored])), 3),
        "predicted_nm": round(float(np.median([one.predicted_nm for one in scored])), 2),
        "believed": float(np.mean(believed)),
        "believed_wrong": float(np.mean(believed & ~right)),
        "doubted_right": float(np.mean(~believed & right)),
        **_over_predicted([one for one in scored if one.outcome.succeeded]),
        **step_columns([one.steps for one in scored], capture.captured_nm),
    }


def _sky_columns(case: Case, config: Config, strengths: list[float]) -> Row:
    """What the case was, and the strength of the turbulence that its estimates tell over the true one."""
    air = turbulence(config)
    telescope_over_fried = config.beam.diameter_m / air.fried_at(wavelength_m(config))
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
        "max_iterations": _most_iterations(config.estimation),
        "strength_ratio": round(float(np.median(strengths)) * (reference / true_seeing) ** (5 / 3), 3),
        "method": config.estimation.method,
        "planes": len(config.curvature_sensor.distances_km),
    }


def _percentiles(error_nm: Float[np.ndarray, " screen"], ending: str) -> Row:
    percentiles = np.percentile(error_nm, [5, 16, 50, 84, 95])
    names = ("p5", "p16", "median", "p84", "p95")
    return {f"{name}_{ending}": round(float(value), 2) for name, value in zip(names, percentiles, strict=True)}


def _over_predicted(believed: list[Scored]) -> Row:
    """Rms over the screens that are believed; 1 is honest, more is too proud."""

    def rms(squares: list[float]) -> float:
        return round(math.sqrt(sum(squares) / len(squares)), 3) if squares else math.nan

    whole = [(one.fine_nm / one.predicted_nm) ** 2 if one.predicted_nm > 0 else math.nan for one in believed]
    row: Row = {"error_over_predicted": rms(whole)}
    return row | {f"error_over_predicted_{name}": rms([one.groups[name] for one in believed]) for name in GROUPS_CPA}


def _most_iterations(settings: EstimationSettings) -> int:
    """Of what the method repeats at full resolution: iterations, steps, or updates."""
    return {
        "gerchberg-saxton": settings.gerchberg_saxton.iterations,
        "map": settings.map.steps,
        "linear": settings.linear.gerchberg_saxton_updates,
    }[settings.method]
