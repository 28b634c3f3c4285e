"""What a user may choose about the telescope's pupil and the light."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, model_validator


class BeamSettings(BaseModel):
    """The pupil of the telescope and the wavelength of sensing; defaults are Table 1 of Guyon 2010.

    Examples:
        >>> BeamSettings().diameter_m
        8.0
        >>> BeamSettings(spider_count=4).spider_width_m
        0.05
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    diameter_m: float = Field(default=8.0, ge=0.01, le=100, description="Diameter of the telescope.")
    obstruction_ratio: float = Field(
        default=0.0, ge=0, lt=1, description="Diameter of the central obstruction over that of the telescope."
    )
    spider_count: int = Field(default=0, ge=0, le=64, description="Number of vanes that hold the secondary mirror.")
    spider_width_m: float = Field(
        default=0.05, gt=0, allow_inf_nan=False, description="Width of a vane; unused without vanes."
    )
    spider_angle_deg: float = Field(
        default=0.0,
        ge=-360,
        le=360,
        description="Angle of the first vane from +x towards +y; the others follow at equal angles.",
    )
    pupil_map: Path | None = Field(
        default=None,
        examples=["pupil.fits"],
        description="FITS image of the pupil's amplitude, 0 to 1; replaces circle, obstruction and vanes.",
    )
    wavelength_um: float = Field(default=0.85, ge=0.2, le=30, description="Wavelength at which the sensor works.")

    @model_validator(mode="after")
    def _vanes_fit(self) -> "BeamSettings":
        if self.spider_count and self.spider_width_m >= self.diameter_m:
            raise ValueError("spider_width_m must be smaller than diameter_m")
        return self
