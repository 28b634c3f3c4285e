"""What knows only steady light of one colour, and planes at rest, refuses all else in a line."""

from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.scintillation import refuse_heights


def refuse_colours(config: Config, *, because: str) -> None:
    """Refuse light of many colours, from a star of some size or that scintillates, and planes that a membrane moves.

    For what knows only steady light of one colour, and planes at rest.

    Args:
        config: The settings.
        because: What understands no more, as in `loop.sensor = "pyramid"`.

    Raises:
        SettingsError: If the settings ask for them.

    Examples:
        >>> refuse_colours(Config(), because="nlcwfs sensitivity")
    """
    if config.beam.spectrum.shape != "line":
        raise SettingsError("beam.spectrum.shape", f'must be "line" with {because}', f'"{config.beam.spectrum.shape}"')
    if config.atmosphere.star.size_mas:
        raise SettingsError("atmosphere.star.size_mas", f"must be 0 with {because}", config.atmosphere.star.size_mas)
    refuse_heights(config, because=because)
    refuse_membrane(config, because=because)


def refuse_membrane(config: Config, *, because: str) -> None:
    """Refuse a membrane where planes rest, or where there are none.

    Args:
        config: The settings.
        because: What has no such planes, as in `loop.sensor = "pyramid"`.

    Raises:
        SettingsError: If the settings ask for one.

    Examples:
        >>> refuse_membrane(Config(), because="nlcwfs sensitivity")
    """
    motion = config.curvature_sensor.membrane
    if motion != "none":
        raise SettingsError("curvature_sensor.membrane", f'must be "none" with {because}', f'"{motion}"')
