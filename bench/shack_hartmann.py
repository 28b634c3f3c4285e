"""What a Shack-Hartmann sensor leaves in a closed loop: the honest rival of the curvature sensor.

8 m telescope, 0.6 arcsec of Kolmogorov's turbulence in one frozen layer at 10 m/s, 0.85 um, 3e6 photons/s, 160 Hz. A
plain integrator; the command from one exposure is on during the next; exposures see the air of their middle. The mirror
makes Karhunen-Loeve modes exactly and starts closed. Scores are the rms over the light of the pupil, piston removed,
tilt included, after 10 frames; turbulence finer than the cells of the light is added in square.

Measured at gain 1 and all modes up to D/(2d): D/d 18, seeds 0 and 1: centre of gravity 134 and 135 nm, matched filter
135 and 142; D/d 36, seeds 0 to 3: 141, 159, 147 and 135; 113, 128, 119 and 113. About 17 and 11 frames/s on two cores.
"""

import argparse
import math
import time
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nlcwfs.atmosphere.frozen_flow import FrozenFlow, WindLayer
from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import KOLMOGOROV_SPECTRUM, ModalBasis, modal_basis
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, lenslet_grid
from nlcwfs.detector.sparse_photons import room_for_photons, sample_sparse_photons
from nlcwfs.estimation.slopes_to_modes import ModalReconstructor, average_gradients, minimum_variance, response
from nlcwfs.estimation.spot_centroids import centre_of_gravity, matched_filter
from nlcwfs.estimation.spot_model import MeanSpot, SpotModel

DIAMETER_M = 8.0
WAVELENGTH_M = 0.85e-6
RATE_HZ = 160.0
WIND_M_PER_S = 10.0
PHOTONS_PER_S = 3e6
AIR = Turbulence.from_seeing(seeing_arcsec=0.6)
SETTLING = 10
MEMORY = 0.9  # of the mean spot
MODE_CELLS = 108  # cells of the modes across the pupil: six for a wave of 18 cycles
MARGIN = 2  # and beyond its rim, for the interpolation


@dataclass(frozen=True)
class Mirror:
    """Modes of a disc a little larger than the pupil, smooth across its rim, interpolated onto the light."""

    basis: ModalBasis
    to_light: jnp.ndarray

    @classmethod
    def build(cls, light: Grid, *, cycles: float) -> "Mirror":
        """All modes up to a frequency."""
        across = MODE_CELLS + 2 * MARGIN
        grid = Grid((across, across), DIAMETER_M / MODE_CELLS)
        pupil = PupilShape(across * grid.pixel_m).on(grid)
        count = int(math.pi * (cycles * across / MODE_CELLS) ** 2 * 1.06) + 20
        basis = modal_basis(pupil, grid, diameter_m=DIAMETER_M, count=count).up_to(cycles)
        points = light.y_m.ravel() / grid.pixel_m + (across - 1) / 2
        return cls(basis, jnp.asarray(keys_cubic(points, across), "float32"))

    def kolmogorov_m2(self) -> np.ndarray:
        """Variance of every mode in the air."""
        strength = (DIAMETER_M / AIR.fried_at(WAVELENGTH_M)) ** (5 / 3)
        return self.basis.kolmogorov_rad2 * strength * (WAVELENGTH_M / (2 * np.pi)) ** 2


def keys_cubic(points: np.ndarray, count: int) -> np.ndarray:
    """Interpolation matrix (Keys 1981): local, so that nothing from beyond the rim spreads."""
    x = np.abs(points[:, None] - np.arange(count)[None, :])
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x < 1, near, np.where(x < 2, far, 0.0))


def finer_than_cells_m(cell_m: float) -> float:
    """Rms of the turbulence beyond 0.8 of the cells' half cycle, which the air on the light's grid lacks."""
    beyond = 0.8 / (2 * cell_m)
    angle = (np.arange(2000) + 0.5) / 2000 * np.pi / 4  # an octant outside a square
    ring = beyond / np.cos(angle)
    variance = 8 * np.pi / 4 * np.mean(KOLMOGOROV_SPECTRUM * 3 / 5 * ring ** (-5 / 3))
    return math.sqrt(variance * AIR.fried_at(WAVELENGTH_M) ** (-5 / 3)) * WAVELENGTH_M / (2 * np.pi)


@dataclass(frozen=True)
class Telescope:
    """Sensor, mirror and what they need, once for each D/d."""

    sensor: ShackHartmann
    grid: Grid
    weights: jnp.ndarray
    mirror: Mirror
    interaction: np.ndarray
    screens: PhaseScreens

    @classmethod
    def build(cls, subapertures: int) -> "Telescope":
        """The sensor, modes a third beyond what it sees, and the interaction of them by geometry."""
        settings = ShackHartmannSettings(subapertures=subapertures)
        grid = lenslet_grid(settings, diameter_m=DIAMETER_M, fried_m=AIR.fried_at(WAVELENGTH_M))
        pupil = PupilShape(DIAMETER_M).on(grid)
        spectrum = Spectrum.monochromatic(WAVELENGTH_M)
        sensor = ShackHartmann.build(pupil, grid, diameter_m=DIAMETER_M, spectrum=spectrum, settings=settings)
        mirror = Mirror.build(grid, cycles=min(0.67 * subapertures, 24.0))
        kernels = average_gradients(sensor).astype("float32")
        to_light, modes = np.asarray(mirror.to_light), mirror.basis.modes.astype("float32")
        parts = [
            response(sensor, kernels, to_light @ modes[first : first + 64] @ to_light.T)
            for first in range(0, len(modes), 64)
        ]
        screens = PhaseScreens.build(AIR, shape=grid.shape, pixel_m=grid.pixel_m, period=2 * grid.shape[0])
        weights = jnp.asarray(light_weights(pupil), "float32")
        return cls(sensor, grid, weights, mirror, np.concatenate(parts, axis=1), screens)


def rms_m(opd_m, weights):
    """Over the light, piston removed."""
    mean = jnp.sum(weights * opd_m)
    return jnp.sqrt(jnp.sum(weights * (opd_m - mean) ** 2))


@dataclass(frozen=True)
class Case:
    """What is varied."""

    centroid: str
    cycles: float
    gain: float


def run(telescope: Telescope, case: Case, seed: int, frames: int) -> tuple[float, float]:
    """Rms in nm after settling, and frames per second."""
    sensor, mirror = telescope.sensor, telescope.mirror
    photons = PHOTONS_PER_S / RATE_HZ
    controlled = int(np.sum(mirror.basis.cycles_per_aperture <= case.cycles))
    flat = SpotModel.of_sensor(sensor, photons=photons)
    light = jnp.sum(sensor.amplitude**2, (1, 2))
    light = light / light.sum()
    seen = float(jnp.sum(flat.mean))
    # what the loop leaves of the controlled modes by its lag, and the others as they are in the air
    prior = mirror.kolmogorov_m2()
    turn = 2 * np.pi * mirror.basis.cycles_per_aperture * WIND_M_PER_S / RATE_HZ / DIAMETER_M
    prior[:controlled] *= np.minimum(1, (2 * turn) ** 2)[:controlled]  # twice the lag: noise is left, too

    def filter_of(mean):
        model = mean.model(pixel_rad=sensor.pixel_rad)
        return matched_filter(model) if case.centroid == "matched" else centre_of_gravity(model)

    def reconstructor(mean):
        one = np.asarray(filter_of(mean).variance(mean.shape)[0])
        noise = one[None, :] / (np.asarray(light) * seen)[:, None]
        matrix = minimum_variance(telescope.interaction, prior_m2=prior, noise_rad2=noise.ravel(), keep=controlled)
        return ModalReconstructor(matrix.matrix.astype("float32"))

    @eqx.filter_jit
    def step(sensor, modes, residual_m, mean, spots, matrix, key):
        images = sensor.images(residual_m, photons).photons
        counts = sample_sparse_photons(key, images, room=room_for_photons(photons))
        slopes = spots.measure_faint(counts, light)
        mean = mean.updated(counts)
        return matrix.coefficients_m(slopes).astype("float32"), mean, filter_of(mean)

    air = FrozenFlow.build(
        telescope.screens,
        [WindLayer(1.0, WIND_M_PER_S, 0.0)],
        jax.random.key(seed),
        duration_s=frames / RATE_HZ,
    )
    wind = eqx.filter_jit(lambda air, t: air.opd_m(t))
    modes = jnp.asarray(mirror.basis.modes[:controlled], "float32")
    to_light = mirror.to_light

    @jax.jit
    def left(air_m, command_m):
        residual = air_m - to_light @ jnp.tensordot(command_m, modes, axes=1) @ to_light.T
        return residual, rms_m(residual, telescope.weights)

    # start closed: the modes' best fit to the first air, on their own cells
    first = np.asarray(wind(air, jnp.float32(0.5 / RATE_HZ)))
    command = best_fit(telescope, controlled, first)
    mean = MeanSpot(jnp.mean(flat.mean, axis=0, keepdims=True) / jnp.mean(jnp.sum(flat.mean, (1, 2))), MEMORY)
    spots, matrix = filter_of(mean), None
    found, started = [], 0.0
    for n in range(frames):
        residual, rms = left(wind(air, jnp.float32((n + 0.5) / RATE_HZ)), command)
        found.append(float(rms))
        if n in (0, SETTLING // 2):
            if n == 0:  # a first look at the spots as they are
                images = sensor.images(residual, photons).photons
                mean = MeanSpot(MeanSpot(mean.shape, 0.0).updated(images).shape, MEMORY)
                spots = filter_of(mean)
            matrix = reconstructor(mean)
        key = jax.random.fold_in(jax.random.key(1000 + seed), n)
        update, mean, spots = step(sensor, modes, residual, mean, spots, matrix, key)
        command = command + case.gain * update
        if n == SETTLING - 1:
            jax.block_until_ready(command)
            started = time.perf_counter()
    rate = (frames - SETTLING) / (time.perf_counter() - started)
    fine = finer_than_cells_m(telescope.grid.pixel_m)
    return 1e9 * math.sqrt(np.mean(np.square(found[SETTLING:])) + fine**2), rate


def best_fit(telescope: Telescope, controlled: int, air_m: np.ndarray):
    """Coefficients of the modes nearest to the air, from every third cell of the light."""
    every = slice(1, None, 3)
    rows = np.asarray(telescope.mirror.to_light)[every]
    lit = np.asarray(telescope.weights)[every, every] > 0
    maps = rows @ telescope.mirror.basis.modes[:controlled].astype("float32") @ rows.T
    columns = np.concatenate([np.ones((1, lit.sum()), "float32"), maps[:, lit]])
    normal = (columns @ columns.T).astype(float)
    goal = columns @ air_m[every, every][lit]
    ridge = 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
    return jnp.asarray(np.linalg.solve(normal + ridge, goal)[1:], "float32")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--subapertures", type=int, nargs="*", default=[18, 36])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--gains", type=float, nargs="*", default=[0.4, 0.7, 1.0])
    parser.add_argument("--frames", type=int, default=48)
    given = parser.parse_args()
    print("D/d  centroid  cutoff/CPA  gain  rms/nm of each seed  frames/s")
    for subapertures in given.subapertures:
        telescope = Telescope.build(subapertures)
        for centroid in ("gravity", "matched"):
            for cycles in (subapertures / 3, subapertures / 2):
                for gain in given.gains:
                    case = Case(centroid, cycles, gain)
                    runs = [run(telescope, case, seed, given.frames) for seed in range(given.seeds)]
                    rms = " ".join(f"{one[0]:.1f}" for one in runs)
                    rate = f"{runs[-1][1]:.1f}"
                    print(f"{subapertures:3d}  {centroid}  {cycles:4.0f}  {gain:.1f}  {rms}  {rate}", flush=True)


if __name__ == "__main__":
    main()
