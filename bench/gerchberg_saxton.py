"""What a reconstruction costs: its time against the time of its own FFTs, on one core, in one run.

`make bench` runs this. Absolute times belong to the machine of the day; the ratios are the result.
"""

import os
import sys
import time

# One core for everything: set before JAX starts.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.estimation.angle import angle, cosine_and_sine
from nlcwfs.estimation.reconstructor import GerchbergSaxton
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings, GerchbergSaxtonSettings
from nlcwfs.estimation.whole_turns import PASSES

GEOMETRY = SensorGeometry(
    pupil=PupilShape(diameter_m=8.0),
    frame=Grid((64, 64), pixel_m=8.0 / 45),
    wavelength_m=0.65e-6,
    distances_m=(-3.5e6, -2.5e6, 2.5e6, 3.5e6),
)
TEN_ITERATIONS = {"coarse_cutoffs_cpa": (), "tolerance_rad": 0.0, "iterations": 10}
PLAIN = {"filter": "none", "amplitude": "replace", "gain": 1.0, "fast_forward": 0.0}
REPEATS = 400


def times_ms(function, *arguments) -> np.ndarray:
    """Times of repeated calls, compiled and warm."""
    jax.block_until_ready(function(*arguments))
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        found.append(time.perf_counter() - start)
    return 1e3 * np.array(found)


def own_ffts(settings: GerchbergSaxtonSettings):
    """The FFTs of ten iterations and of the closing comparison with the counts, in the same number and shape."""
    shape = GEOMETRY.frame.shape
    planes = len(GEOMETRY.distances_m)
    at_once = planes if settings.scheme == "averaged" else 1

    def iteration(_, field):
        for _ in range(planes // at_once):
            spectrum = jnp.fft.fft2(field)
            far = jnp.fft.ifft2(jnp.broadcast_to(spectrum[None], (at_once, *shape)))
            field = jnp.fft.ifft2(jnp.sum(jnp.fft.fft2(far), axis=0))
            if settings.filter == "turbulence":
                smooth = jnp.fft.irfft2(jnp.fft.rfft2(field.real), s=shape)
                field = jax.lax.complex(smooth, field.imag)
        return field

    def there_and_back(real, times):
        for _ in range(times):
            real = jnp.fft.irfft2(jnp.fft.rfft2(real), s=shape)
        return real

    def run(field):
        field = jax.lax.fori_loop(0, settings.iterations, iteration, field)
        far = jnp.fft.ifft2(jnp.broadcast_to(jnp.fft.fft2(field)[None], (planes, *shape)))
        # The verdict filters counts and residual; the default also smooths the counts and brings slips back.
        frames = there_and_back(far.real, 2 + (settings.amplitude == "poisson"))
        phase = there_and_back(field.real, PASSES if settings.filter == "turbulence" else 0)
        return frames, phase

    return jax.jit(run)


def bench_iterations(table: Table) -> None:
    """Ten iterations on 64 x 64 pixels, four planes, from counts to wavefront."""
    rng = np.random.default_rng(1)
    counts = jnp.asarray(rng.poisson(2.0, (4, 64, 64)), jnp.float32)
    field = jnp.asarray(rng.normal(size=(64, 64)) + 1j * rng.normal(size=(64, 64)), jnp.complex64)
    usable = jnp.ones(counts.shape, bool)
    for scheme in ("averaged", "serial"):
        for name, options in (("plain", PLAIN), ("default filter", {})):
            settings = GerchbergSaxtonSettings(scheme=scheme, **TEN_ITERATIONS, **options)
            solver = GerchbergSaxton.build(GEOMETRY, EstimationSettings(gerchberg_saxton=settings))
            whole = times_ms(eqx.filter_jit(lambda s, c: s.estimate(c, usable).opd_m), solver, counts)
            ffts = times_ms(own_ffts(settings), field)
            add_row(table, f"10 iterations, {scheme}, {name}", whole, ffts)


def add_row(table: Table, name: str, whole: np.ndarray, baseline: np.ndarray) -> None:
    """Medians and 99th percentiles of both, and the ratio of the medians."""
    table.add_row(
        name,
        f"{np.median(whole):.3f}",
        f"{np.percentile(whole, 99):.3f}",
        f"{np.median(baseline):.3f}",
        f"{np.percentile(baseline, 99):.3f}",
        f"{np.median(whole) / np.median(baseline):.2f}",
    )


def bench_whole(console: Console) -> None:
    """The default reconstruction: first call, and every call after."""
    counts = jnp.asarray(np.random.default_rng(1).poisson(1.2, (4, 64, 64)), jnp.float32)
    usable = jnp.ones(counts.shape, bool)
    start = time.perf_counter()
    solver = GerchbergSaxton.build(GEOMETRY, EstimationSettings())
    built = time.perf_counter()
    reconstruct = eqx.filter_jit(lambda s, c: s.estimate(c, usable))
    first = jax.block_until_ready(reconstruct(solver, counts))
    compiled = time.perf_counter()
    whole = times_ms(reconstruct, solver, counts)
    console.print(
        f"Default reconstruction: build {built - start:.1f} s, first call {compiled - built:.1f} s, then "
        f"{np.median(whole):.1f} ms (99 %: {np.percentile(whole, 99):.1f} ms) for {int(first.ffts)} FFTs of one plane."
    )


def bench_angles(table: Table) -> None:
    """The fast angle and phasor against the exact ones, a hundred in a row."""
    rng = np.random.default_rng(1)
    phase = jnp.asarray(rng.uniform(-20, 20, (64, 64)), jnp.float32)
    field = jax.lax.complex(phase, phase.T)

    def hundred(function):
        return jax.jit(lambda x: jax.lax.fori_loop(0, 100, lambda _, y: function(y), x))

    exact_angle = hundred(lambda f: jax.lax.complex(jnp.arctan2(f.imag, f.real), f.imag))
    fast_angle = hundred(lambda f: jax.lax.complex(angle(f), f.imag))
    add_row(table, "100 fast angles (baseline: arctan2)", times_ms(fast_angle, field), times_ms(exact_angle, field))
    exact = hundred(lambda p: 9 * (jnp.cos(p) + jnp.sin(p)))
    fast = hundred(lambda p: 9 * sum(cosine_and_sine(p)))
    add_row(table, "100 fast phasors (baseline: cos, sin)", times_ms(fast, phase), times_ms(exact, phase))


def main() -> None:
    """Print every comparison."""
    console = Console(width=120, file=sys.stdout)
    table = Table(title="One core, 64 x 64 pixels, four planes, single precision; baseline: its own FFTs")
    for column in ("what", "median ms", "99 % ms", "baseline ms", "99 % ms", "ratio"):
        table.add_column(column, justify="left" if column == "what" else "right")
    bench_iterations(table)
    bench_angles(table)
    console.print(table)
    bench_whole(console)


if __name__ == "__main__":
    main()
