"""What a user may choose about contrast: angles, rates, and the sensors that are compared."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator


class ContrastSettings(BaseModel):
    """The halo that lag and photon noise leave; star, air, mirror and wavelengths are those of their own sections.

    Examples:
        >>> ContrastSettings().sensors
        ('shack-hartmann', 'curvature')
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sensors: tuple[str, ...] = Field(
        default=("shack-hartmann", "curvature"),
        min_length=1,
        description="sensors that are compared: ideal, curvature, shack-hartmann (of shack_hartmann.subapertures), or "
        "what the sensitivity table names; gains are those of the last over the first",
    )
    sensitivity_table: Path | None = Field(
        default=None,
        examples=["sensitivity.ecsv"],
        description="table of nlcwfs sensitivity; a sensor that is in it has that flux factor, others a closed form",
    )
    sensitivity_rms_rad: float = Field(
        default=0.0, ge=0, description="rms of the wavefronts whose rows of that table are used, as a loop leaves them"
    )
    curvature_flux_factor: float = Field(
        default=2.1,
        ge=1,
        le=1e6,
        description="photons that a curvature sensor needs over those of the quantum limit, at every frequency, where "
        "no table tells it",
    )
    imaging_wavelength_um: float | None = Field(
        default=None,
        gt=0.1,
        le=30,
        examples=[1.6],
        description="wavelength of the image; leave out for loop.science_wavelength_um",
    )
    rates_hz: tuple[Annotated[float, Field(gt=0, le=1e6)], ...] = Field(
        default=(100.0, 300.0, 1000.0, 3000.0, 10000.0),
        min_length=1,
        description="exposures in a second; the best for each angle is found besides",
    )
    angles_mas: tuple[Annotated[float, Field(gt=0, le=1e6)], ...] | None = Field(
        default=None,
        min_length=1,
        examples=[(41.0, 83.0, 165.0, 330.0, 660.0)],
        description="angles from the star that are told one by one; leave out for those of 1, 2, 4 ... cycles per "
        "aperture, as far as the mirror goes",
    )
    curve_points: int = Field(
        default=61,
        ge=0,
        le=10000,
        description="further angles for the curves, evenly spaced in the logarithm over those told",
    )

    @model_validator(mode="after")
    def _each_is_told_once(self) -> "ContrastSettings":
        for name in ("sensors", "rates_hz", "angles_mas"):
            values = getattr(self, name) or ()
            if len(set(values)) < len(values):
                raise ValueError(f"{name} must differ from each other")
        return self
