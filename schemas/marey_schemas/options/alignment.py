"""Options of alignment by dynamic time warping: the cost of a pair of poses, and the path through the costs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints, field_validator

from marey_schemas.base import Options
from marey_schemas.names import JointName

CostMethod = Literal["turned", "plain"]

MEDOID = "medoid"
NEAREST_MEAN_LENGTH = "nearest_mean_length"
"""Value of `reference` that selects the clip with the length nearest to the mean; `MEDOID` is the other value."""

_Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


class CostOptions(Options):
    """Options that determine the cost of matching a pair of poses."""

    cost: CostMethod = Field(
        "turned",
        description="Cost of a pair of poses. turned: the distance after the best rotation about the vertical and "
        "the best shift on the ground; plain: the distance without rotation and shift.",
    )
    window: int = Field(
        1,
        ge=1,
        le=61,
        description="Number of frames in the window around a pose, an odd number. Two poses are compared by all frames "
        "of their windows; 1: by the poses alone.",
    )

    @field_validator("window")
    @classmethod
    def _check_window(cls, window: int) -> int:
        if window % 2 == 0:
            raise ValueError(
                "the number of frames must be odd, so that the window has as many frames before its middle frame as "
                "after it"
            )
        return window


class AlignOptions(CostOptions):
    """Options of the alignment of the examples of an action."""

    reference: Annotated[str, StringConstraints(min_length=1, max_length=64)] = Field(
        MEDOID,
        description="Clip whose time is the canonical time. medoid: the clip nearest to all others (of more than 200 "
        "clips, the clip of a random sample of 200 that is nearest to all others of the sample); "
        "nearest_mean_length: the clip whose length is nearest to the mean; or the id of a clip; commands and Python "
        "also accept the path of the clip.",
    )
    rate_hz: float | None = Field(
        None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Rate of the canonical frames, in hertz; absent: the frame rate of the reference if a clip is "
        "given as reference, else the most common frame rate of the clips.",
    )
    slope_limit: int | None = Field(
        3,
        ge=0,
        le=60,
        description="Greatest number of consecutive steps of the alignment path that advance only one of the two "
        "clips. With the limit n, a frame is matched with at most n + 1 frames. null: no limit.",
    )
    weights: dict[JointName, _Weight] = Field(
        default_factory=dict,
        max_length=4096,
        description="Weight of each joint in the cost, by its own or its standard name; default 1, and 0 for "
        "joints that move no part of the body.",
    )
    keep_height: bool = Field(
        True,
        description="Keep the heights above the floor; false: the height of the body in the first frame is subtracted "
        "from all heights of a clip.",
    )
