"""A stream of frames in a closed loop: FFTs for each frame against the rms that is left.

An ideal mirror takes out all waves up to 16 cycles per aperture of what the frame before has shown (gain 1, latency one
exposure); 0.6 arcsec, 10 m/s, 0.85 um, 3e6 photons a second at 260 Hz, planes of the paper, 44 pixels across the pupil.
Light runs on cells four times finer than the pixels, the model on cells half a pixel wide. The loop starts closed.

    python bench/closed_loop.py --frames 60 --seeds 3 --out bench/closed_loop.ecsv
"""

import argparse
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from astropy.table import Table

from nlcwfs.config import load_config
from nlcwfs.estimation.frame_prediction import posterior_power
from nlcwfs.estimation.gauss_newton import conjugate_gradients, plus
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.sequence_reconstructor import SequenceReconstructor
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.tilt import tilt_phase
from nlcwfs.estimation.wave_sensitivity import LAGS
from nlcwfs.estimation.whitened_phase import Unknown
from nlcwfs.interop import Provenance
from nlcwfs.simulation.exposure import frame_key
from nlcwfs.simulation.known_sensor import geometry_of
from nlcwfs.simulation.sequence import SequenceSimulator

RATE_HZ = 260.0
PHOTONS_PER_S = 3e6
CUTOFF_CPA = 16.0
LOST_NM = 3000.0
"""Beyond, the loop is open again."""

SETTLING = 15
"""Frames that do not count: the loop comes to rest."""

SETTINGS = [
    "beam.wavelength_um=0.85",
    "atmosphere.seeing_arcsec=0.6",
    f"atmosphere.photons={PHOTONS_PER_S / RATE_HZ}",
    "detector.pixels_across_pupil=44",
    "detector.window_pixels=64",
    "simulation.light_oversampling=4",
    "simulation.light_window=1.5",
    f"simulation.rate_hz={RATE_HZ}",
]
BUDGETS = ((1, 100), (2, 100), (3, 75), (3, 100), (3, 150), (3, 200), (4, 150), (4, 600))
"""Gauss-Newton steps and FFTs for each frame."""


class Mirror:
    """Takes out the waves up to the cutoff, on the grid of the model and on that of the light."""

    def __init__(self, sequence: SequenceReconstructor, light):
        self.grid, self.light = sequence.solver.level.grid, light
        self.metres = sequence.solver.geometry.wavelength_m / (2 * np.pi)
        self.wavelength_m = sequence.solver.geometry.wavelength_m
        f = np.hypot(self.grid.fy_per_m, self.grid.fx_per_m) * sequence.solver.geometry.pupil.diameter_m
        self.phase_rad, self.slope = None, None
        self.kept = np.exp(-((f / CUTOFF_CPA) ** 16))
        self.finer = round(self.grid.pixel_m / light.pixel_m)

    def shapes_m(self, phase_rad, slope) -> tuple[np.ndarray, np.ndarray]:
        """The shape (OPD) on the model's grid and on the light's."""
        spectrum = np.fft.fftshift(np.fft.fft2(np.asarray(phase_rad, float)) * self.kept)
        rows, columns = self.grid.shape
        on_model = np.fft.ifft2(np.fft.ifftshift(spectrum)).real
        wide = np.pad(spectrum, [((self.finer - 1) * n // 2,) * 2 for n in (rows, columns)])
        fine = np.fft.ifft2(np.fft.ifftshift(wide)).real * self.finer**2
        # Cell centres of the finer grid lie between those of the coarser one.
        fine = _shifted(fine, (self.finer - 1) / 2)
        cut = [(a - b) // 2 for a, b in zip(fine.shape, self.light.shape, strict=True)]
        fine = _fitted(fine, cut)
        tilts = [
            np.asarray(tilt_phase(jnp.asarray(slope), grid, self.wavelength_m)) for grid in (self.grid, self.light)
        ]
        self.phase_rad, self.slope = jnp.asarray(on_model, phase_rad.dtype), slope
        return (on_model + tilts[0]) * self.metres, (fine + tilts[1]) * self.metres


def _shifted(array, cells: float):
    fy, fx = np.fft.fftfreq(array.shape[0])[:, None], np.fft.fftfreq(array.shape[1])[None]
    return np.fft.ifft2(np.fft.fft2(array) * np.exp(-2j * np.pi * cells * (fy + fx))).real


def _fitted(array, cut):
    for axis, each in enumerate(cut):
        if each >= 0:
            array = np.take(array, range(each, array.shape[axis] - each), axis=axis)
        else:
            array = np.pad(array, [(-each, -each) if a == axis else (0, 0) for a in range(2)])
    return array


def run(sequence: SequenceReconstructor, simulator: SequenceSimulator, frames: int, *, cold: bool) -> np.ndarray:
    """Residual rms of every frame, nm."""
    still, flow = simulator.still, simulator.flow
    weights = np.asarray(still.weights, float)
    mirror = Mirror(sequence, still.light)
    usable = jnp.ones((4, *still.window), bool)
    start = eqx.filter_jit(lambda s, c: s.start(c, usable))
    follow = eqx.filter_jit(lambda s, c, m, k: s.follow(c, usable, m, known_m=k))
    # Closed from the start: the mirror has the shape of the first air, as far as its own waves can hold it.
    memory, left_nm = (
        first_memory(sequence, np.asarray(still.levelled(still.on_light(flow.opd_m(0.0))), float), still),
        [],
    )
    shape_model, shape_light = mirror.shapes_m(memory.phase_rad, memory.slope)
    for number in range(frames):
        air_m = still.levelled(still.on_light(flow.opd_m((number + 0.5) / RATE_HZ)))
        key = frame_key(seed=simulator.seed, frame=number)
        exposure = still.expose_to(jnp.asarray(np.asarray(air_m) - shape_light), key)
        residual = np.asarray(exposure.opd_m, float)
        left_nm.append(1e9 * np.sqrt(np.sum(weights * (residual - np.sum(weights * residual)) ** 2)))
        counts = exposure.frames.electrons
        if cold:
            _, found = start(sequence, counts)
            memory = eqx.tree_at(
                lambda m: (m.phase_rad, m.slope),
                memory,
                (mirror.phase_rad + found.phase_rad, mirror.slope + found.slope),
            )
        else:
            _, memory = follow(sequence, counts, memory, jnp.asarray(-shape_model))
        shape_model, shape_light = mirror.shapes_m(memory.phase_rad, memory.slope)
        if not left_nm[-1] < LOST_NM:
            break
    return np.array(left_nm)


def first_memory(sequence: SequenceReconstructor, air_m: np.ndarray, still) -> Memory:
    """What a loop that has run for long knows of the air: its wavefront, continued beyond the pupil as turbulence."""
    solver, level = sequence.solver, sequence.solver.level
    grid, light = level.grid, still.light
    rows = grid.y_m.ravel() / light.pixel_m + (light.shape[0] - 1) / 2
    columns = grid.x_m.ravel() / light.pixel_m + (light.shape[1] - 1) / 2
    points = np.meshgrid(rows, columns, indexing="ij")
    on_grid = scipy.ndimage.map_coordinates(air_m, points, order=1, mode="nearest")
    lit = np.asarray(level.light) > 0.99
    planes = np.stack([np.ones_like(on_grid), *np.broadcast_arrays(grid.y_m, grid.x_m)])
    fit = np.linalg.lstsq(planes[:, lit].T, on_grid[lit], rcond=None)[0]
    rest_rad = (on_grid - np.tensordot(fit, planes, axes=1)) * (2 * np.pi / solver.geometry.wavelength_m)
    prior = solver.prior(solver.power, solver.tilt_rms_rad)
    weight = jnp.asarray(lit / 0.01, solver.power.dtype)

    def curvature(v: Unknown) -> Unknown:
        return plus(prior.transposed(weight * prior.phase_rad(v)), v, 1.0)

    one = Unknown(jnp.ones_like(prior.amplitude), jnp.ones(2, prior.amplitude.dtype))
    goal = prior.transposed(weight * jnp.asarray(rest_rad, solver.power.dtype))
    found = conjugate_gradients(curvature, goal, one, prior, 200)
    open_to = PlaneScale(jnp.full((4, 1, 1), 1.0, solver.power.dtype), jnp.zeros((4, 1, 1), solver.power.dtype))
    tilt_rad = jnp.asarray(0.1, solver.power.dtype)
    return Memory(
        phase_rad=prior.phase_rad(found),
        slope=jnp.asarray(fit[1:], solver.power.dtype),
        left_open=posterior_power(solver.power, 10.0),
        tilt_left_rad=tilt_rad,
        strength=jnp.asarray(1.0, solver.power.dtype),
        scale=open_to,
        surprise_rad2=jnp.zeros(len(LAGS), solver.power.dtype),
    )


def main() -> None:
    """Run the table and write it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("bench/closed_loop.ecsv"))
    parser.add_argument("--wind-direction", type=float, default=None, help="deg, when it is known to the reconstructor")
    parser.add_argument("--budgets", default="", help="steps:ffts, ...")
    given = parser.parse_args()
    rows = []
    configs = [
        load_config(None, [*SETTINGS, f"seed={seed}", f"simulation.frames={given.frames}"])
        for seed in range(given.seeds)
    ]
    simulators = [SequenceSimulator.build(config) for config in configs]
    geometry = geometry_of(configs[0], simulators[0].still)
    budgets = [tuple(int(n) for n in each.split(":")) for each in given.budgets.split(",") if each] or [
        *BUDGETS,
        (0, 0),
    ]
    for steps, budget in budgets:
        cold = steps == 0
        options = EstimationSettings().map.model_copy(
            update={} if cold else {"sequence_steps": steps, "ffts_per_frame": budget}
        )
        settings = EstimationSettings(
            seeing_arcsec=0.6, map=options, modes=100, prior={"wind_direction_deg": given.wind_direction}
        )
        sequence = SequenceReconstructor.build(
            geometry, settings, interval_s=1 / RATE_HZ, photons=PHOTONS_PER_S / RATE_HZ
        )
        started, runs = time.perf_counter(), []
        for simulator in simulators:
            runs.append(run(sequence, simulator, given.frames, cold=cold))
        rms = [float(np.sqrt(np.mean(each[SETTLING:] ** 2))) if len(each) == given.frames else np.inf for each in runs]
        ffts = 1355 if cold else sequence.ffts
        rows.append(
            (steps, sum(sequence.inner), ffts, round(float(np.median(rms)), 1), round(min(rms), 1), round(max(rms), 1))
        )
        print(rows[-1], f"{time.perf_counter() - started:.0f} s", flush=True)
    table = Table(rows=rows, names=("steps", "conjugate_gradients", "ffts", "rms_nm", "lowest_nm", "highest_nm"))
    stamp = Provenance.collect(
        {"settings": SETTINGS, "frames": given.frames}, seed=given.seeds, device=jax.devices()[0].device_kind
    )
    table.meta = {"commit": stamp.commit, "version": stamp.version, "frames": given.frames, "seeds": given.seeds}
    table.write(given.out, overwrite=True)


if __name__ == "__main__":
    main()
