"""What a vibrating membrane costs the most likely wavefront, with a model at rest and with one that moves.

Single exposures of 300 nm of air, 8 m, 0.85 um, 44 pixels across the pupil. Light runs on four cells to a pixel and as
many moments of the motion as the mirror's finest wave needs, the model on two cells and fewer moments. Each way sees
the same wavefronts. The bound is that of photons and turbulence together at the true wavefront (van Trees 1968), from
the information of the model's own images in 16 moments; errors and bound are of the mean over detector pixels.

    python bench/membrane.py --seeds 10 --out bench/membrane.ecsv
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from astropy.table import Table
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.config import Config, load_config
from nlcwfs.curvature_sensor.apparent_star import POINT
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.curvature_sensor.membrane import membrane_moments, moments_of_model, moving_light, ripple_error
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.error_bars import error_bars
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.sensor_model import light_on_pixels
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.interop import Provenance
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of
from nlcwfs.studies.case_bound import share_on_pixels

SETTINGS = [
    "atmosphere.opd_rms_nm=300",
    "detector.pixels_across_pupil=44",
    "detector.window_pixels=66",
    "estimation.method=map",
]
PLANES_KM = ((2500, 3500), (500, 1000))
PHOTONS = (2e5, 2e6)
DENSE = 16
"""Moments of the bound's light."""

BOUNDS = 2
"""Wavefronts at which the bound is told: it hardly varies between them."""

NAMES = ("planes_km", "photons", "motion", "dead_share", "moments", "seeds", "believed")
NAMES = (*NAMES, "median_nm", "p10_nm", "p90_nm", "bound_nm")


class Way(NamedTuple):
    """A motion of the planes, and the moments of the model that follows it; at rest with one."""

    motion: str
    dead_share: float
    moments: int


def ways(planes_km: tuple[int, int]) -> list[Way]:
    """What is compared."""
    light = {"distance_m": 1e3 * planes_km[1], "wavelength_m": 0.85e-6, "diameter_m": 8.0}
    few, fewer = (moments_of_model("sine", **light, dead_share=dead) for dead in (0.0, 0.1))
    moves = [Way("sine", 0.0, few), Way("sine", 0.1, fewer), Way("sine", 0.0, DENSE)]
    return [Way("none", 0.0, 1), Way("sine", 0.0, 1), *moves, Way("square", 0.1, 1), Way("sine", 0.1, 1)]


def config_of(planes_km: tuple[int, int], photons: float, way: Way) -> Config:
    """The settings of one way."""
    near, far = planes_km
    sensor = [f"distances_km=[{-far},{-near},{near},{far}]", f"membrane={way.motion}"]
    sensor += [f"membrane_dead_share={way.dead_share}"] * (way.motion != "none")
    model = [f"atmosphere.photons={photons}", f"estimation.map.membrane_moments={way.moments}"]
    return load_config(None, [*SETTINGS, *(f"curvature_sensor.{one}" for one in sensor), *model])


def model_of(config: Config, simulator: ExposureSimulator) -> MaximumAPosteriori:
    """The reconstructor; one that rests is the same for all motions, and is compiled once."""
    if config.estimation.map.membrane_moments == 1:
        still = config.curvature_sensor.model_copy(update={"membrane": "none", "membrane_dead_share": 0.0})
        config = config.model_copy(update={"curvature_sensor": still})
    return MaximumAPosteriori.build(geometry_of(config, simulator), config.estimation)


@eqx.filter_jit
def estimated(model: MaximumAPosteriori, electrons: Float[Array, "plane y x"]) -> WavefrontEstimate:
    """The most likely wavefront."""
    return model.estimate(electrons, jnp.ones(electrons.shape, bool))


@eqx.filter_jit
def _bound_rad(model: MaximumAPosteriori, phase_rad: Array, photons: Array, strength: Array, beyond: Array) -> Array:
    level, error = model.level, model.error
    factor = photons * level.optics.flux_fractions[:, None, None]
    light, along = jax.linearize(lambda phase: factor * light_on_pixels(level, phase), phase_rad)
    key = jax.random.key(0)
    told = {"strength": strength, "photons": photons, "key": key}
    bars = error_bars(lambda pixels: along(level.on_cells(pixels[None])[0]), light, error.modes, **told)
    return jnp.sqrt(jnp.sum(error.averaged * bars.mode_rad2) + error.modes.beyond_rad2 * strength * beyond)


def bound_nm(model: MaximumAPosteriori, simulator: ExposureSimulator, exposure: Exposure) -> float:
    """The least error that the light of an exposure allows, of the mean over pixels."""
    level, weights = model.level, simulator.weights
    both = jnp.stack([weights * exposure.opd_m, weights])
    cells = integrate_on_pixels(both, factor=simulator.factor // level.oversampling, window=level.grid.shape)
    phase_rad = jnp.where(cells[1] > 0, cells[0] / jnp.where(cells[1] > 0, cells[1], 1), 0)
    phase_rad = phase_rad * (2 * np.pi / simulator.wavelength_m)
    strength = (simulator.shape.diameter_m / simulator.air.fried_at(simulator.wavelength_m)) ** (5 / 3)
    finest_cpa = 2 / np.pi * np.sqrt(len(model.error.modes.modes))  # of so many modes: pi F^2 times the disc's pi / 4
    beyond = share_on_pixels(finest_cpa, simulator.frame.pixel_m / simulator.shape.diameter_m)
    arguments = (jnp.asarray(one, phase_rad.dtype) for one in (simulator.photons, strength, beyond))
    return 1e9 * float(_bound_rad(model, phase_rad, *arguments)) * simulator.wavelength_m / (2 * np.pi)


def row_of(planes_km: tuple[int, int], photons: float, way: Way, seeds: int) -> tuple:
    """Errors of one way over the seeds, and the bound."""
    config = config_of(planes_km, photons, way)
    simulator = ExposureSimulator.build(config)
    model, weights = model_of(config, simulator), np.asarray(simulator.pixel_weights(), float)
    denser = way._replace(moments=DENSE if way.motion == "sine" else 1)
    dense, errors, bounds, believed = model_of(config_of(planes_km, photons, denser), simulator), [], [], 0
    for seed in range(seeds):
        exposure = simulator.expose(frame_key(seed=seed, frame=0))
        estimate = estimated(model, exposure.frames.electrons)
        missed_m = np.nan_to_num(np.asarray(estimate.opd_m - exposure.truth_m, float))
        missed_m -= np.sum(weights * missed_m)
        errors.append(1e9 * np.sqrt(np.sum(weights * missed_m**2)))
        believed += Outcome(int(estimate.outcome_code)).succeeded
        bounds += [bound_nm(dense, simulator, exposure)] if seed < BOUNDS else []
    told = [round(float(one), 1) for one in (*np.percentile(errors, (50, 10, 90)), np.median(bounds))]
    return (f"{planes_km[0]}, {planes_km[1]}", photons, *way, seeds, believed, *told)


def rule_rows(distance_m: float) -> list[tuple]:
    """Error of images in few moments, over their fluctuations: that of the rule, and of two frames on pixels."""
    cells = Grid((216, 216), 8.0 / 110)
    pupil = PupilShape(8.0).on(cells)
    air = Turbulence.from_rms(opd_rms_m=300e-9, diameter_m=8.0)
    screens = PhaseScreens.build(air, shape=pupil.shape, pixel_m=cells.pixel_m)
    skies_m = [jnp.where(pupil > 0, screens.draw(jax.random.key(seed)), 0) for seed in range(2)]

    def images(count: int, sky_m: Array) -> np.ndarray:
        rest_m = np.array([[distance_m, -distance_m]])
        one, moments = Spectrum.monochromatic(0.85e-6), membrane_moments("sine", count=count)
        spectrum, places_m, _ = moving_light(one, rest_m, POINT, moments)
        sensor = CurvatureSensor.build(pupil, cells, distances_m=places_m, spectrum=spectrum)
        return np.asarray(integrate_on_pixels(sensor.images(sky_m, 1.0).photons, factor=2, window=(108, 108)), float)

    flat, true = images(40, 0 * skies_m[0]), [images(40, sky_m) for sky_m in skies_m]
    whole = [np.sum((one - flat) ** 2) for one in true]
    rows = []
    for count in (1, 2, 4, 8, 16):
        told = ripple_error(count, distance_m=distance_m, wavelength_m=0.85e-6, diameter_m=8.0)
        missed = [np.sum((images(count, sky_m) - one) ** 2) for sky_m, one in zip(skies_m, true, strict=True)]
        rows.append((count, round(told, 3), *(round(float(one), 3) for one in np.sqrt(np.divide(missed, whole)))))
    return rows


def main() -> None:
    """Run the table and write it, row by row; rows that it holds already are kept."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("bench/membrane.ecsv"))
    parser.add_argument("--rule", action="store_true", help="print how good the rule for the moments is, and end")
    given = parser.parse_args()
    if given.rule:
        for distance_m in (0.5e6, 3.5e6):
            print(distance_m, *rule_rows(distance_m), sep="\n")
        return
    rows = [tuple(row) for row in Table.read(given.out)] if given.out.exists() else []
    known = {row[:6] for row in rows}
    stamp = Provenance.collect({"settings": SETTINGS}, seed=given.seeds, device=jax.devices()[0].device_kind)
    for planes_km in PLANES_KM:
        for way in ways(planes_km):
            for photons in PHOTONS:
                if (f"{planes_km[0]}, {planes_km[1]}", photons, *way, given.seeds) in known:
                    continue
                begun = time.perf_counter()
                rows.append(row_of(planes_km, photons, way, given.seeds))
                print(rows[-1], f"{time.perf_counter() - begun:.0f} s", flush=True)
                table = Table(rows=rows, names=NAMES)
                table.meta = {"commit": stamp.commit, "version": stamp.version, "seeds": given.seeds}
                table.write(given.out, overwrite=True)


if __name__ == "__main__":
    main()
