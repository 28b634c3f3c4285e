"""The photon bound of a case: the best that any reconstructor could do with its light."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.config import Config
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.photon_bound import fisher_information, photon_bound
from nlcwfs.interop.simulated_frames import pupil_of
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
        on_pixels: What is left of the product of two modes, averaged over the light, when each is averaged over the
            detector's pixels first; the unit matrix if it were all of it.
        pixel_over_diameter: Width of a detector pixel.
    """

    per_photon: list[Float[np.ndarray, "mode mode"]]
    basis: ModalBasis
    on_pixels: Float[np.ndarray, "mode mode"]
    pixel_over_diameter: float


def light_information(config: Config) -> LightInformation:
    """What one photon tells about the modes; photon noise alone, so that it serves for any number of photons."""
    simulation = config.simulation.model_copy(update={"light_oversampling": OVERSAMPLING})
    simulator = ExposureSimulator.build(config.model_copy(update={"simulation": simulation}), pupil_of(config))
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
    return LightInformation(
        per_photon=[fisher_information(counts, truth_m[tight, tight], modes) for truth_m in truths],
        basis=basis,
        on_pixels=products_on_pixels(basis, factor=simulator.factor, window=simulator.window),
        pixel_over_diameter=simulator.frame.pixel_m / diameter_m,
    )


def products_on_pixels(basis: ModalBasis, *, factor: int, window: tuple[int, int]) -> Float[np.ndarray, "mode mode"]:
    """Mean products of modes that are averaged over detector pixels, see `LightInformation.on_pixels`."""
    weights = jnp.asarray(basis.weights, jnp.float32)
    weighted = integrate_on_pixels(jnp.asarray(basis.modes, jnp.float32) * weights[None], factor=factor, window=window)
    light = np.asarray(integrate_on_pixels(weights[None], factor=factor, window=window)[0], float)
    lit = light > 0
    means = np.asarray(weighted, float)[:, lit] / np.sqrt(light[lit])
    return means @ means.T


def share_on_pixels(cycles_per_aperture: float, pixel_over_diameter: float) -> float:
    """Share of the turbulence beyond a frequency that is still there after averaging over square pixels.

    Kolmogorov's spectrum times the transfer function of the pixel, over that spectrum.

    Examples:
        >>> round(share_on_pixels(1e-3, 1e-3), 2), round(share_on_pixels(22.5, 1 / 45), 2)
        (1.0, 0.15)
    """
    frequency = np.geomspace(cycles_per_aperture, 1e3 * cycles_per_aperture, 4000)
    angle = np.linspace(0, np.pi / 2, 91)[:, None]
    along = frequency * pixel_over_diameter
    passed = np.mean((np.sinc(along * np.cos(angle)) * np.sinc(along * np.sin(angle))) ** 2, axis=0)
    power = frequency ** (-8 / 3)  # f^(-11/3) over circles
    return float(np.trapezoid(power * passed, frequency) / np.trapezoid(power, frequency))


def case_bound(config: Config, light: LightInformation) -> dict[str, float]:
    """Medians over the screens, in the columns of a study's table."""
    air, photons = turbulence(config), config.atmosphere.photons
    over_fried = config.beam.diameter_m / air.fried_at(wavelength_m(config))
    found, on_pixels_m = [], []
    for per_photon in light.per_photon:
        terms = {"telescope_over_fried": over_fried, "photons": photons, "wavelength_m": wavelength_m(config)}
        found.append(photon_bound(photons * per_photon, light.basis, **terms))
        on_pixels_m.append(bound_on_pixels(photons * per_photon, light, **terms))
    columns = {
        "bound_nm": [1e9 * bound.bayesian_m for bound in found],
        "quantum_nm": [1e9 * bound.quantum_m for bound in found],
        "bound_pixels_nm": [1e9 * bayesian_m for bayesian_m, _ in on_pixels_m],
        "quantum_pixels_nm": [1e9 * quantum_m for _, quantum_m in on_pixels_m],
        "sensor_loss": [bound.sensor_loss for bound in found],
    }
    return {name: round(float(np.median(values)), 2) for name, values in columns.items()}


def bound_on_pixels(
    information: Float[np.ndarray, "mode mode"],
    light: LightInformation,
    *,
    telescope_over_fried: float,
    photons: float,
    wavelength_m: float,
) -> tuple[float, float]:
    """The bounds of `photon_bound` for the mean of the wavefront over every detector pixel.

    Turbulence beyond the modes counts as lost as far as it is still there after averaging.

    Returns:
        Of the best estimator, and of a sensor that loses nothing; rms in metres.
    """
    radian = wavelength_m / (2 * np.pi)
    strength = telescope_over_fried ** (5 / 3) * radian**2
    variance = np.asarray(light.basis.kolmogorov_rad2, float) * strength
    beyond = max(light.basis.kolmogorov_total_rad2 * strength - variance.sum(), 0.0)
    beyond *= share_on_pixels(float(np.max(light.basis.cycles_per_aperture)), light.pixel_over_diameter)
    posterior = np.linalg.inv(information + np.diag(1 / variance))
    quantum = variance / (1 + 4 * photons / radian**2 * variance)
    bayesian = np.sum(posterior * light.on_pixels) + beyond
    return float(np.sqrt(bayesian)), float(np.sqrt(np.sum(quantum * np.diag(light.on_pixels)) + beyond))
