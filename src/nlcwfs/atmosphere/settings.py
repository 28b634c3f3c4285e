"""What a user may choose about the star and the air."""

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator

_OF_A_SEQUENCE = ("layer_fractions", "wind_speeds_m_per_s", "wind_directions_deg", "screen_width_m", "photons_per_s")


class AtmosphereSettings(BaseModel):
    """The star and the turbulence above the telescope."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    photons: float = Field(
        default=2e4,
        gt=0,
        description="photons that the whole sensor gets in one exposure, shared by its planes",
    )
    photons_per_s: float | None = Field(
        default=None,
        gt=0,
        examples=[3e6],
        description="photons that the whole sensor gets in a second of a loop; when given it rules instead of photons",
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
    layer_fractions: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        default=(1.0,),
        min_length=1,
        description="share of the turbulence in each layer, sum 1; this and the winds are for sequences only",
    )
    wind_speeds_m_per_s: tuple[Annotated[float, Field(ge=0, le=1000)], ...] = Field(
        default=(10.0,), min_length=1, description="speed of the wind in each layer"
    )
    wind_directions_deg: tuple[Annotated[float, Field(ge=-360, le=360)], ...] = Field(
        default=(0.0,), min_length=1, description="where each layer goes to: 0 is towards +x, 90 towards +y"
    )
    screen_width_m: float | None = Field(
        default=None,
        gt=0,
        examples=[200.0],
        description="width of the air that the wind carries past, after which it repeats; leave out for 12 telescopes",
    )

    @model_validator(mode="after")
    def _layers_agree(self) -> "AtmosphereSettings":
        layers = len(self.layer_fractions)
        for name in ("wind_speeds_m_per_s", "wind_directions_deg"):
            if len(getattr(self, name)) != layers:
                raise ValueError(f"{name} must be one per layer, {layers} as in layer_fractions")
        if abs(sum(self.layer_fractions) - 1) > 1e-6:
            raise ValueError("layer_fractions must sum to 1")
        return self

    @model_serializer(mode="wrap")
    def _without_wind_that_is_default(self, write: Callable[["AtmosphereSettings"], dict[str, Any]]) -> dict[str, Any]:
        """Keep the fingerprint of single exposures, which know no wind, as it was before there was one."""
        values, fields = write(self), type(self).model_fields
        unused = {name for name in _OF_A_SEQUENCE if getattr(self, name) == fields[name].default}
        return {name: value for name, value in values.items() if name not in unused}
