"""What a user may tell about the phase before a photon is seen: the air, and the loop that flattens it."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class PriorSettings(BaseModel):
    """The turbulence that is expected, or what a closed loop leaves of it.

    Examples:
        >>> PriorSettings(outer_scale_m=25.0).cutoff_cpa is None  # no loop: the whole turbulence
        True
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    fried_m: float | None = Field(
        default=None,
        gt=0,
        examples=[0.17],
        description="Fried's parameter r0 at 0.5 um; when given it rules instead of the seeing",
    )
    outer_scale_m: float | None = Field(
        default=None,
        gt=0,
        examples=[25.0],
        description="von Karman's outer scale, at least the telescope's diameter; leave out for Kolmogorov (infinite)",
    )
    cutoff_cpa: float | None = Field(
        default=None,
        gt=0,
        examples=[16.0],
        description="finest wave that the mirror takes out, cycles per aperture; leave out where no loop is closed",
    )
    lag_s: float = Field(
        default=0.0, ge=0, description="from the middle of an exposure to the middle of its correction on the mirror"
    )
    wind_speed_m_per_s: float = Field(default=10.0, ge=0, description="speed of the wind")
    wind_direction_deg: float | None = Field(
        default=None,
        ge=-360,
        le=360,
        examples=[0.0],
        description="where the air goes, from +x towards +y, for sequences; leave out when not known",
    )
    photons: float | None = Field(
        default=None,
        gt=0,
        examples=[1e4],
        description="photons of the exposures that move the mirror; leave out for commands without noise",
    )
    sensor_loss: float = Field(
        default=3.0,
        ge=1,
        description="photons that the sensor of the loop needs relative to the quantum limit, see study 01",
    )
    beyond_share: float = Field(
        default=1.0, gt=0, le=1, description="share of the turbulence that is expected beyond the mirror's cutoff"
    )
    layer_heights_km: tuple[Annotated[float, Field(ge=0)], ...] | None = Field(
        default=None,
        min_length=1,
        examples=[(0.0, 10.0)],
        description="height of each layer of the air above the telescope along the line of sight, for "
        "estimation.map.amplitude = estimated",
    )
    layer_fractions: tuple[Annotated[float, Field(ge=0)], ...] | None = Field(
        default=None,
        min_length=1,
        examples=[(0.5, 0.5)],
        description="share of each layer in the turbulence, sum 1; leave out for equal shares",
    )
    scintillation_index: float | None = Field(
        default=None,
        gt=0,
        le=0.3,
        examples=[0.07],
        description="variance of the light of a point of the pupil over its mean squared; leave out where it is "
        "that of the turbulence that the phase shows",
    )
    segment_piston_nm: float = Field(
        default=1000.0, ge=0, description="rms piston of the segments of a pupil that is expected beside the air"
    )
    segment_tilt_nm: float = Field(
        default=100.0, ge=0, description="the same for their tilt along one axis, rms over a segment; 0 = rigid"
    )
