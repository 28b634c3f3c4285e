"""The closed loop of the paper's Fig. 5, from a flat mirror: does it close, how fast, what is left.

0.6 arcsec, 10 m/s, 0.85 um, 3e6 photons a second, modes up to 16 cycles per aperture, plain integrator of gain 1 and
latency of the exposure alone. Light on cells four times finer than the pixels, the model on half a pixel; rms of the
instantaneous residual, all turbulence on the light's cells included. `counts` from loop.settle_s after closing.

    python bench/loop.py --seeds 20 --out bench/loop.ecsv
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np
from astropy.table import Table

from nlcwfs.config import load_config
from nlcwfs.interop import Provenance
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.run import LoopTelemetry, run_loop, summary
from nlcwfs.simulation.closed_loop.seed import reseeded

PAPER = [
    "atmosphere.seeing_arcsec=0.6",
    "atmosphere.photons_per_s=3e6",
    "beam.wavelength_um=0.85",
    "detector.pixels_across_pupil=44",
    "detector.window_pixels=64",
    "estimation.seeing_arcsec=0.6",
    "estimation.modes=100",
    "simulation.light_window=1.5",
]
BELOW_NM = 120.0


def one(loop: Loop) -> dict:
    """A run of one seed."""
    config = loop.config
    begun = time.perf_counter()
    state, records = run_loop(loop)
    found = summary(loop, state, records, time.perf_counter() - begun)
    rms = LoopTelemetry.of(records).rms_nm
    low = np.flatnonzero(rms < BELOW_NM)
    after = rms[low[0] :] if len(low) else rms[:0]
    return {
        "seed": config.seed,
        "rate_hz": config.loop.rate_hz,
        "outcome": found["outcome"],
        "frames": found["frames"],
        "open_nm": round(float(rms[0]), 1),
        "frames_to_120": int(low[0]) if len(low) else -1,
        "frames_to_close": -1 if found["frames_to_close"] is None else found["frames_to_close"],
        "rms_nm": found["rms_nm"] or np.nan,
        "worst_after_nm": round(float(after.max()), 1) if len(after) else np.nan,
        "strehl": found["strehl"] or np.nan,
        "floor_nm": found["bounds"]["floor_nm"],
        "ms_per_frame": round(1e3 * found["seconds"] / found["frames"], 1),
    }


def main() -> None:
    """Run the seeds and write the table after each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1.1)
    parser.add_argument("--rate", type=float, default=260.0)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--label", default="plain")
    parser.add_argument("--out", type=Path, default=Path("bench/loop.ecsv"))
    given = parser.parse_args()
    rows, loop = [], None
    for seed in range(given.first, given.first + given.seeds):
        told = [*PAPER, f"seed={seed}", f"loop.seconds={given.seconds}", f"loop.rate_hz={given.rate}"]
        config = load_config(None, [*told, *given.overrides])
        loop = Loop.build(config) if loop is None else reseeded(loop, seed)
        rows.append({"label": given.label} | one(loop))
        print(rows[-1], flush=True)
        table = Table(rows=rows)
        stamp = Provenance.collect(config.model_dump(mode="json"), seed=seed, device=jax.devices()[0].device_kind)
        table.meta = stamp.as_dict() | {"settings": [*PAPER, *given.overrides]}
        table.write(given.out, overwrite=True, format="ascii.ecsv")


if __name__ == "__main__":
    main()
