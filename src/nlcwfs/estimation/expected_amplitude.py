"""What is expected of the amplitude at the pupil before its photons are, from the heights of the air's layers."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.atmosphere.scintillation import scintillation_index
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.complex_phase import log_amplitude_power
from nlcwfs.estimation.prior_settings import PriorSettings
from nlcwfs.estimation.resolution_level import Level
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings


class ExpectedAmplitude(eqx.Module):
    """The power of the log-amplitude.

    Attributes:
        power: Of each wave, for turbulence of strength 1.
        is_told: Whether that is the strength whatever the phase shows: behind a mirror that takes the phase out, the
            amplitude is as strong as ever.
    """

    power: Float[Array, "y fx"]
    is_told: bool = eqx.field(static=True)

    @classmethod
    def build(
        cls, geometry: SensorGeometry, settings: EstimationSettings, level: Level, air: Turbulence, *, dtype: str
    ) -> "ExpectedAmplitude | None":
        """What the settings expect; None where they take the amplitude as known.

        Args:
            geometry: The sensor.
            settings: Where the layers are.
            level: The sensor on the grid of the model.
            air: Turbulence of strength 1.
            dtype: Precision.

        Raises:
            SettingsError: If no layer is told that is above the telescope, shares are not one for each or do not sum to
                one, or all planes are on one side of the pupil.
        """
        if settings.map.amplitude == "known":
            return None
        heights_m, fractions = told_layers(settings.prior)
        if min(geometry.distances_m) > 0 or max(geometry.distances_m) < 0:
            rule = "must be known with planes on one side of the pupil only: there a weak wave of the amplitude looks "
            raise SettingsError("estimation.map.amplitude", rule + "like one of the phase", "estimated")
        power = log_amplitude_power(
            level.grid, air, heights_m=heights_m, fractions=fractions, wavelength_m=geometry.wavelength_m
        )
        index, wavelength_m = settings.prior.scintillation_index, geometry.wavelength_m
        if index is not None:
            power *= index / scintillation_index(air, heights_m, fractions, wavelength_m=wavelength_m)
        return cls(jnp.asarray(power, dtype), index is not None)

    def __call__(self, strength: Float[Array, ""]) -> Float[Array, "y fx"]:
        """Root of the power of each wave, for a phase of this strength."""
        return jnp.sqrt(self.power if self.is_told else self.power * strength)


def refuse_estimated(settings: EstimationSettings, *, because: str) -> None:
    """Refuse an amplitude that is to be estimated where only the phase is.

    Args:
        settings: What the user asks for.
        because: What estimates no amplitude, as in `method = linear`.

    Raises:
        SettingsError: If it is to be estimated.

    Examples:
        >>> refuse_estimated(EstimationSettings(), because="method = linear")
    """
    if settings.map.amplitude != "known":
        raise SettingsError("estimation.map.amplitude", f"must be known with {because}", settings.map.amplitude)


def told_layers(prior: PriorSettings) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Heights in metres and shares of the layers that a user expects.

    Raises:
        SettingsError: If none is above the telescope, or shares do not fit.

    Examples:
        >>> told_layers(PriorSettings(layer_heights_km=(0.0, 10.0)))
        ((0.0, 10000.0), (0.5, 0.5))
    """
    heights_km, fractions = prior.layer_heights_km, prior.layer_fractions
    if heights_km is None or not max(heights_km) > 0:
        rule = "must hold a height above 0 with estimation.map.amplitude = estimated"
        raise SettingsError(
            "estimation.prior.layer_heights_km", rule, heights_km if heights_km is None else list(heights_km)
        )
    if fractions is None:
        fractions = (1 / len(heights_km),) * len(heights_km)
    if len(fractions) != len(heights_km):
        rule = f"must be one per layer of estimation.prior.layer_heights_km, {len(heights_km)}"
        raise SettingsError("estimation.prior.layer_fractions", rule, list(fractions))
    if not math.isclose(sum(fractions), 1, abs_tol=1e-3):
        raise SettingsError("estimation.prior.layer_fractions", "must sum to 1", list(fractions))
    return tuple(1e3 * height_km for height_km in heights_km), fractions
