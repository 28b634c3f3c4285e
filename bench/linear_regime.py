"""The linear regime: does the matrix take over, leave as little as what captured, hand back; how fast is it.

    python bench/linear_regime.py small                     20 tries of 2 m (settings of tests/loop, scaled planes)
    python bench/linear_regime.py small --set loop.fault=bump --set loop.bump_nm=400 --set loop.fault_at_s=0.1
    python bench/linear_regime.py large --seeds 3           8 m, 3e7 photons a second at 1 kHz
    python bench/linear_regime.py large --seeds 1 --time    a product against the followed frame, on 8 m

Both have a static aberration of half a wave rms in the arm of the sensor. Each seed runs twice, with and without the
handover; the rms is of the frames in which the matrix worked, of the same frames of both runs.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from astropy.table import Table

from nlcwfs.config import load_config
from nlcwfs.interop import Provenance
from nlcwfs.simulation.closed_loop.handover import HandedOver
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, run_loop, summary
from nlcwfs.simulation.closed_loop.seed import reseeded

COMMON = [
    "atmosphere.seeing_arcsec=0.6",
    "beam.wavelength_um=0.85",
    "curvature_sensor.static_rms_nm=425",
    "estimation.seeing_arcsec=0.6",
    "simulation.light_window=1.5",
]
SIZES = {
    "small": [
        "atmosphere.photons_per_s=2e6",
        "beam.diameter_m=2",
        "curvature_sensor.distances_km=[-219, -156, 156, 219]",
        "detector.pixels_across_pupil=16",
        "detector.window_pixels=24",
        "estimation.modes=60",
        "loop.rate_hz=500",
        "loop.seconds=0.2",
        "mirror.cutoff_cpa=5",
    ],
    "large": [
        "atmosphere.photons_per_s=3e7",
        "detector.pixels_across_pupil=44",
        "detector.window_pixels=64",
        "estimation.modes=100",
        "loop.rate_hz=1000",
        "loop.seconds=0.1",
    ],
}


def run(loop: Loop) -> tuple[LoopTelemetry, dict]:
    """A run from a flat mirror."""
    begun = time.perf_counter()
    state, records = run_loop(loop)
    return LoopTelemetry.of(records), summary(loop, state, records, time.perf_counter() - begun)


def compared(with_matrix: Loop, without: Loop) -> dict:
    """One seed with and without the handover."""
    told, found = run(with_matrix)
    other, _ = run(without)
    linear = told.linear
    ratio = np.sqrt(np.mean(told.rms_nm[linear] ** 2) / np.mean(other.rms_nm[linear] ** 2)) if linear.any() else np.nan
    return {
        "seed": with_matrix.config.seed,
        "outcome": found["outcome"],
        "first_linear": int(np.argmax(linear)) if linear.any() else -1,
        "frames_linear": found["frames_linear"],
        "frames": found["frames"],
        "handovers": found["handovers"],
        "handbacks": found["handbacks"],
        "ends_linear": bool(linear[-1]),
        "rms_linear_nm": round(float(np.sqrt(np.mean(told.rms_nm[linear] ** 2))), 2) if linear.any() else np.nan,
        "rms_followed_nm": round(float(np.sqrt(np.mean(other.rms_nm[linear] ** 2))), 2) if linear.any() else np.nan,
        "ratio": round(float(ratio), 4),
        "last_nm": round(float(np.median(told.rms_nm[-10:])), 1),
        "range_nm": found["linear_range_nm"],
        "floor_nm": found["bounds"]["floor_nm"],
    }


def timed(loop: Loop, repeats: int = 60) -> None:
    """Median milliseconds of the command's product, of the test's, and of a followed frame."""
    sensor, config = loop.measurement, loop.config
    if not isinstance(sensor, HandedOver) or not isinstance(sensor.capture, FollowedCurvature):
        raise SystemExit("needs a loop that hands over")
    short = config.loop.model_copy(update={"seconds": 12 / config.loop.rate_hz})
    loop.config = config.model_copy(update={"loop": short})
    state, _ = run_loop(loop)
    shot = loop.light.expose(
        jnp.asarray(state.frame, jnp.int32), state.control.line, state.image, jnp.zeros_like(loop.light.weights)
    ).exposure
    counts, usable = shot.frames.electrons, jnp.ones(shot.frames.electrons.shape, bool)
    mirror_m = loop.light.mirror.opd_m(state.control.line.mean_m)
    follow, memory = sensor.capture, None
    for _ in range(3):
        _, memory = follow.measure(shot, usable, mirror_m, memory)
    matrix = sensor.linear.matrix
    product = jax.jit(lambda seen: matrix.modes_m(seen, usable))
    test = jax.jit(lambda seen, modes_m: matrix.chi2(seen, usable, modes_m))
    modes_m = product(counts)
    stages = {
        "product": lambda: product(counts).block_until_ready(),
        "test": lambda: test(counts, modes_m).block_until_ready(),
        "followed frame": lambda: follow.measure(shot, usable, mirror_m, memory._replace(since=0))[0].residual_m,
    }
    for name, stage in stages.items():
        jax.block_until_ready(stage())
        took = []
        for _ in range(repeats):
            begun, busy = time.perf_counter(), time.process_time()
            jax.block_until_ready(stage())
            took.append((1e3 * (time.perf_counter() - begun), 1e3 * (time.process_time() - busy)))
        wall, cpu = np.median(took, axis=0)
        print(f"{name}: {wall:.2f} ms waited, {cpu:.2f} ms of processors", flush=True)
    print(f"matrix {matrix.matrix.shape}, {np.prod(matrix.matrix.shape) * 4 / 1e6:.0f} MB", flush=True)


def main() -> None:
    """Run the seeds and write the table after each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("size", choices=sorted(SIZES))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--out", type=Path, default=None)
    given = parser.parse_args()
    settings = [*COMMON, *SIZES[given.size], *given.overrides]
    loops = [Loop.build(load_config(None, [*settings, f"loop.handover={told}"])) for told in ("true", "false")]
    if given.time:
        timed(loops[0])
        return
    rows = []
    for seed in range(given.first, given.first + given.seeds):
        rows.append(compared(*(reseeded(loop, seed) for loop in loops)))
        print(rows[-1], flush=True)
        if given.out is not None:
            table, config = Table(rows=rows), loops[0].config
            stamp = Provenance.collect(config.model_dump(mode="json"), seed=seed, device=jax.devices()[0].device_kind)
            table.meta = stamp.as_dict() | {"settings": settings}
            table.write(given.out, overwrite=True, format="ascii.ecsv")


if __name__ == "__main__":
    main()
