"""The photon bound of a case: the best that any reconstructor could do with its light."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.config import Config
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.photon_bound import fisher_information, photon_bound
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key, turbulence, wavelength_m

SCREENS = 2
"""The bound hardly varies between screens (a few per cent): two tell it."""

MODES = 1200
"""Modes whose information is counted; turbulence beyond them counts as lost, which makes the bound a little high."""

OVERSAMPLING = 2
"""Cells of the bound's light per detector pixel: the same light, on half as fine a grid, for the sake of time."""


class LightInformation(NamedTuple):
    """Fisher information per photon, for a few screens.

    Attributes:
        per_photon: Of the modes' coefficients, 1/m^2, one matrix a screen.
        basis: The modes.
    """

    per_photon: list[Float[np.ndarray, "mode mode"]]
    basis: ModalBasis


def light_information(config: Config) -> LightInformation:
    """What one photon tells about the modes; photon noise alone, so that it serves for any number of photons."""
    simulation = config.simulation.model_copy(update={"light_oversampling": OVERSAMPLING})
    simulator = ExposureSimulator.build(config.model_copy(update={"simulation": simulation}))
    size = simulator.light.shape[0]
    margin = (size - int(np.ceil(simulator.shape.diameter_m / simulator.light.pixel_m)) - 2) // 2
    tight = slice(margin, size - margin)
    pupil = np.asarray(simulator.sensor.pupil, float)[tight, tight]
    diameter_m = simulator.shape.diameter_m
    basis = modal_basis(pupil, simulator.light.padded(pupil.shape), diameter_m=diameter_m, count=MODES)
    modes = jnp.asarray(basis.modes, jnp.float32)

    def counts(opd_m: Float[Array, "y x"]) -> Float[Array, "plane v u"]:
        images = simulator.sensor.images(jnp.pad(opd_m, margin), 1.0).photons
        return integrate_on_pixels(images, factor=simulator.factor, window=simulator.window)

    truths = [simulator.expose(frame_key(seed=config.seed, frame=number)).opd_m for number in range(SCREENS)]
    return LightInformation([fisher_information(counts, truth_m[tight, tight], modes) for truth_m in truths], basis)


def case_bound(config: Config, light: LightInformation) -> dict[str, float]:
    """Medians over the screens, in the columns of a study's table."""
    air = turbulence(config)
    found = [
        photon_bound(
            config.atmosphere.photons * per_photon,
            light.basis,
            telescope_over_fried=config.beam.diameter_m / air.fried_at(wavelength_m(config)),
            photons=config.atmosphere.photons,
            wavelength_m=wavelength_m(config),
        )
        for per_photon in light.per_photon
    ]
    return {
        "bound_nm": round(1e9 * float(np.median([bound.bayesian_m for bound in found])), 2),
        "quantum_nm": round(1e9 * float(np.median([bound.quantum_m for bound in found])), 2),
        "sensor_loss": round(float(np.median([bound.sensor_loss for bound in found])), 2),
    }
