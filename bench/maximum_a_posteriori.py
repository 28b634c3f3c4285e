"""What the most likely wavefront costs: its time against the time of its own FFTs, on one core, in one run.

The paper's frame: D / r0 = 8.2 at 0.65 um, 2e4 photons, 45 pixels across the pupil in a window of 64, four planes.
"""

import os
import time

# One core for everything: set before JAX starts.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nlcwfs.config import load_config
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of

FRAME = ["beam.wavelength_um=0.65", "atmosphere.opd_rms_nm=609", "atmosphere.photons=2e4", "seed=2010"]
FRAME += ["detector.pixels_across_pupil=45", "detector.window_pixels=64", "simulation.light_oversampling=4"]
REPEATS = 40


def times_ms(function, *arguments) -> np.ndarray:
    """Times of repeated calls, compiled and warm."""
    jax.block_until_ready(function(*arguments))
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        found.append(time.perf_counter() - start)
    return 1e3 * np.array(found)


def plane_fft_ms(size: int) -> np.ndarray:
    """One FFT of one plane, out of forty in a row on four planes at once."""

    def there_and_back(_, field):
        return jnp.fft.ifft2(jnp.fft.fft2(field))

    run = jax.jit(lambda field: jax.lax.fori_loop(0, 20, there_and_back, field))
    return times_ms(run, jnp.ones((4, size, size), jnp.complex64)) / 160


def main() -> None:
    """Print the comparison."""
    config = load_config(None, FRAME)
    simulator = ExposureSimulator.build(config)
    counts = jnp.asarray(simulator.expose(frame_key(seed=config.seed, frame=0)).frames.electrons)
    usable = jnp.ones(counts.shape, bool)
    start = time.perf_counter()
    solver = MaximumAPosteriori.build(geometry_of(config, simulator), EstimationSettings())
    built = time.perf_counter()
    whole = eqx.filter_jit(lambda solver, counts: solver.estimate(counts, usable))
    first = jax.block_until_ready(whole(solver, counts))
    compiled = time.perf_counter()
    guess = eqx.filter_jit(
        lambda solver, counts: solver.capture.search(solver.capture.measurement(counts, usable, 0.0))
    )
    on_frame = int(guess(solver, counts)[1].ffts)
    on_model = int(first.ffts) - on_frame
    sizes = counts.shape[1], solver.level.grid.shape[0]
    took = times_ms(whole, solver, counts)
    each = [np.median(plane_fft_ms(size)) for size in sizes]
    own = on_frame * each[0] + on_model * each[1]
    print(f"build {built - start:.1f} s, first call {compiled - built:.1f} s")
    for count, size, one in zip((on_frame, on_model), sizes, each, strict=True):
        print(f"{count} FFTs of {size} x {size} at {one:.4f} ms")
    median, slowest = np.median(took), np.percentile(took, 99)
    print(f"whole {median:.0f} ms (99 %: {slowest:.0f}), own FFTs {own:.0f} ms, ratio {median / own:.2f}")


if __name__ == "__main__":
    main()
