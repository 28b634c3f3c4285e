"""What scintillation costs the most likely wavefront, and what of that it regains when it estimates the amplitude too.

The tables of docs/scintillation.md. The amplitude is that of the whole air; the wavefront is what is left of it:
Kolmogorov's, of a given rms. All frames of a seed have the same wavefront and the same random key of the detector.

    python bench/scintillation.py [SEEDS [SKY [RMS_NM,... [PHOTONS,... [SETTING ...]]]]]
"""

import sys
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.air_at_pupil import HighAir
from nlcwfs.config import load_config
from nlcwfs.estimation.method import Reconstructor, build_reconstructor
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of

SKIES = {"usual": (0.6, 10, 0.073), "strong": (0.78, 20, 0.20)}
"""Seeing in arcsec, height in km of half of the turbulence, and the index of a point that this makes."""

PIXELS = ["detector.pixels_across_pupil=44", "detector.window_pixels=66", "estimation.method=map"]


class Score(NamedTuple):
    """How far an estimate is off, over the light of the pupil's pixels.

    Attributes:
        phase_nm: Rms of the error of the wavefront, piston removed.
        true: Rms of the log-amplitude, its mean removed.
        missed: Rms of the error of the log-amplitude; all of it where it is taken as known.
        alike: Correlation of the log-amplitude found with the true one.
        told: Predicted error of the wavefront over its error.
    """

    phase_nm: float
    true: float
    missed: float
    alike: float
    told: float


@eqx.filter_jit
def estimated(model: Reconstructor, electrons: Float[Array, "plane y x"]) -> WavefrontEstimate:
    """The most likely wavefront."""
    return model.estimate(electrons, jnp.ones(electrons.shape, bool), read_variance=0.0)


def score(
    found: WavefrontEstimate,
    truth_m: Float[Array, "y x"],
    log_amplitude: Float[Array, "y x"],
    weights: Float[np.ndarray, "y x"],
) -> Score:
    """Errors of an estimate."""

    def level(values: Float[Array, "y x"]) -> Float[np.ndarray, "y x"]:
        known = np.nan_to_num(np.asarray(values, float))
        return known - np.sum(weights * known)

    def rms(values: Float[np.ndarray, "y x"]) -> float:
        return float(np.sqrt(np.sum(weights * values**2)))

    true = level(log_amplitude)
    guess = 0 * true if found.log_amplitude is None else level(found.log_amplitude)
    alike = float(np.sum(weights * guess * true)) / max(rms(guess) * rms(true), 1e-30)
    error_m = rms(level(found.opd_m - truth_m))
    return Score(1e9 * error_m, rms(true), rms(guess - true), alike, float(found.predicted_error_m) / error_m)


def air_of(sky: str) -> tuple[list[str], HighAir]:
    """What a model is told of a sky, and the sky."""
    seeing_arcsec, height_km, index = SKIES[sky]
    layers = ["layer_fractions=[0.5,0.5]", "wind_speeds_m_per_s=[10,10]", "wind_directions_deg=[0,0]"]
    layers += [f"layer_heights_km=[0,{height_km}]", f"seeing_arcsec={seeing_arcsec}"]
    high = ExposureSimulator.build(load_config(None, [*(f"atmosphere.{one}" for one in layers), *PIXELS])).high
    assert high is not None
    told = [f"estimation.prior.layer_heights_km=[0,{height_km}]", f"estimation.prior.scintillation_index={index}"]
    return told, high


def row(sky: str, rms_nm: float, photons: float, seeds: int, more: Sequence[str]) -> None:
    """Print a line for a wavefront and a number of photons, and all its errors."""
    told, high = air_of(sky)
    settings = [*PIXELS, f"atmosphere.opd_rms_nm={rms_nm}", f"atmosphere.photons={photons}", *told, *more]
    simulator = ExposureSimulator.build(load_config(None, settings))
    even, joint = (
        build_reconstructor(geometry_of(config, simulator), config.estimation)
        for config in (
            load_config(None, [*settings, f"estimation.map.amplitude={one}"]) for one in ("known", "estimated")
        )
    )
    weights = np.asarray(simulator.pixel_weights(), float)
    scores: dict[str, list[Score]] = {"even, steady": [], "even": [], "joint": [], "joint, steady": []}
    for seed in range(seeds):
        key_sky, key_detector = jax.random.split(frame_key(seed=seed, frame=0))
        sky_m = simulator.on_light(simulator.screens.draw(key_sky))
        factor = jax.vmap(simulator.on_light)(high.draw(jax.random.fold_in(key_sky, 1)).factor)
        log_amplitude = simulator.on_pixels(jnp.log(jnp.maximum(factor[0], 1e-3)))
        for name in scores:
            steady = name.endswith("steady")
            exposure = simulator.expose_to(sky_m, key_detector, factor=None if steady else factor)
            found = estimated(even if name.startswith("even") else joint, exposure.frames.electrons)
            scores[name].append(score(found, exposure.truth_m, log_amplitude * (not steady), weights))
    print(f"{sky} sky, {rms_nm:g} nm, {photons:g} photons", flush=True)
    for name, each in scores.items():
        middle = Score(*np.median(np.array(each), axis=0))
        print(
            f"   {name:13s}: {middle.phase_nm:5.1f} nm, told {middle.told:.2f} of it; log-amplitude {middle.true:.4f}, "
            f"missed {middle.missed:.4f}, alike {middle.alike:.2f}; each",
            *(f"{one.phase_nm:.1f}" for one in each),
            flush=True,
        )


def main(arguments: Sequence[str]) -> None:
    """Print a few lines for each wavefront and number of photons."""
    seeds = int(arguments[0]) if arguments else 10
    skies = [arguments[1]] if len(arguments) > 1 else list(SKIES)
    rms_nm = arguments[2].split(",") if len(arguments) > 2 else (100, 300, 609)
    photons = arguments[3].split(",") if len(arguments) > 3 else (2e4, 2e5, 2e6, 2e7)
    for sky in skies:
        for one in rms_nm:
            for many in photons:
                row(sky, float(one), float(many), seeds, arguments[4:])


if __name__ == "__main__":
    main(sys.argv[1:])
