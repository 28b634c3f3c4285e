"""What the rows of a study tell of dispersion, the size of the star and scintillation, and what each should cost."""

import math

from nlcwfs.atmosphere.scintillation import scintillation_index
from nlcwfs.config import Config
from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.simulation.colours import colours_of
from nlcwfs.simulation.exposure import turbulence, wavelength_m
from nlcwfs.simulation.sky_budget import SkyBudget
from nlcwfs.studies.study_table import Row


def sky_columns(config: Config, air: Config | None) -> Row:
    """Columns of a case whose light is no point's of one direction, or twinkles; none of any other.

    Args:
        config: Settings of the case.
        air: Settings of the air that twinkles; None where none does.

    Returns:
        What the sky is, and what the closed forms of `SkyBudget` add in quadrature.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> sky_columns(Config(), None)
        {}
        >>> star = ["atmosphere.opd_rms_nm=100", "atmosphere.photons=2e6", "atmosphere.star.size_mas=10"]
        >>> row = sky_columns(load_config(None, star), None)
        >>> row["star_mas"], row["added_nm"]
        (10.0, 0.83)
    """
    star, dispersed = config.atmosphere.star, config.atmosphere.dispersion.zenith_deg > 0
    if not (star.size_mas or dispersed or air):
        return {}
    budget = SkyBudget(
        turbulence(config),
        colours_of(config, turbulence(config)),
        wavelength_m=wavelength_m(config),
        diameter_m=config.beam.diameter_m,
        pixel_m=config.beam.diameter_m / config.detector.pixels_across_pupil,
        photons=config.atmosphere.photons,
    )
    settings = config.estimation.map
    knows = settings.star == "told" or (settings.wavelengths > 1 and config.beam.spectrum.shape != "line")
    added_m = budget.smeared_m(knows=knows)
    row: Row = {}
    if star.size_mas:
        row["star_mas"] = star.size_mas
    if dispersed:
        row |= {"dispersion_mas": _mas(budget.dispersion_rad), "tilt_nm": round(1e9 * budget.tilt_m, 2)}
    if air is not None:
        sky, heights_m = air.atmosphere, tuple(air.atmosphere.heights_m)
        layers = turbulence(air), heights_m, tuple(sky.layer_fractions)
        row["index"] = round(scintillation_index(*layers, wavelength_m=wavelength_m(config)), 4)
        added_m = math.hypot(added_m, budget.twinkling_m(*layers))
    return row | {"added_nm": round(1e9 * added_m, 2)}


def _mas(angle_rad: float) -> float:
    return round(angle_rad / ARCSEC_RAD * 1e3, 2)
