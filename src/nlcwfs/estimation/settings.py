"""What a user may choose about the reconstruction; every default was chosen by measurement (studies 01 and 02)."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from nlcwfs.estimation.gerchberg_saxton_settings import GerchbergSaxtonSettings
from nlcwfs.estimation.linear_settings import LinearSettings
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.estimation.prior_settings import PriorSettings


class EstimationSettings(BaseModel):
    """How frames become a wavefront."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    method: Literal["map", "gerchberg-saxton", "linear"] = Field(
        default="map",
        description="map: the most likely wavefront; gerchberg-saxton: the paper's algorithm; linear: one matrix",
    )
    modes: int = Field(
        default=800,
        ge=1,
        le=20000,
        description="modes for unwrapping, and Zernikes listed in the result (at most 800)",
    )
    unwrapping: Literal["carried", "slopes"] = Field(
        default="carried",
        description="carried: the phase was never wrapped (filter = turbulence); slopes: fit the wrapped slopes with "
        "modes, then the wrapped remainder, as in the paper",
    )
    remainder_passes: int = Field(
        default=2, ge=0, le=10, description="times the wrapped remainder is projected back on the modes"
    )
    seeing_arcsec: float | None = Field(
        default=None,
        gt=0,
        le=10,
        examples=[0.6],
        description="strength of the turbulence that the filter expects; leave out to measure it from the frames",
    )
    gerchberg_saxton: GerchbergSaxtonSettings = GerchbergSaxtonSettings()
    linear: LinearSettings = LinearSettings()
    map: MapSettings = MapSettings()
    prior: PriorSettings = PriorSettings()
