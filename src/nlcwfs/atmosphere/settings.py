"""What a user may choose about the star and the air."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator

_LATER_KEYS = (
    "layer_fractions",
    "layer_heights_km",
    "wind_speeds_m_per_s",
    "wind_directions_deg",
    "screen_width_m",
    "photons_per_s",
    "dispersion",
    "star",
)

FARTHEST_ZENITH_DEG = 75.0
"""Nearer to the horizon refraction is no longer a sum of two powers of the tangent (ERFA: 1 mas at 75 degrees)."""


class DispersionSettings(BaseModel):
    """Refraction of light of many colours, and its corrector; nothing at the zenith, and for light of one wavelength.

    Examples:
        >>> DispersionSettings(zenith_deg=40.0, corrector="share").remaining_share
        0.05
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    zenith_deg: float = Field(
        default=0.0, ge=0, le=FARTHEST_ZENITH_DEG, description="angle between the star and the zenith"
    )
    direction_deg: float = Field(
        default=90.0,
        ge=-360,
        le=360,
        description="where bluer light goes on its way from the pupil: 0 is towards +x, 90 towards +y",
    )
    corrector: Literal["none", "share", "two-nulls"] = Field(
        default="none",
        description="the atmospheric dispersion corrector: none; one that leaves a share; or one without dispersion at "
        "two wavelengths, which takes out what is linear in the wavelength",
    )
    remaining_share: float = Field(
        default=0.05, ge=0, le=1, description="share of the dispersion that a corrector of kind share leaves"
    )
    nulls_um: tuple[Annotated[float, Field(ge=0.3, le=2.5)], ...] | None = Field(
        default=None,
        min_length=2,
        max_length=2,
        examples=[(0.72, 0.98)],
        description="the two wavelengths of a corrector of kind two-nulls",
    )
    pressure_hpa: float = Field(default=616.0, ge=100, le=1100, description="pressure of the air; Mauna Kea by default")
    temperature_k: float = Field(default=273.0, ge=200, le=330, description="temperature of the air")
    humidity_ratio: float = Field(default=0.3, ge=0, le=1, description="relative humidity of the air, 1 is saturated")

    @model_validator(mode="after")
    def _nulls_are_two(self) -> "DispersionSettings":
        if self.corrector == "two-nulls" and self.nulls_um is None:
            raise ValueError("nulls_um must be given for a corrector of kind two-nulls")
        if self.nulls_um is not None and self.nulls_um[0] == self.nulls_um[1]:
            raise ValueError("nulls_um must be two different wavelengths")
        return self


class StarSettings(BaseModel):
    """A star of a magnitude instead of a number of photons, for sequences and loops; and its size, for all exposures.

    Without a magnitude, band, throughput and bandwidth do nothing.

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
    size_mas: float = Field(
        default=0.0,
        ge=0,
        le=1e5,
        description="diameter of the star's disc, or full width at half maximum of a Gaussian one; 0 is a point",
    )
    profile: Literal["disc", "gaussian"] = Field(default="disc", description="a disc of equal light, or a Gaussian one")

    @property
    def light(self) -> tuple[str, float, float]:
        """Band, throughput, bandwidth in um; what is left out is as in Guyon 2010: V 13 sends 3.2e6 photons/s."""
        throughput = 0.2 if self.throughput is None else self.throughput
        return self.band or "V", throughput, 0.5 if self.bandwidth_um is None else self.bandwidth_um

    @model_serializer(mode="wrap")
    def _without_size_of_a_point(self, write: Callable[["StarSettings"], dict[str, Any]]) -> dict[str, Any]:
        """Keep the fingerprint of a point as it was before stars had a size."""
        values = write(self)
        return {name: value for name, value in values.items() if self.size_mas or name not in ("size_mas", "profile")}


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
        description="share of the turbulence in each layer, sum 1; winds are for sequences only",
    )
    layer_heights_km: tuple[Annotated[float, Field(ge=0, le=100)], ...] | None = Field(
        default=None,
        min_length=1,
        examples=[(10.0,)],
        description="height of each layer above the telescope, whose air then changes the amplitude, too "
        "(scintillation); leave out for 0",
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

    dispersion: DispersionSettings = Field(default_factory=DispersionSettings)
    star: StarSettings = Field(default_factory=StarSettings)

    @model_validator(mode="after")
    def _light_is_told_once(self) -> "AtmosphereSettings":
        if self.photons_per_s is not None and self.star.magnitude is not None:
            raise ValueError("photons_per_s must be left out with atmosphere.star.magnitude, which rules instead")
        return self

    @model_validator(mode="after")
    def _layers_agree(self) -> "AtmosphereSettings":
        layers = len(self.layer_fractions)
        for name in ("wind_speeds_m_per_s", "wind_directions_deg", "layer_heights_km"):
            if len(getattr(self, name) or self.layer_fractions) != layers:
                raise ValueError(f"{name} must be one per layer, {layers} as in layer_fractions")
        if abs(sum(self.layer_fractions) - 1) > 1e-6:
            raise ValueError("layer_fractions must sum to 1")
        return self

    @property
    def heights_m(self) -> tuple[float, ...]:
        """Height of each layer; empty where all are at the telescope, so that nothing scintillates."""
        heights_km = self.layer_heights_km or ()
        return tuple(1e3 * height_km for height_km in heights_km) if any(heights_km) else ()

    @model_serializer(mode="wrap")
    def _without_wind_that_is_default(self, write: Callable[["AtmosphereSettings"], dict[str, Any]]) -> dict[str, Any]:
        """Keep the fingerprint of settings that know no wind, dispersion or star, as it was before there were any."""
        values, fields = write(self), type(self).model_fields
        unused = {
            name for name in _LATER_KEYS if getattr(self, name) == fields[name].get_default(call_default_factory=True)
        }
        unused |= set() if self.heights_m else {"layer_heights_km"}
        return {name: value for name, value in values.items() if name not in unused}
