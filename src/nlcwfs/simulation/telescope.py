"""The telescope of a configuration, and how its segments stand."""

from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.segment_layouts import segments_of, vanes
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError


def telescope(config: Config) -> PupilShape:
    """The pupil of a configuration: round, or made of segments.

    Raises:
        SettingsError: If segments overlap or leave the telescope, or if the configuration names a map instead: reading
            files is not for this stage.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> shape = telescope(load_config(None, ["beam.segments.layout=sparse"]))
        >>> len(shape.segments.parts), telescope(Config()).segments
        (4, None)
    """
    beam = config.beam
    if beam.pupil_map is not None:
        raise SettingsError("beam.pupil_map", "must be read first and handed over as a shape", beam.pupil_map)
    segments = segments_of(beam)
    if segments is not None:
        return PupilShape(beam.diameter_m, segments.obstruction_m / beam.diameter_m, segments=segments)
    return PupilShape(beam.diameter_m, beam.obstruction_ratio, vanes(beam))
