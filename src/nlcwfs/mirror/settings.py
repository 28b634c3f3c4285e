"""What a user may choose about the deformable mirror."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class MirrorSettings(BaseModel):
    """The deformable mirror: the shapes that it can take, and how far.

    Examples:
        >>> MirrorSettings().kind
        'karhunen-loeve'
        >>> MirrorSettings(kind="actuators", actuators_across=17).coupling
        0.15
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Literal["karhunen-loeve", "zernike", "fourier", "actuators"] = Field(
        default="karhunen-loeve",
        description="shapes of the mirror: ideal ones, of which each command moves a whole mode, or actuators",
    )
    cutoff_cpa: float = Field(
        default=16.0,
        ge=1,
        le=500,
        description="highest spatial frequency of the modes, cycles per aperture; unused with actuators",
    )
    modes: int | None = Field(
        default=None,
        ge=1,
        le=100000,
        examples=[300],
        description="number of modes; when given it rules instead of the cutoff",
    )
    actuators_across: int = Field(
        default=33, ge=2, le=1000, description="actuators along a diameter, both ends counted; used with actuators"
    )
    coupling: float = Field(
        default=0.15,
        gt=0,
        lt=1,
        description="height of an actuator's Gaussian at the next actuator, of 1 at its own; used with actuators",
    )
    stroke_um: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        examples=[4.0],
        description="largest command to either side, as optical path difference; leave out for no limit",
    )

    @model_validator(mode="after")
    def _shapes_are_counted_once(self) -> "MirrorSettings":
        if self.kind == "actuators" and self.modes is not None:
            raise ValueError("modes must be left out with actuators, which actuators_across counts")
        return self
