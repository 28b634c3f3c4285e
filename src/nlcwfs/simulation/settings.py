"""What a user may choose about a simulated exposure."""

from pydantic import BaseModel, ConfigDict, Field


class SimulationSettings(BaseModel):
    """How many exposures are simulated, and on which grid their light travels.

    The light travels on a finer and wider grid than the detector's pixels, so that no reconstructor meets
    images made by its own model (no inverse crime).

    Examples:
        >>> SimulationSettings().light_oversampling
        4
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    frames: int = Field(default=1, ge=1, le=1_000_000, description="Independent exposures, each of another sky.")
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
