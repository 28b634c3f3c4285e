"""What a user may choose about the telescope's pupil and the light."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class SegmentsSettings(BaseModel):
    """A pupil made of segments, and how these stand; see docs/pupils.md.

    Examples:
        >>> SegmentsSettings(layout="discs", centres_m=((0.0, -2.5), (0.0, 2.5)), widths_m=(3.0,)).pistons_nm
        ()
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    layout: Literal["none", "sparse", "gmt", "keck", "elt", "discs", "hexagons"] = Field(
        default="none",
        description="Where the segments are: sparse, four 2.4 m discs in 8 m; gmt, seven mirrors in 25.4 m; keck, 36 "
        "hexagons in 11 m; elt, 798 in 40.2 m; discs or hexagons, by centres_m and widths_m.",
    )
    centres_m: tuple[tuple[float, float], ...] = Field(
        default=(), description="Centre (y, x) of every disc or hexagon; segments must not overlap."
    )
    widths_m: tuple[float, ...] = Field(
        default=(), description="Diameter of a disc, or distance of opposite sides of a hexagon: one, or one each."
    )
    angle_deg: float = Field(
        default=0.0, ge=-360, le=360, description="Normal of a side of hexagons given by centres_m, from +x towards +y."
    )
    pistons_nm: tuple[float, ...] = Field(
        default=(), description="Simulated piston of every segment, path; [] for none."
    )
    piston_range_nm: float = Field(
        default=0.0,
        ge=0,
        le=1e6,
        description="Simulated pistons are drawn anew for each frame, evenly from minus to plus this, and added.",
    )
    tilt_rms_nm: float = Field(
        default=0.0,
        ge=0,
        le=1e5,
        description="Rms over a segment of its simulated tilt along each axis, drawn anew for each frame.",
    )

    @model_validator(mode="after")
    def _places_go_with_the_layout(self) -> "SegmentsSettings":
        given = self.layout in ("discs", "hexagons")
        if given and not self.centres_m:
            raise ValueError(f"centres_m must be given with layout = {self.layout}")
        if not given and (self.centres_m or self.widths_m):
            raise ValueError("centres_m and widths_m must be left out unless layout is discs or hexagons")
        if given and len(self.widths_m) not in (1, len(self.centres_m)):
            raise ValueError(f"widths_m must be one, or one for each of {len(self.centres_m)} centres_m")
        if self.layout == "none" and (self.pistons_nm or self.piston_range_nm or self.tilt_rms_nm):
            raise ValueError("pistons_nm, piston_range_nm and tilt_rms_nm must be left out without a layout")
        return self


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
    segments: SegmentsSettings = Field(default_factory=SegmentsSettings)
    wavelength_um: float = Field(default=0.85, ge=0.2, le=30, description="Wavelength at which the sensor works.")

    @model_validator(mode="after")
    def _vanes_fit(self) -> "BeamSettings":
        if self.spider_count and self.spider_width_m >= self.diameter_m:
            raise ValueError("spider_width_m must be smaller than diameter_m")
        if self.segments.layout != "none" and self.pupil_map is not None:
            raise ValueError("pupil_map must be left out with segments.layout")
        return self
