"""What a user may choose about Gerchberg and Saxton's algorithm; every default was chosen by measurement (study 01)."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class GerchbergSaxtonSettings(BaseModel):
    """The paper's algorithm and its accelerations, each of which can be switched off.

    Examples:
        >>> GerchbergSaxtonSettings().start
        'tilt'
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    start: Literal["flat", "tilt"] = Field(
        default="tilt", description="first guess: flat, or the tilt that the centroids of the images show"
    )
    scheme: Literal["averaged", "serial"] = Field(
        default="averaged",
        description="averaged: all planes at once, 10 FFTs for four; serial: the pupil after each plane, 16 FFTs",
    )
    amplitude: Literal["poisson", "replace"] = Field(
        default="poisson",
        description="poisson: step towards the measured modulus as far as its noise allows; replace: take it",
    )
    filter: Literal["turbulence", "low-pass", "none"] = Field(
        default="turbulence",
        description="inside the loop. turbulence: carry the unwrapped phase and smooth it like Kolmogorov's "
        "(no wraps, no vortices); low-pass: of the returning light, exp(-(f/low_pass_cpa)^4)",
    )
    low_pass_cpa: float = Field(default=14.0, gt=0, description="cut of the low-pass filter, cycles per aperture")
    coarse_cutoffs_cpa: tuple[float, ...] = Field(
        default=(2.0, 3.0, 4.0, 6.0, 8.0, 12.0),
        description="coarse to fine: finest wave of the phase, cycles per aperture, level by level; [] = none",
    )
    coarse_iterations: int = Field(default=8, ge=1, le=10000, description="iterations of each coarse level")
    coarse_gain: float = Field(default=6.0, gt=0, le=100, description="length of a step on the coarse levels")
    coarse_fast_forward: float = Field(default=0.85, ge=0, lt=1, description="fast-forward of the coarse levels")
    coarse_doubt: float = Field(
        default=0.2, ge=0, le=10, description="relative variance of the model's light on the coarse levels"
    )
    smoothing: float = Field(
        default=0.022,
        ge=0,
        le=1,
        description="Gaussian that smooths the images on the coarse levels, and the counts from which the noise is "
        "known on all; standard deviation over the telescope's diameter",
    )
    binning: int = Field(
        default=1, ge=1, le=8, description="pixels binned on the levels that need no finer ones; 1 = never"
    )
    iterations: int = Field(default=20, ge=1, le=100000, description="most iterations at full resolution")
    gain: float = Field(default=1.5, gt=0, le=10, description="length of a step; 1 is Gerchberg and Saxton's")
    fast_forward: float = Field(
        default=0.7, ge=0, lt=1, description="share of the last step added ahead of the next one; 0 = none"
    )
    tolerance_rad: float = Field(
        default=0.01,
        ge=0,
        description="stop when an iteration moves the phase by less than this rms; 0 = never",
    )
    oversampling: int = Field(
        default=1,
        ge=1,
        le=8,
        description="cells of the model per detector pixel along an axis; costs its square",
    )
