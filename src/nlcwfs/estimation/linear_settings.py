"""What a user may choose about the linear reconstructor; every default was chosen by measurement."""

from pydantic import BaseModel, ConfigDict, Field


class LinearSettings(BaseModel):
    """One matrix from binned images and their moments to modes, learnt from simulated turbulence.

    Examples:
        >>> LinearSettings().gerchberg_saxton_updates
        0
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    modes: int = Field(default=200, ge=1, le=2000, description="Karhunen-Loeve modes that the matrix gives")
    bin_pixels: int | None = Field(
        default=None,
        ge=1,
        le=64,
        examples=[3],
        description="detector pixels along a side of a bin; leave out for about 16 bins across the telescope",
    )
    follow_tilt: bool = Field(
        default=True, description="bins move with the tilt that the centroids show, which shifts images as a whole"
    )
    training_screens: int = Field(
        default=4000,
        ge=20,
        le=1_000_000,
        description="wavefronts that the matrix is learnt from; a tenth more judge it",
    )
    training_seed: int = Field(default=0, ge=0, description="random key of those wavefronts")
    weakest: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="rms of the weakest training wavefronts over the strongest, where the seeing is not told",
    )
    light_oversampling: int = Field(
        default=2, ge=2, le=8, description="cells of the training light per detector pixel along an axis"
    )
    gerchberg_saxton_updates: int = Field(
        default=0, ge=0, le=1000, description="Gerchberg-Saxton iterations at full resolution on top of the matrix"
    )
    gain: float = Field(
        default=3.0, gt=0, le=10, description="length of an update's step: 3 suits one or two updates, 1.5 many of them"
    )
