"""What the rows of a study tell of the colours of the light, of the lenses and of the model."""

from nlcwfs.config import Config
from nlcwfs.simulation.colours import bandwidth_m, colours_of
from nlcwfs.simulation.exposure import turbulence, wavelength_m
from nlcwfs.studies.study_table import Row


def colour_columns(config: Config) -> Row:
    """Columns of a case of light of many colours; none of one.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> flat = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.2", "estimation.map.wavelengths=3"]
        >>> row = colour_columns(load_config(None, [*flat, "atmosphere.opd_rms_nm=300"]))
        >>> row["band"], row["lenses"], row["model_colours"], colour_columns(Config())
        (0.2, 'achromatic', 3, {})
    """
    if config.beam.spectrum.shape == "line":
        return {}
    return {
        "band": round(bandwidth_m(config) / wavelength_m(config), 3),
        "lenses": config.curvature_sensor.lenses,
        "light_colours": len(colours_of(config, turbulence(config)).spectrum.shares),
        "model_colours": config.estimation.map.wavelengths,
    }
