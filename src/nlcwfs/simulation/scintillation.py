"""Scintillation of a configuration: the layers at altitude, what is said of them, and who refuses them."""

import math
from collections.abc import Sequence

from nlcwfs.atmosphere.frozen_flow import FrozenFlow
from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.atmosphere.scintillation import scintillation_index
from nlcwfs.beam.air_at_pupil import HighAir, check_layers
from nlcwfs.beam.moving_air_at_pupil import Twinkling, at_pupil
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError


def high_air(
    config: Config, air: Turbulence, spectrum: Spectrum, *, shape: Sequence[int], pixel_m: float
) -> HighAir | None:
    """The layers of a configuration, as they are at the pupil; None where all are at the telescope.

    Args:
        config: The settings.
        air: The whole turbulence.
        spectrum: Colours of the light.
        shape: Pixels of the pupil along y and x.
        pixel_m: Their width.

    Raises:
        SettingsError: If the layers cannot be served, see `HighAir.build`.

    Examples:
        >>> air, colours = Turbulence.from_seeing(seeing_arcsec=0.6), Spectrum.monochromatic(0.85e-6)
        >>> high_air(Config(), air, colours, shape=(24, 24), pixel_m=0.3) is None
        True
    """
    heights_m, colours = config.atmosphere.heights_m, spectrum.wavelengths_m
    if not heights_m:
        return None
    return HighAir.build(
        air,
        heights_m=heights_m,
        fractions=config.atmosphere.layer_fractions,
        wavelengths_m=(config.beam.wavelength_um * 1e-6, *(colours if len(colours) > 1 else ())),
        grid=((shape[0], shape[1]), pixel_m),
        dtype="float64" if config.precision == "double" else "float32",
    )


def high_flow(
    config: Config, air: Turbulence, flow: FrozenFlow, *, pixel_m: float
) -> tuple[FrozenFlow, Twinkling | None]:
    """Moving air as it is at the pupil, and the amplitude that it makes; unchanged and None where all is at the pupil.

    Args:
        config: The settings.
        air: The whole turbulence.
        flow: Its layers where they are.
        pixel_m: Width of a pixel of the flow.

    Raises:
        SettingsError: If heights do not fit the layers, the scintillation is not weak, or the light has many colours.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> from nlcwfs.simulation.sequence import SequenceSimulator
        >>> small = ["detector.pixels_across_pupil=12", "detector.window_pixels=16", "simulation.rate_hz=500"]
        >>> sequence = SequenceSimulator.build(load_config(None, small))
        >>> high_flow(Config(), sequence.still.air, sequence.flow, pixel_m=0.1)[1] is None
        True
    """
    heights_m, wavelength_m = config.atmosphere.heights_m, config.beam.wavelength_um * 1e-6
    if not heights_m:
        return flow, None
    if config.beam.spectrum.shape != "line":
        refuse_heights(config, because="light of many colours in sequences and loops")
    check_layers(air, heights_m, config.atmosphere.layer_fractions, wavelength_m)
    return at_pupil(flow, heights_m=heights_m, wavelength_m=wavelength_m, pixel_m=pixel_m)


def without_heights(config: Config) -> Config:
    """The same with all the air at the telescope.

    Examples:
        >>> without_heights(Config()) == Config()
        True
    """
    return config.model_copy(update={"atmosphere": config.atmosphere.model_copy(update={"layer_heights_km": None})})


def scintillation_account(config: Config, air: Turbulence, log_variance: float | None) -> list[str]:
    """How strong it is and where it comes from, in a line; nothing where there is none.

    Args:
        config: The settings.
        air: The whole turbulence.
        log_variance: Variance of the logarithm of the amplitude of the cells of the light; None where nothing twinkles.

    Examples:
        >>> scintillation_account(Config(), Turbulence.from_seeing(seeing_arcsec=0.6), None)
        []
    """
    if log_variance is None:
        return []
    sky, wavelength_m, diameter_m = config.atmosphere, config.beam.wavelength_um * 1e-6, config.beam.diameter_m
    of_layers = (air, sky.heights_m, sky.layer_fractions)
    point = scintillation_index(*of_layers, wavelength_m=wavelength_m)
    whole = math.sqrt(scintillation_index(*of_layers, wavelength_m=wavelength_m, diameter_m=diameter_m))
    cells = math.expm1(4 * log_variance)
    ratio = diameter_m / air.fried_at(wavelength_m)
    layers = ", ".join(
        f"{ratio * fraction**0.6:.1f} at {height_m / 1e3:g} km"
        for height_m, fraction in zip(sky.heights_m, sky.layer_fractions, strict=True)
    )
    return [
        f"Scintillation: index {point:.2g} of a point, {cells:.2g} of the cells of the light; the telescope's light "
        f"varies by {100 * whole:.2g} % rms. D/r0 by layer: {layers}."
    ]


def refuse_heights(config: Config, *, because: str) -> None:
    """Refuse layers at altitude where the amplitude is taken to be that of the pupil.

    Args:
        config: The settings.
        because: What understands no more, as in `loop.sensor = "pyramid"`.

    Raises:
        SettingsError: If a layer is above the telescope.

    Examples:
        >>> refuse_heights(Config(), because="nlcwfs sensitivity")
    """
    if config.atmosphere.heights_m:
        shown = list(config.atmosphere.layer_heights_km or ())
        raise SettingsError("atmosphere.layer_heights_km", f"must be 0 with {because}", shown)
