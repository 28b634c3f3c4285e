"""What a user may choose about a closed loop."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class LoopSettings(BaseModel):
    """How long a loop runs, how fast, and with which sensor.

    Examples:
        >>> LoopSettings(rate_hz=500).frames
        500
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    rate_hz: float = Field(
        default=260.0, gt=0, le=1e5, description="Exposures in a second; each lasts until the next begins."
    )
    seconds: float = Field(default=1.0, gt=0, le=1e4, description="Simulated time.")
    substeps: int = Field(
        default=2,
        ge=1,
        le=1000,
        description="Moments of an exposure, evenly spread, whose light is summed while the air moves.",
    )
    sensor: Literal["curvature", "ideal", "linear-curvature", "pyramid", "shack-hartmann"] = Field(
        default="curvature",
        description="What measures: the curvature sensor with the method of [estimation], an ideal sensor that sees "
        "the mean wavefront without noise, the planes of [linear_curvature] with matrices alone, the prism of "
        "[pyramid], or the lenslets of [shack_hartmann].",
    )
    handover: bool = Field(
        default=False,
        description="Whether the curvature sensor is read by one matrix product a frame while its residual is small "
        "enough; else the method of [estimation] works.",
    )
    reference_nm: tuple[Annotated[float, Field(ge=-1e5, le=1e5)], ...] = Field(
        default=(),
        examples=[(0.0, 0.0, 30.0)],
        description="Wavefront that the loop leaves on its sensor so that the star's image is flat: coefficients of "
        "Zernike polynomials from Noll 2 on. None for the same wavefront on both.",
    )
    start: Literal["open", "closed"] = Field(
        default="open", description="Whether the mirror is flat at first, or already has the shape of the air."
    )
    capture_gain: float = Field(
        default=0.8, gt=0, le=1, description="Share of a wavefront that is not believed that the mirror takes out ..."
    )
    capture_cpa: float = Field(
        default=10.0, gt=0, description="... of its waves up to about so many cycles per aperture."
    )
    follow: bool = Field(
        default=True,
        description="Whether the method map expects of a frame what the last ones showed, for few FFTs; if not, every "
        "frame is reconstructed on its own.",
    )
    look_again_every: int = Field(
        default=5,
        ge=0,
        description="Frames from one slow second look at a followed frame to the next, which brings islands back that "
        "are a turn off; 0 for none.",
    )
    give_up_s: float = Field(
        default=0.5, gt=0, description="A loop that has not closed after so long ends; it is told that it cannot close."
    )
    learn_after_s: float = Field(
        default=0.5, gt=0, description="Closed time after which gains or predictions are learnt (feedback.controller)."
    )
    fault: Literal["none", "nan-frames", "lost-frames", "doubled-frames", "dead-plane", "bump"] = Field(
        default="none",
        description="What goes wrong on purpose: frames of NaN, frames that do not come, old frames again, the first "
        "plane dark (or a pupil image, or a quarter of the spots), or a bump in the wavefront that stays.",
    )
    fault_at_s: float = Field(default=0.5, ge=0, description="When it begins.")
    fault_s: float = Field(default=0.05, gt=0, description="How long it lasts.")
    bump_nm: float = Field(default=1000.0, ge=0, le=1e5, description="Rms of the bump.")
    science_wavelength_um: float = Field(
        default=0.85, gt=0.1, le=30, description="Wavelength of the star's image behind the mirror."
    )
    settle_s: float = Field(
        default=0.05, ge=0, description="Time after closing that does not count in the rms and the image."
    )

    @property
    def frames(self) -> int:
        """Exposures in all, at least one."""
        return max(1, round(self.seconds * self.rate_hz))
