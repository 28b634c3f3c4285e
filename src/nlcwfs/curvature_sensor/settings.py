"""What a user may choose about the optics of the sensor."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator

FARTHEST_KM = 1e6
"""Farthest distance of a plane to either side."""


class CurvatureSensorSettings(BaseModel):
    """The planes in which the pupil is imaged out of focus, and how they share the light."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    distances_km: tuple[Annotated[float, Field(ge=-FARTHEST_KM, le=FARTHEST_KM)], ...] = Field(
        default=(-3500.0, -2500.0, 2500.0, 3500.0),
        min_length=1,
        description="where the planes lie, at the scale of the telescope; positive is downstream of the pupil",
    )
    defocus_waves: tuple[Annotated[float, Field(ge=-1e4, le=1e4)], ...] | None = Field(
        default=None,
        min_length=1,
        examples=[(-2.0, 2.0)],
        description="instead of distances_km, phase diversity: defocus of each image of the star, waves from peak to "
        "valley over the pupil; the sign is that of the distance, which is D^2 / (8 wavelength waves)",
    )
    flux_fractions: tuple[float, ...] | None = Field(
        default=None,
        examples=[(0.3, 0.2, 0.2, 0.3)],
        description="share of the light of each plane, sum 1; leave out for equal shares",
    )
    lenses: Literal["achromatic", "ideal", "doublet"] = Field(
        default="achromatic",
        description="where the planes are in colours other than beam.wavelength_um: at the same distances; at those "
        "that keep distance times wavelength; or where two glasses put them that come near this",
    )
    glasses: tuple[str, ...] = Field(
        default=("N-FK51A", "N-SF66"),
        min_length=2,
        max_length=2,
        description="the glasses of a doublet, by their names in the catalogue of SCHOTT, silica or CaF2",
    )
    membrane: Literal["none", "sine", "square"] = Field(
        default="none",
        description="a membrane that vibrates between the planes at +z and -z, in place of beam splitters: the "
        "distances are the mean ones over half a period of a sine, or those where it rests",
    )
    membrane_dead_share: float = Field(
        default=0.0, ge=0, lt=1, description="share of the time in which nothing is integrated, while it turns"
    )
    static_rms_nm: float = Field(
        default=0.0, ge=0, description="rms of a known static Kolmogorov aberration in the arm of the sensor"
    )
    static_seed: int = Field(default=0, ge=0, description="which static aberration; the same number is the same shape")

    @model_validator(mode="after")
    def _planes_agree(self) -> "CurvatureSensorSettings":
        default = type(self).model_fields["distances_km"].default  # a file of all defaults does not choose them
        if self.defocus_waves is not None and self.distances_km != default:
            raise ValueError("defocus_waves must be left out with distances_km: they say the same in other words")
        name = "distances_km" if self.defocus_waves is None else "defocus_waves"
        places = self.distances_km if self.defocus_waves is None else self.defocus_waves
        if len(set(places)) < len(places):
            raise ValueError(f"{name} must differ from each other")
        if self.defocus_waves is not None and 0 in self.defocus_waves:
            raise ValueError("defocus_waves must not be 0: an image in focus is at no distance")
        if all(place == 0 for place in places):
            raise ValueError("distances_km must hold a plane out of the pupil: one at 0 does not see the phase")
        if self.membrane != "none" and sorted(places) != sorted(-place for place in places):
            raise ValueError(f"{name} must be pairs with a membrane, one plane at +z for each at -z")
        if self.membrane == "none" and self.membrane_dead_share:
            raise ValueError("membrane_dead_share must be 0 without a membrane")
        if self.flux_fractions is None:
            return self
        if len(self.flux_fractions) != len(places):
            raise ValueError("flux_fractions must be one per plane")
        if min(self.flux_fractions) <= 0 or abs(sum(self.flux_fractions) - 1) > 1e-6:
            raise ValueError("flux_fractions must be positive and sum to 1")
        return self

    @model_serializer(mode="wrap")
    def _without_keys_that_do_nothing(
        self, write: Callable[["CurvatureSensorSettings"], dict[str, Any]]
    ) -> dict[str, Any]:
        """Keep the fingerprint of settings as it was before there were these keys."""
        unused = {"defocus_waves": self.defocus_waves is None, "lenses": self.lenses == "achromatic"}
        unused["glasses"] = self.lenses != "doublet"
        unused |= dict.fromkeys(("membrane", "membrane_dead_share"), self.membrane == "none")
        return {name: value for name, value in write(self).items() if not unused.get(name, False)}
