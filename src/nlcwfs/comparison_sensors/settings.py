"""What a user may choose about the sensors that ours is compared with."""

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

FARTHEST_POINTS = 0.8
"""Most that points of a modulation may lie apart, in units of wavelength / D."""


class ShackHartmannSettings(BaseModel):
    """The lenslets, the pixels behind each, and what a loop makes of them.

    Examples:
        >>> ShackHartmannSettings().subapertures
        18
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    subapertures: int = Field(
        default=18, ge=2, le=128, description="Subapertures across the diameter of the telescope, D/d."
    )
    pixels: int = Field(default=64, ge=2, le=256, description="Detector pixels along a side of a subaperture's image.")
    field_lambda_over_d: float = Field(
        default=8.0,
        ge=2,
        le=64,
        description="Width of a subaperture's field of view in units of wavelength / d; light beyond it is stopped.",
    )
    least_light: float = Field(
        default=0.7, gt=0, le=1, description="A subaperture serves if it gets this share of the light of a full one."
    )
    centroid: Literal["matched", "gravity", "thresholded", "weighted"] = Field(
        default="matched",
        description="How a spot's place is found: matched filter on the running mean spot, centre of gravity of all "
        "light in the window, the same after a threshold, or under a Gaussian weight.",
    )
    window_lambda_over_d: float | None = Field(
        default=None,
        gt=0.5,
        le=64,
        examples=[4.0],
        description="Width of the window in which light is looked at, in units of wavelength / d; leave out for the "
        "whole field.",
    )
    threshold: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="Share of a spot's brightest pixel that is taken off all of them, when thresholded.",
    )
    weight_lambda_over_d: float = Field(
        default=2.0,
        gt=0,
        le=64,
        description="Full width at half maximum of the Gaussian weight, in units of wavelength / d, when weighted.",
    )
    cutoff_cpa: float | None = Field(
        default=None,
        gt=0.5,
        le=500,
        examples=[12.0],
        description="Highest frequency that the mirror is driven at, cycles per aperture; leave out for half the "
        "subapertures across, all that they see.",
    )
    memory: float = Field(
        default=0.9, ge=0, lt=1, description="Weight of what was known in each update of the running mean spot."
    )

    @model_validator(mode="after")
    def _pixels_see_the_spot(self) -> "ShackHartmannSettings":
        if self.field_lambda_over_d / self.pixels > 2:
            raise ValueError("pixels must be at least field_lambda_over_d / 2: larger ones do not see the spot move")
        return self


class PyramidSettings(BaseModel):
    """The prism in the focus, how the star circles over its tip, and the pixels of its four pupil images.

    Examples:
        >>> PyramidSettings().read_across
        60
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    modulation_lambda_over_d: float = Field(
        default=3.0,
        ge=0,
        le=100,
        description="Radius of the circle that the star describes on the prism in each exposure, in units of "
        "wavelength / D; 0 for a fixed pyramid.",
    )
    modulation_points: int = Field(
        default=24,
        ge=4,
        le=1024,
        multiple_of=4,
        description="Points of that circle whose light is summed, at most 0.8 wavelength / D apart: between points "
        "that lie farther from each other the response to tilt is not even.",
    )
    pixels: int = Field(default=44, ge=2, le=1024, description="Detector pixels across a pupil image.")
    margin_pixels: int = Field(
        default=8, ge=0, le=512, description="Pixels that are read beyond each rim of a pupil image."
    )
    separation: float = Field(
        default=1.5,
        ge=1,
        le=10,
        description="From the centre of a pupil image to that of its neighbour, in diameters of the image.",
    )
    reconstructor: Literal["matrix", "map"] = Field(
        default="matrix",
        description="Matrix: linear, with the gain that the residual leaves; map: the most likely wavefront behind "
        "the images, expected as [estimation] says (the non-linear pyramid).",
    )
    cutoff_cpa: float | None = Field(
        default=None,
        gt=0.5,
        le=500,
        examples=[16.0],
        description="Highest frequency that the mirror is driven at, cycles per aperture; leave out for half the "
        "pixels across, all that they show.",
    )

    @model_validator(mode="after")
    def _circle_is_even(self) -> "PyramidSettings":
        # 3 lambda / D: with 16, 24 and 32 points the response to tilt varies by 41, 2 and 2 % within 0.6 lambda / D
        least = 4 * math.ceil(2 * math.pi * self.modulation_lambda_over_d / FARTHEST_POINTS / 4)
        if self.modulation_points < least:
            raise ValueError(f"modulation_points must be at least {least} on a circle so wide")
        return self

    @model_validator(mode="after")
    def _images_lie_apart(self) -> "PyramidSettings":
        if self.read_across > self.separation * self.pixels * (1 + 1e-9):
            raise ValueError(
                f"separation must be at least {self.read_across / self.pixels:.3g}: "
                f"{self.read_across} pixels are read of each image"
            )
        return self

    @property
    def read_across(self) -> int:
        """Pixels along a side of the square that is read around a pupil image."""
        return self.pixels + 2 * self.margin_pixels


class LinearCurvatureSettings(BaseModel):
    """The planes of a curvature sensor that is read by a matrix alone, near enough to the pupil to be linear.

    Examples:
        >>> LinearCurvatureSettings(distances_km=(-2000, -800, 800, 2000)).distances_km  # dual stroke
        (-2000.0, -800.0, 800.0, 2000.0)
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    distances_km: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] = Field(
        default=(-1000.0, 1000.0),
        min_length=2,
        examples=[(-2000.0, -800.0, 800.0, 2000.0)],
        description="where the planes lie, in pairs at +z and -z; two pairs are a dual stroke",
    )

    @model_validator(mode="after")
    def _planes_are_pairs(self) -> "LinearCurvatureSettings":
        planes = sorted(self.distances_km)
        pairs = planes == sorted(-distance for distance in planes) and 0 not in planes
        if not pairs or len(set(planes)) < len(planes):
            raise ValueError("distances_km must be pairs, one plane at +z for each at -z")
        return self
