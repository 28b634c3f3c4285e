"""What a user may choose about the star and the air."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator

_OF_A_SEQUENCE = (
    "layer_fractions",
    "wind_speeds_m_per_s",
    "wind_directions_deg",
    "screen_width_m",
    "photons_per_s",
    "star",
)


class StarSettings(BaseModel):
    """A star of a magnitude, instead of a number of photons; for sequences and loops, whose exposures have a length.

    Without a magnitude the other keys do nothing.

    Examples:
        >>> StarSettings(magnitude=13.0, band="R").light
        ('R', 0.2, 0.5)
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    magnitude: float | None = Field(
        default=None,
        ge=-30,
        le=60,
        examples=[13.0],
        description="apparent magnitude on Vega's scale; when given it rules instead of photons",
    )
    band: Literal["U", "B", "V", "R", "I", "J", "H", "K"] | None = Field(
        default=None,
        examples=["V"],
        description="band of the magnitude, whose photons for each um count; leave out for V",
    )
    throughput: float | None = Field(
        default=None,
        gt=0,
        le=1,
        examples=[0.2],
        description="share of the photons that reach the detector through air and optics, its quantum efficiency not "
        "counted; leave out for 0.2, as in Guyon 2010",
    )
    bandwidth_um: float | None = Field(
        default=None,
        gt=0,
        le=10,
        examples=[0.5],
        description="width of the light that the sensor uses; leave out for 0.5, as in Guyon 2010",
    )

    @property
    def light(self) -> tuple[str, float, float]:
        """Band, throughput, bandwidth in um; what is left out is as in Guyon 2010: V 13 sends 3.2e6 photons/s."""
        throughput = 0.2 if self.throughput is None else self.throughput
        return self.band or "V", throughput, 0.5 if self.bandwidth_um is None else self.bandwidth_um


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
        description="photons that the whole sensor gets in a second of a loop or a sequence; when given it rules "
        "instead of photons",
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

    star: StarSettings = Field(default_factory=StarSettings)

    @model_validator(mode="after")
    def _light_is_told_once(self) -> "AtmosphereSettings":
        if self.photons_per_s is not None and self.star.magnitude is not None:
            raise ValueError("photons_per_s must be left out with atmosphere.star.magnitude, which rules instead")
        return self

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
        unused = {
            name
            for name in _OF_A_SEQUENCE
            if getattr(self, name) == fields[name].get_default(call_default_factory=True)
        }
        return {name: value for name, value in values.items() if name not in unused}
