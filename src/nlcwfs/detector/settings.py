"""What a user may choose about the detector."""

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from nlcwfs.detector.presets import IDEAL, PRESETS

_UNLIMITED = {"bits": 0, "full_well_electrons": math.inf}


class DetectorSettings(BaseModel):
    """The pixels of the detector, their window and their noise; what is not set comes from the preset.

    Electrons are counted before the multiplication register, except the read noise and the gain of the
    converter, which belong to the amplifier behind it. `None` means no limit for `bits` and
    `full_well_electrons`.

    Examples:
        >>> DetectorSettings().read_noise_electrons
        0.0
        >>> emccd = DetectorSettings(preset="EMCCD", read_noise_electrons=50)
        >>> emccd.read_noise_electrons, emccd.em_gain
        (50.0, 600.0)
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: Literal["ideal", "qCMOS", "EMCCD", "custom"] = Field(
        default="ideal",
        description="Fills every key below that is not set, except the pixels: ideal (photon noise only), "
        "qCMOS (Hamamatsu ORCA-Quest), EMCCD (OCAM2K), custom (starts from ideal).",
    )
    pixels_across_pupil: int = Field(
        default=90, ge=2, le=8192, description="Detector pixels across the diameter of the pupil."
    )
    window_pixels: int = Field(
        default=128, ge=2, le=8192, description="Detector pixels along a side of the square window around each image."
    )
    quantum_efficiency: float = Field(
        default=IDEAL["quantum_efficiency"], gt=0, le=1, description="Electrons per photon at the sensing wavelength."
    )
    background_photons: float = Field(
        default=IDEAL["background_photons"],
        ge=0,
        allow_inf_nan=False,
        description="Photons of the sky on each pixel in one exposure.",
    )
    dark_electrons: float = Field(
        default=IDEAL["dark_electrons"],
        ge=0,
        allow_inf_nan=False,
        description="Electrons that appear without light in each pixel in one exposure.",
    )
    read_noise_electrons: float = Field(
        default=IDEAL["read_noise_electrons"],
        ge=0,
        allow_inf_nan=False,
        description="Rms noise of the amplifier, in electrons behind the multiplication register.",
    )
    em_gain: float = Field(
        default=IDEAL["em_gain"],
        ge=1,
        allow_inf_nan=False,
        description="Mean multiplication of an electron before the amplifier; 1 = none. Above 1 it adds the "
        "excess noise of the register, variance times 2 - 1/em_gain.",
    )
    gain_electrons_per_adu: float = Field(
        default=IDEAL["gain_electrons_per_adu"],
        gt=0,
        allow_inf_nan=False,
        description="Electrons behind the multiplication register per step of the converter.",
    )
    full_well_electrons: float = Field(
        default=IDEAL["full_well_electrons"],
        gt=0,
        description="Most electrons that a pixel holds, before multiplication; inf = no limit.",
    )
    bits: int = Field(
        default=IDEAL["bits"],
        ge=0,
        le=20,  # beyond, float32 no longer returns a code through electrons and back
        description="Bits of the analogue-to-digital converter; 0 = neither rounding nor an upper limit.",
    )
    bias_adu: float = Field(
        default=IDEAL["bias_adu"],
        ge=0,
        allow_inf_nan=False,
        description="Reading of a pixel without a single electron.",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, given: Any) -> Any:
        """Put the preset's numbers under what the user has set."""
        if not isinstance(given, dict) or not isinstance(given.get("preset", "ideal"), str):
            return given  # pydantic says what is wrong
        unlimited = {key: value for key, value in _UNLIMITED.items() if key in given and given[key] is None}
        return {**PRESETS.get(given.get("preset", "ideal"), {}), **given, **unlimited}

    @model_validator(mode="after")
    def _bias_leaves_room(self) -> "DetectorSettings":
        if self.bits and self.bias_adu >= 2**self.bits - 1:
            raise ValueError(f"bias_adu must be below the highest code of {self.bits} bits")
        return self
