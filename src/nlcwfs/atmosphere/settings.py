"""What a user may choose about the star and the air."""

from pydantic import BaseModel, ConfigDict, Field


class AtmosphereSettings(BaseModel):
    """The star and the turbulence above the telescope."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    photons: float = Field(
        default=2e4,
        gt=0,
        description="photons that the whole sensor gets in one exposure, shared by its planes",
    )
    seeing_arcsec: float = Field(
        default=0.6, gt=0, le=10, description="full width at half maximum of a long exposure at 0.5 um"
    )
    outer_scale_m: float | None = Field(
        default=None,
        gt=0,
        examples=[25.0],
        description="von Karman's outer scale; leave out for Kolmogorov (infinite)",
    )
    opd_rms_nm: float | None = Field(
        default=None,
        gt=0,
        examples=[609.0],
        description="mean rms of the wavefront over the telescope, tilt included; when given it rules "
        "instead of the seeing",
    )
