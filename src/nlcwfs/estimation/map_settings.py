"""What a user may choose about the maximum a posteriori reconstruction; defaults by measurement (study 02)."""

from collections.abc import Callable
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_serializer

from nlcwfs.estimation.gerchberg_saxton_settings import GerchbergSaxtonSettings


class MapSettings(BaseModel):
    """The maximum a posteriori (MAP) reconstructor.

    Examples:
        >>> MapSettings().oversampling
        2
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    capture: GerchbergSaxtonSettings = Field(
        default=GerchbergSaxtonSettings(coarse_cutoffs_cpa=(2.0, 4.0, 8.0), iterations=5),
        description="how the first guess is found, coarse to fine",
    )
    segment_capture: GerchbergSaxtonSettings = Field(
        default=GerchbergSaxtonSettings(
            scheme="serial",
            amplitude="replace",
            filter="none",
            coarse_cutoffs_cpa=(),
            iterations=50,
            gain=1.0,
            fast_forward=0.7,
            tolerance_rad=0.002,
            oversampling=2,
        ),
        description="the same on a pupil made of segments: on the field, whose steps no filter may smooth",
    )
    wavelengths: int = Field(
        default=1,
        ge=1,
        le=32,
        description="Wavelengths by which the model stands for light of a band; 1 takes all light for that of the "
        "wavelength of sensing, as in the paper. Each costs as much as the first.",
    )
    membrane_moments: int = Field(
        default=1,
        ge=1,
        le=64,
        description="Moments by which the model follows a membrane that vibrates like a sine; 1 lets its planes "
        "rest at their mean distances. Each costs as much as the first, for each wavelength.",
    )
    star: Literal["point", "told"] = Field(
        default="point",
        description="whether a model of one wavelength knows the size of the star, as one of several always does: it "
        "takes the light for that of a point, or for that of atmosphere.star",
    )
    oversampling: int = Field(
        default=2, ge=1, le=8, description="cells of the model per detector pixel along an axis; costs its square"
    )
    window: float = Field(
        default=2.0, ge=1.2, le=10, description="least width of the model's window over the telescope's diameter"
    )
    steps: int = Field(default=3, ge=1, le=1000, description="most Gauss-Newton steps of one solution")
    conjugate_gradients: int = Field(default=6, ge=1, le=1000, description="conjugate gradients of each step")
    tolerance: float = Field(
        default=0.01,
        ge=0,
        description="stop when a step promises less than this many nats for each mode that the light shows",
    )
    amplitude: Literal["known", "estimated"] = Field(
        default="known",
        description="amplitude of the light at the pupil: known, that of the telescope; or estimated beside the phase, "
        "for scintillation, from the layers of estimation.prior.layer_heights_km",
    )
    amplitude_steps: int = Field(
        default=9, ge=1, le=1000, description="most Gauss-Newton steps with the amplitude free, after those without"
    )
    dark_share: float = Field(
        default=0.01,
        ge=0,
        le=10,
        description="share of the mean count that counts as noise everywhere: light of the turbulence that is finer "
        "than the model",
    )
    fits_background: bool = Field(default=False, description="estimate a background for each plane")
    flux: Literal["measured", "given"] = Field(
        default="measured", description="share of the light of each plane: from the counts, or as the sensor is told"
    )
    healings: int = Field(
        default=4, ge=0, le=100, description="most tries to bring back islands of the phase that are a turn off"
    )
    healing_iterations: int = Field(
        default=8, ge=1, le=1000, description="Gerchberg-Saxton iterations on the field of each try"
    )
    healing_gain: float = Field(default=2.0, gt=0, le=10, description="length of their steps")
    agreement: float = Field(
        default=1.0,
        gt=0,
        le=10,
        description="two solutions are one if they differ by less than this many expected errors; less than 1 finds "
        "smaller islands where the turbulence is very strong, for more healings",
    )
    ffts_per_frame: int = Field(
        default=100,
        ge=1,
        le=1000000,
        description="FFTs for each frame of a sequence after the first, of each wavelength and moment of the model",
    )
    turn_sweeps: int = Field(
        default=6,
        ge=0,
        le=100,
        description="most times that other whole wavelengths of a pupil's segments are looked for, in a model of many "
        "wavelengths; 0 leaves those of the first guess",
    )
    sequence_steps: int = Field(
        default=3, ge=1, le=100, description="Gauss-Newton steps for each frame of a sequence after the first"
    )

    @model_serializer(mode="wrap")
    def _without_keys_that_do_nothing(self, write: Callable[["MapSettings"], dict[str, Any]]) -> dict[str, Any]:
        """Keep the fingerprint of settings as it was before there were these keys."""
        new = {"membrane_moments": 1, "star": "point", "amplitude": "known"}
        return {key: value for key, value in write(self).items() if key not in new or value != new[key]}
