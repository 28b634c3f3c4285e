"""What a user may choose about the optics of the sensor."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator


class CurvatureSensorSettings(BaseModel):
    """The planes in which the pupil is imaged out of focus, and how they share the light."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    distances_km: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] = Field(
        default=(-3500.0, -2500.0, 2500.0, 3500.0),
        min_length=1,
        description="where the planes lie, at the scale of the telescope; positive is downstream of the pupil",
    )
    flux_fractions: tuple[float, ...] | None = Field(
        default=None,
        examples=[(0.3, 0.2, 0.2, 0.3)],
        description="share of the light of each plane, sum 1; leave out for equal shares",
    )
    static_rms_nm: float = Field(
        default=0.0, ge=0, description="rms of a known static Kolmogorov aberration in the arm of the sensor"
    )
    static_seed: int = Field(default=0, ge=0, description="which static aberration; the same number is the same shape")

    @model_validator(mode="after")
    def _planes_agree(self) -> "CurvatureSensorSettings":
        if len(set(self.distances_km)) < len(self.distances_km):
            raise ValueError("distances_km must differ from each other")
        if all(distance == 0 for distance in self.distances_km):
            raise ValueError("distances_km must hold a plane out of the pupil: one at 0 does not see the phase")
        if self.flux_fractions is None:
            return self
        if len(self.flux_fractions) != len(self.distances_km):
            raise ValueError("flux_fractions must be one per plane")
        if min(self.flux_fractions) <= 0 or abs(sum(self.flux_fractions) - 1) > 1e-6:
            raise ValueError("flux_fractions must be positive and sum to 1")
        return self
