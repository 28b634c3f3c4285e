"""What a user may choose about the telescope's pupil and the light."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator


class SpectrumSettings(BaseModel):
    """The colours of the light that the detector counts; one wavelength unless a shape is chosen.

    Light of shape line has the one wavelength of the reconstructor, beam.wavelength_um, and the other keys do nothing.

    Examples:
        >>> SpectrumSettings(shape="flat", bandwidth_ratio=0.4).bandwidth_um_at(0.85)
        0.34
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    shape: Literal["line", "flat", "black-body", "table"] = Field(
        default="line",
        description="one wavelength; as many photons at each wavelength of a band around beam.wavelength_um; a black "
        "body's through that band; or those of a table",
    )
    bandwidth_um: float | None = Field(
        default=None, gt=0, le=30, examples=[0.34], description="width of the band of a flat or a black body's light"
    )
    bandwidth_ratio: float | None = Field(
        default=None,
        gt=0,
        lt=2,
        examples=[0.4],
        description="instead of bandwidth_um, the width over beam.wavelength_um",
    )
    temperature_k: float = Field(default=5800.0, gt=0, le=1e6, description="temperature of a black body")
    table: Path | None = Field(
        default=None,
        examples=["spectrum.ecsv"],
        description="text file (ECSV or CSV) of two columns, wavelength in um and detected photons per wavelength",
    )
    wavelengths: int | None = Field(
        default=None,
        ge=1,
        le=128,
        examples=[9],
        description="how many wavelengths stand for the light; leave out for as many as the images need",
    )

    def bandwidth_um_at(self, wavelength_um: float) -> float:
        """Width of the band around a wavelength."""
        return self.bandwidth_um or (self.bandwidth_ratio or 0.0) * wavelength_um

    @model_validator(mode="after")
    def _shape_is_told(self) -> "SpectrumSettings":
        if self.bandwidth_um is not None and self.bandwidth_ratio is not None:
            raise ValueError("bandwidth_ratio must be left out with bandwidth_um: they say the same in other words")
        if self.shape in ("flat", "black-body") and self.bandwidth_um is None and self.bandwidth_ratio is None:
            raise ValueError(f"bandwidth_um must be given for light of shape {self.shape}")
        if self.shape == "table" and self.table is None:
            raise ValueError("table must be given for light of shape table")
        return self


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
    wavelength_um: float = Field(
        default=0.85,
        ge=0.2,
        le=30,
        description="Wavelength at which the sensor works: that of the reconstructor, at which distances are quoted.",
    )
    spectrum: SpectrumSettings = Field(default_factory=SpectrumSettings)

    @model_validator(mode="after")
    def _vanes_fit(self) -> "BeamSettings":
        if self.spider_count and self.spider_width_m >= self.diameter_m:
            raise ValueError("spider_width_m must be smaller than diameter_m")
        if self.segments.layout != "none" and self.pupil_map is not None:
            raise ValueError("pupil_map must be left out with segments.layout")
        return self

    @model_serializer(mode="wrap")
    def _without_colours_that_are_default(self, write: Callable[["BeamSettings"], dict[str, Any]]) -> dict[str, Any]:
        """Keep the fingerprint of light of one wavelength as it was before there were colours."""
        values = write(self)
        return {name: value for name, value in values.items() if name != "spectrum" or self.spectrum.shape != "line"}
