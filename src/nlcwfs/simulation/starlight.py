"""Photons of an exposure: from a star of a magnitude, a number in a second, or a number in an exposure."""

from nlcwfs.atmosphere.star import collecting_area_m2, photons_per_s
from nlcwfs.config import Config


def starlight_per_s(config: Config) -> float | None:
    """Photons that the whole sensor gets in a second; None where only those of an exposure are told.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> f"{starlight_per_s(load_config(None, ['atmosphere.star.magnitude=13'])):.1e}"  # Guyon 2010
        '3.2e+06'
    """
    star, beam = config.atmosphere.star, config.beam
    if star.magnitude is None:
        return config.atmosphere.photons_per_s
    band, throughput, bandwidth_um = star.light
    area_m2 = collecting_area_m2(diameter_m=beam.diameter_m, obstruction_ratio=beam.obstruction_ratio)
    return photons_per_s(star.magnitude, band=band, area_m2=area_m2, throughput=throughput, bandwidth_um=bandwidth_um)


def with_exposures_of(config: Config, rate_hz: float) -> Config:
    """The same, with the photons of exposures that last until the next begins.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> with_exposures_of(load_config(None, ["atmosphere.photons_per_s=3e6"]), 300.0).atmosphere.photons
        10000.0
    """
    in_a_second = starlight_per_s(config)
    if in_a_second is None:
        return config
    sky = config.atmosphere.model_copy(update={"photons": in_a_second / rate_hz})
    return config.model_copy(update={"atmosphere": sky})
