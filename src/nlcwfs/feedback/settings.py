"""What a user may choose about the way from a wavefront estimate to a command."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class FeedbackSettings(BaseModel):
    """The controller and its delay.

    Examples:
        >>> FeedbackSettings(controller="predictive", latency_frames=1).gain
        1.0
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    controller: Literal["integrator", "modal-gains", "predictive", "kalman"] = Field(
        default="integrator",
        description="the same gain for every mode; a gain for each mode, learnt; a prediction of each mode, learnt; or "
        "Kalman's filter of the air that the wind carries, the wind learnt (curvature sensor with method map, or "
        "lenslets). What learns is an integrator until it has learnt",
    )
    gain: float = Field(default=1.0, gt=0, le=2, description="share of a measured error that the next command corrects")
    leak: float = Field(
        default=1.0, ge=0, le=1, description="share of the command kept from frame to frame by an integrator; 1 = all"
    )
    latency_frames: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="exposures from the end of an exposure until its command is on the mirror; a part of one means "
        "that the mirror changes within exposures",
    )
    pseudo_open_loop: bool = Field(
        default=True,
        description="add the mirror's known shape to what is measured, so that commands on their way are not ordered "
        "twice and any latency is stable; without it a gain near 1 oscillates after a latency of one frame",
    )
    training_frames: int = Field(
        default=2000, ge=64, le=1000000, description="most recent frames from which gains or predictions are learnt"
    )
    prediction_order: int = Field(
        default=10, ge=1, le=100, description="past frames from which a prediction is made (order of the AR model)"
    )
    forgetting: float = Field(
        default=1.0, gt=0, le=1, description="weight of a frame over that of the next when a prediction is learnt"
    )
