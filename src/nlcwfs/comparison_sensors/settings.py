"""What a user may choose about a Shack-Hartmann sensor."""

from pydantic import BaseModel, ConfigDict, Field, model_validator


class ShackHartmannSettings(BaseModel):
    """The lenslets, and the pixels behind each.

    Examples:
        >>> ShackHartmannSettings().subapertures
        18
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    subapertures: int = Field(
        default=18, ge=2, le=128, description="subapertures across the diameter of the telescope, D/d"
    )
    pixels: int = Field(default=64, ge=2, le=256, description="detector pixels along a side of a subaperture's image")
    field_lambda_over_d: float = Field(
        default=8.0,
        ge=2,
        le=64,
        description="width of a subaperture's field of view in units of wavelength / d; light beyond it is stopped",
    )
    least_light: float = Field(
        default=0.7, gt=0, le=1, description="a subaperture serves if it gets this share of the light of a full one"
    )

    @model_validator(mode="after")
    def _pixels_see_the_spot(self) -> "ShackHartmannSettings":
        if self.field_lambda_over_d / self.pixels > 2:
            raise ValueError("pixels must be at least field_lambda_over_d / 2: larger ones do not see the spot move")
        return self
