"""Frames of the loop a second, for each sensor, and where the time goes; at the size of the paper's Fig. 5.

Every sensor meets the same air, mirror and light, starts closed, and is timed after a few frames in which XLA compiles.
Stages are waited for one by one (`block_until_ready`). Machines differ, and others may share them: look at the ratio to
the loop with the ideal sensor of the same run, which has all but a reconstruction, and at the processor's time (cpu).

    python bench/loop_speed.py --out bench/loop_speed.ecsv
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from astropy.table import Table

from loop import PAPER
from nlcwfs.config import load_config
from nlcwfs.interop import Provenance
from nlcwfs.simulation.closed_loop.loop import Loop

SENSORS = {
    "ideal": ["loop.sensor=ideal"],
    "curvature, followed": [],
    "curvature, each frame alone": ["loop.follow=false"],
    "curvature, kalman, wind told": ["feedback.controller=kalman", "estimation.prior.wind_direction_deg=0"],
    "curvature, gerchberg-saxton": ["estimation.method=gerchberg-saxton"],
    "shack-hartmann, D/d 18": ["loop.sensor=shack-hartmann", "shack_hartmann.subapertures=18"],
    "shack-hartmann, D/d 36": ["loop.sensor=shack-hartmann", "shack_hartmann.subapertures=36"],
    "shack-hartmann, D/d 60": ["loop.sensor=shack-hartmann", "shack_hartmann.subapertures=60"],
}
"""What is timed, and the settings that make it; the first is what the others are compared with."""

STAGES = {
    "light": ("light", "expose"),
    "reconstruction": ("measurement", "measure"),
    "controller": ("controller", "step"),
}
"""Parts of a step: attribute of the loop, and its method. What is left is the mirror's shape and the record."""

COMPILING = 8
"""Frames that are not counted: a followed frame is first seen at the third, its second look at the seventh."""


class Timed:
    """A part of the loop whose method is waited for, and timed."""

    def __init__(self, part: Any, method: str) -> None:
        self.part, self.method, self.seconds = part, method, 0.0

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.part, name)
        return self._timed(found) if name == self.method else found

    def _timed(self, call: Callable) -> Callable:
        def timed(*arguments: Any, **options: Any) -> Any:
            begun = time.perf_counter()
            result = jax.block_until_ready(call(*arguments, **options))
            self.seconds += time.perf_counter() - begun
            return result

        return timed


def one(name: str, loop: Loop, *, frames: int, seconds: float) -> dict:
    """Time of a frame, and of its parts."""
    clocks = {stage: Timed(getattr(loop, part), method) for stage, (part, method) in STAGES.items()}
    for stage, (part, _) in STAGES.items():
        setattr(loop, part, clocks[stage])
    state, begun = loop.init(), time.perf_counter()
    for _ in range(COMPILING):
        state, _ = loop.step(state)
    first_s, rows, ffts = time.perf_counter() - begun, [], []
    while len(rows) < frames and sum(row["whole"] for row in rows) < seconds:
        before = {stage: clock.seconds for stage, clock in clocks.items()}
        begun, begun_cpu = time.perf_counter(), time.process_time()
        state, record = loop.step(state)
        row = {stage: clock.seconds - before[stage] for stage, clock in clocks.items()}
        rows.append(row | {"whole": time.perf_counter() - begun, "cpu": time.process_time() - begun_cpu})
        ffts.append(0 if record.sight is None else record.sight.ffts)
    ms = {stage: 1e3 * np.array([row[stage] for row in rows]) for stage in rows[0]}
    rest = ms["whole"] - sum(ms[stage] for stage in STAGES)
    return {
        "sensor": name,
        "frames": len(rows),
        "frames_per_s": round(1e3 / float(ms["whole"].mean()), 2),
        "ms_median": round(float(np.median(ms["whole"])), 1),
        "ms_p99": round(float(np.percentile(ms["whole"], 99)), 1),
        **{f"{stage}_ms": round(float(np.median(ms[stage])), 1) for stage in STAGES},
        "rest_ms": round(float(np.median(rest)), 1),
        "cpu_mean_ms": round(float(ms["cpu"].mean()), 1),
        "ffts_median": float(np.median(ffts)),
        "first_frames_s": round(first_s, 1),
        "rms_nm": round(record.rms_nm, 0),
    }


def main() -> None:
    """Time every sensor."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=12.0, help="at most so long for a sensor")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    told = [*PAPER, "loop.start=closed", *given.overrides]
    rows: list[dict] = []
    for name, settings in SENSORS.items():
        config = load_config(None, [*told, *settings])
        begun = time.perf_counter()
        loop = Loop.build(config)
        ready_s = time.perf_counter() - begun
        row = one(name, loop, frames=given.frames, seconds=given.seconds) | {"ready_s": round(ready_s, 1)}
        first = (rows or [row])[0]
        times = {"times_ideal": round(first["frames_per_s"] / row["frames_per_s"], 2)}
        rows.append(row | times | {"times_ideal_cpu": round(row["cpu_mean_ms"] / first["cpu_mean_ms"], 2)})
        print(rows[-1], flush=True)
    if given.out is not None:
        config = load_config(None, told)
        stamp = Provenance.collect(
            config.model_dump(mode="json"), seed=config.seed, device=jax.devices()[0].device_kind
        )
        table = Table(rows=rows, meta=stamp.as_dict() | {"settings": told})
        table.write(given.out, overwrite=True, format="ascii.ecsv")


if __name__ == "__main__":
    main()
