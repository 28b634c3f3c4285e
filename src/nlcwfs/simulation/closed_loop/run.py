"""A run of the loop from its first exposure to its last, and what came out of it."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.wind import Wind
from nlcwfs.feedback.controller import Telemetry
from nlcwfs.simulation.closed_loop.handover import MatrixLook
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop import GROUPS, Loop, LoopState, Record

MISSING = -1
"""Outcome of an exposure that did not arrive."""

LOST_SHARE = 0.5
"""A loop is lost that ends with more than this part of the open loop's rms, or whose sensor believes nothing more."""

AIR_SAMPLES = 12
"""Moments at which the bounds look at the air."""

Watch = Callable[[LoopState, list[Record]], None]


class LoopTelemetry(NamedTuple):
    """What was recorded, one row for each exposure.

    Attributes:
        rms_nm: Residual of the star's wavefront.
        group_nm: The same by groups of modes, see `simulation.loop.GROUPS`.
        predicted_nm: Error that the reconstruction expected; NaN where there was none.
        outcome: How it ended, see `Outcome`; `MISSING` where nothing arrived.
        ffts: FFTs of one plane.
        closed: Whether the frame was followed.
        linear: Whether the matrix of the linear regime has read it.
        measured_m: Residual of the mirror's modes that was measured, less what was not believed.
        command_m: Mean command on the mirror.
    """

    rms_nm: Float[np.ndarray, " frame"]
    group_nm: Float[np.ndarray, "frame 5"]
    predicted_nm: Float[np.ndarray, " frame"]
    outcome: Int[np.ndarray, " frame"]
    ffts: Int[np.ndarray, " frame"]
    closed: np.ndarray
    linear: np.ndarray
    measured_m: Float[np.ndarray, "frame mode"]
    command_m: Float[np.ndarray, "frame mode"]

    @classmethod
    def of(cls, records: Sequence[Record]) -> "LoopTelemetry":
        """Put records into columns."""
        flat = np.zeros_like(records[0].command_m)
        sights = [record.sight for record in records]
        return cls(
            rms_nm=np.array([record.rms_nm for record in records]),
            group_nm=np.sqrt([record.group_nm2 for record in records]),
            predicted_nm=np.array([math.nan if one is None else 1e9 * one.predicted_m for one in sights]),
            outcome=np.array([MISSING if one is None else int(one.outcome) for one in sights]),
            ffts=np.array([0 if one is None else one.ffts for one in sights]),
            closed=np.array([one is not None and one.closed for one in sights]),
            linear=np.array([one is not None and one.linear for one in sights]),
            measured_m=np.stack([flat if one is None else np.asarray(one.residual_m) for one in sights]),
            command_m=np.stack([record.command_m for record in records]),
        )


def run_loop(
    loop: Loop, *, state: LoopState | None = None, records: list[Record] | None = None, watch: Watch | None = None
) -> tuple[LoopState, list[Record]]:
    """Every exposure of a run, or those that are left of one.

    Gains and predictions are learnt once, `loop.learn_after_s` after the loop has closed. A loop that has not closed
    after `loop.give_up_s` ends.

    Args:
        loop: The loop; its controller may learn.
        state: Where an earlier run stopped.
        records: What that had recorded.
        watch: Called after each exposure.
    """
    settings = loop.config.loop
    state, records = state or loop.init(), records or []
    if records and _has_learnt(loop, state):
        loop.learn(_closed_part(loop, state, records))
    while state.frame < settings.frames:
        if state.closed_at < 0 and state.frame >= settings.give_up_s * settings.rate_hz:
            break
        if _learns_at(loop, state) == state.frame:
            loop.learn(_closed_part(loop, state, records))
        state, record = loop.step(state)
        records.append(record)
        if watch is not None:
            watch(state, records)
    return state, records


def summary(loop: Loop, state: LoopState, records: Sequence[Record], seconds: float) -> dict[str, Any]:
    """The numbers of a run.

    Args:
        loop: The loop.
        state: Where it ended.
        records: What was recorded.
        seconds: Time that it took to compute.
    """
    told, settings = LoopTelemetry.of(records), loop.config.loop
    first = counted_from(loop, state)
    counted = told.rms_nm[first:]
    bounds = loop_bounds(loop.light)
    ended = counted[-max(1, len(counted) // 4) :] if len(counted) else told.rms_nm[-1:]
    believed = np.isin(told.outcome, [int(one) for one in Outcome if one.succeeded])
    nothing = len(told.outcome) >= 10 and not believed[-10:].any()
    if state.closed_at < 0:
        outcome = "not closed"
    elif nothing or float(np.median(ended)) > LOST_SHARE * bounds["open_loop_nm"]:
        outcome = "lost"
    else:
        outcome = "closed"

    def rms(values: np.ndarray) -> float | None:
        return round(float(np.sqrt(np.mean(values**2))), 2) if len(values) else None

    return {
        "outcome": outcome,
        "rms_nm": rms(counted),
        "rms_by_group_nm": {name: rms(told.group_nm[first:, place]) for place, name in enumerate(GROUPS)},
        "strehl": round(float(state.image.strehl), 4) if int(state.image.exposures) else None,
        "science_wavelength_um": settings.science_wavelength_um,
        "rate_hz": settings.rate_hz,
        "magnitude": loop.config.atmosphere.star.magnitude,
        "photons_per_s": float(f"{loop.light.still.photons * settings.rate_hz:.6g}"),
        "photons_per_frame": loop.light.still.photons,
        "frames": len(records),
        "frames_counted": len(counted),
        "frames_to_close": None if state.closed_at < 0 else int(state.closed_at),
        "frames_not_believed": int(np.sum(~believed)),
        "frames_linear": int(np.sum(told.linear)),
        "handovers": int(np.sum(np.diff(told.linear.astype(int)) > 0)),
        "handbacks": int(np.sum(np.diff(told.linear.astype(int)) < 0)),
        "linear_range_nm": told_range_nm(loop),
        "ffts_per_frame": float(np.median(told.ffts[first:])) if len(counted) else None,
        "wind": told_wind(loop),
        "latency_s": loop.config.feedback.latency_frames / settings.rate_hz,
        "seconds": round(seconds, 2),
        "bounds": bounds,
    }


def told_range_nm(loop: Loop) -> float | None:
    """Rms of the residual up to which the matrix of a loop serves; None of a loop without."""
    linear: MatrixLook | None = getattr(loop.measurement, "linear", None)
    return None if linear is None else round(1e9 * linear.matrix.range.limit_m, 1)


def told_wind(loop: Loop) -> dict[str, float] | None:
    """The wind that Kalman's filter reckons with; None of a loop without, or that has found none."""
    wind: Wind | None = getattr(loop.measurement, "wind", None)
    return None if wind is None else {name: round(value, 3) for name, value in wind._asdict().items()}


def counted_from(loop: Loop, state: LoopState) -> int:
    """The first exposure that counts: after closing, settling, and learning if there is any."""
    if state.closed_at < 0:
        return state.frame
    settled = math.floor(state.closed_at + loop.config.loop.settle_s * loop.config.loop.rate_hz) + 1
    learnt = _learns_at(loop, state)
    return min(settled if learnt < 0 or learnt >= state.frame else learnt + settled - state.closed_at, state.frame)


def loop_bounds(light: LoopLight) -> dict[str, float]:
    """What limits any sensor here: the mirror's shapes, the lag of one exposure, the quantum limit of the photons.

    `fitting` is what the mirror cannot hold, `lag` how much what it can hold changes in one exposure,
    `photon` the root of modes over four photons; `floor` is all three. From `AIR_SAMPLES` moments of this very air.
    """
    still, mirror = light.still, light.mirror
    frames = int(min(light.sequence.longest, 1e6, AIR_SAMPLES * 50)) - 1
    numbers = np.linspace(0, max(frames - 1, 0), AIR_SAMPLES).astype(int)

    def variance(opd_m: Array) -> float:
        return float(jnp.sum(light.weights * (opd_m - jnp.sum(light.weights * opd_m)) ** 2))

    whole, fitting, lag = [], [], []
    for number in numbers:
        now_m, later_m = light.air_m(int(number)), light.air_m(int(number) + 1)
        command_m = mirror.fitted(now_m)
        whole.append(variance(now_m))
        fitting.append(variance(now_m - mirror.opd_m(command_m)))
        lag.append(variance(mirror.opd_m(mirror.fitted(later_m) - command_m)))
    radian_m = still.wavelength_m / (2 * math.pi)
    photon = mirror.count / (4 * still.photons) * radian_m**2
    squares = {"open_loop_nm": np.mean(whole), "fitting_nm": np.mean(fitting), "lag_nm": np.mean(lag)}
    squares |= {"photon_nm": photon, "floor_nm": np.mean(fitting) + np.mean(lag) + photon}
    return {name: round(1e9 * math.sqrt(square), 2) for name, square in squares.items()}


def _learns_at(loop: Loop, state: LoopState) -> int:
    """Frame at which the loop learns; -1 if it never does."""
    settings = loop.config.loop
    if not loop.learns or state.closed_at < 0:
        return -1
    return state.closed_at + max(64, round(settings.learn_after_s * settings.rate_hz))


def _has_learnt(loop: Loop, state: LoopState) -> bool:
    return 0 <= _learns_at(loop, state) < state.frame


def _closed_part(loop: Loop, state: LoopState, records: Sequence[Record]) -> Telemetry:
    """What was recorded from closing until learning."""
    told = LoopTelemetry.of(records[state.closed_at : _learns_at(loop, state)])
    return Telemetry(measured_m=told.measured_m, mirror_m=told.command_m)
