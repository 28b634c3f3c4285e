"""The sensors that a loop may have, behind one interface."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float

from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.expected_amplitude import refuse_estimated
from nlcwfs.simulation.closed_loop.flow import carried_curvature
from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.lenslets import FollowedSpots
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.linear_images import handed_over
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature, IdealMeasurement, SingleFrames
from nlcwfs.simulation.closed_loop.pyramid_light import PyramidOptics
from nlcwfs.simulation.closed_loop.pyramid_sensor import FollowedPyramid
from nlcwfs.simulation.closed_loop.pyramid_solved import SearchingPyramid
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure


@runtime_checkable
class LoopSensor(Protocol):
    """What a sensor and its reconstructor make of an exposure; its light is that of `LoopOptics`."""

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "image v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: Any,
    ) -> tuple[Sight, Any]:
        """What an exposure shows of the mirror's modes.

        Args:
            exposure: What arrived, background subtracted.
            usable: Pixels that were read; the others are zero.
            mirror_m: Mean shape of the mirror over the exposure.
            memory: What the last exposure left; None before the first.

        Returns:
            The residual of each mode, and what the next exposure is to know.
        """
        ...

    def skip(self, memory: Any) -> tuple[Float[Array, " mode"] | None, Any]:
        """What is to be known after an exposure that did not arrive.

        Args:
            memory: What the last exposure left.

        Returns:
            The next command, of a sensor that looks ahead; and the memory.
        """
        ...


def build_sensor(config: Config, light: LoopLight) -> LoopSensor:
    """The sensor and method that a configuration names.

    Raises:
        SettingsError: If settings contradict each other.
    """
    loop, method = config.loop, config.estimation.method
    refuse_estimated(config.estimation, because="nlcwfs loop")
    carries = loop.sensor == "shack-hartmann" or (loop.sensor == "curvature" and method == "map" and loop.follow)
    if config.feedback.controller == "kalman" and not carries:
        rule = "filters the air of loop.sensor = shack-hartmann, or of curvature with method = map and loop.follow"
        raise SettingsError("feedback.controller", rule, "kalman")
    if loop.sensor == "linear-curvature" or loop.handover:
        return handed_over(config, light)
    if isinstance(light.optics, LensletOptics):
        return FollowedSpots.build(config, light, light.optics)
    if isinstance(light.optics, PyramidOptics):
        if config.pyramid.reconstructor == "map":
            return SearchingPyramid.build(config, light, light.optics)
        return FollowedPyramid.build(config, light, light.optics)
    if config.loop.sensor == "ideal":
        return IdealMeasurement(light)
    if method == "map" and loop.follow:
        followed = FollowedCurvature.build(config, light)
        return (wind_is_told(config) and carried_curvature(followed, config, light, None)) or followed
    return SingleFrames.build(config, light)


def wind_is_told(config: Config) -> bool:
    """Whether Kalman's filter of the curvature sensor can be made before anything was seen.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> wind_is_told(load_config(None, ["feedback.controller=kalman", "estimation.prior.wind_direction_deg=30"]))
        True
    """
    told = config.feedback.controller == "kalman" and config.estimation.prior.wind_direction_deg is not None
    return told and config.loop.sensor == "curvature"
