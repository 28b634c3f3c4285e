"""What scintillation that no model knows costs the most likely wavefront: the table of docs/scintillation.md.

The amplitude is that of the whole air, seeing 0.6 arcsec, half of it at 10 km; the wavefront is what is left of it:
Kolmogorov's, of a given rms. Both frames of a seed have the same wavefront and the same random key of the detector.

    python bench/scintillation.py [SEEDS]
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.air_at_pupil import HighAir
from nlcwfs.config import load_config
from nlcwfs.estimation.method import Reconstructor, build_reconstructor
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of

LAYERS = ("layer_fractions=[0.5,0.5]", "wind_speeds_m_per_s=[10,10]", "wind_directions_deg=[0,0]")
SKY = [f"atmosphere.{one}" for one in (*LAYERS, "layer_heights_km=[0,10]")]
PIXELS = ["detector.pixels_across_pupil=44", "detector.window_pixels=66", "estimation.method=map"]


@eqx.filter_jit
def opd_m(model: Reconstructor, electrons: Float[Array, "plane y x"]) -> Float[Array, "y x"]:
    """The most likely wavefront."""
    return model.estimate(electrons, jnp.ones(electrons.shape, bool), read_variance=0.0).opd_m


def error_nm(model: Reconstructor, exposure: Exposure, weights: Float[np.ndarray, "y x"]) -> float:
    """Rms of the error on the pixels of the pupil, piston removed."""
    error_m = np.nan_to_num(np.asarray(opd_m(model, exposure.frames.electrons) - exposure.truth_m, float))
    error_m -= np.sum(weights * error_m)
    return 1e9 * float(np.sqrt(np.sum(weights * error_m**2)))


def main(seeds: int) -> None:
    """Print a line for each wavefront and number of photons."""
    whole: HighAir | None = ExposureSimulator.build(load_config(None, [*SKY, *PIXELS])).high
    assert whole is not None
    for rms_nm in (100, 300, 609):
        for photons in (2e4, 2e6):
            settings = [*PIXELS, f"atmosphere.opd_rms_nm={rms_nm}", f"atmosphere.photons={photons}"]
            config = load_config(None, settings)
            simulator = ExposureSimulator.build(config)
            model = build_reconstructor(geometry_of(config, simulator), config.estimation)
            weights, found = np.asarray(simulator.pixel_weights(), float), []
            for seed in range(seeds):
                key_sky, key_detector = jax.random.split(frame_key(seed=seed, frame=0))
                sky_m = simulator.on_light(simulator.screens.draw(key_sky))
                factor = jax.vmap(simulator.on_light)(whole.draw(jax.random.fold_in(key_sky, 1)).factor)
                pair = (None, factor)
                exposures = [simulator.expose_to(sky_m, key_detector, factor=one) for one in pair]
                found.append([error_nm(model, one, weights) for one in exposures])
            steady, twinkling = np.median(found, axis=0)
            print(f"{rms_nm} nm, {photons:g} photons: {steady:.1f} nm steady, {twinkling:.1f} nm twinkling", flush=True)
            print("   each: ", *(f"{one[0]:.1f} {one[1]:.1f}," for one in found), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
