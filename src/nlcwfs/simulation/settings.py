"""What a user may choose about a simulated exposure."""

from collections.abc import Callable
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_serializer

_OF_A_SEQUENCE = ("rate_hz", "substeps")


class SimulationSettings(BaseModel):
    """How many exposures are simulated, and on which grid their light travels.

    The light travels on a finer and wider grid than the detector's pixels, so that no reconstructor meets
    images made by its own model (no inverse crime).

    Examples:
        >>> SimulationSettings().light_oversampling
        4
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    frames: int = Field(
        default=1,
        ge=1,
        le=1_000_000,
        description="Exposures: independent, each of another sky, or successive ones in a sequence.",
    )
    light_oversampling: int = Field(
        default=4, ge=2, le=32, description="Cells of the light's grid along a side of a detector pixel."
    )
    light_window: float = Field(
        # D + 2 z alpha of Guyon 2010, sec. 2.5, is 19.9 m for the farthest plane of Table 1 with alpha = 16
        # lambda / D, wider than half its seeing; twice the default window of the detector is 22.8 m.
        default=2.0,
        ge=1,
        le=16,
        description="Width of the light's window over that of the detector's window. It must hold D + 2 z "
        "alpha, the pupil and the light that spreads by the angle alpha over the distance z of the farthest "
        "plane: what leaves it comes back in on the other side.",
    )
    rate_hz: float | None = Field(
        default=None,
        gt=0,
        examples=[1000.0],
        description="Exposures in a second of a sequence (simulate --sequence); each lasts until the next begins.",
    )
    substeps: int = Field(
        default=4,
        ge=1,
        le=1000,
        description="Moments of an exposure of a sequence, evenly spread, whose light is summed while the air moves.",
    )

    @model_serializer(mode="wrap")
    def _without_time_that_is_default(self, write: Callable[["SimulationSettings"], dict[str, Any]]) -> dict[str, Any]:
        """Keep the fingerprint of single exposures, which know no time, as it was before there was one."""
        values, fields = write(self), type(self).model_fields
        unused = {name for name in _OF_A_SEQUENCE if getattr(self, name) == fields[name].default}
        return {name: value for name, value in values.items() if name not in unused}
