"""Aligned examples of an action: what can be asked for, and part `info` of an item of the kind `processed`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints, field_validator, model_validator

from marey_schemas.annotations import Label, LayerName
from marey_schemas.base import Request
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.names import Digest, JointName, NameSuffix, Tag

MOST_EXAMPLES = 2000
"""That are all compared with each other, mirrored ones counted."""

Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
ReferenceChoice = Annotated[str, StringConstraints(min_length=1, max_length=64)]
Metres = Annotated[float, Field(allow_inf_nan=False)]


class AlignParams(Request):
    """Parameters of `align`."""

    suffix: NameSuffix = Field("", description="Appended to the names of the results.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the results.")
    reference: ReferenceChoice = Field(
        "medoid",
        description="Whose time is the canonical time: medoid (the clip nearest to all others), nearest_mean_length, "
        "or the id of a clip.",
    )
    rate_hz: float | None = Field(
        None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Of canonical frames; default: that of the reference where it is named, else the commonest one.",
    )
    layer: LayerName | None = Field(
        None, description="Layer of the annotations to go by; default: the only one that a clip has among the input."
    )
    labels: tuple[Label, ...] = Field(
        (), max_length=1000, description="Labels whose segments and keyframes cut the clips; none: all of them."
    )
    slope_limit: int | None = Field(
        3, ge=0, le=60, description="So many frames in a row of one clip may belong to one of the other; null: any."
    )
    cost: Literal["turned", "plain"] = Field(
        "turned",
        description="turned: poses are compared after the best turn and shift on the ground; plain: as they are.",
    )
    window: int = Field(1, ge=1, le=61, description="Odd number of frames that are compared at once.")
    weights: dict[JointName, Weight] = Field(
        default_factory=dict,
        max_length=4096,
        description="Weight in the cost by joint, under its own or its standard name; others count 1.",
    )
    mirroring: Literal["none", "add"] = Field("none", description="add: a mirrored twin of every clip beside it.")
    keep_height: bool = Field(True, description="Leave heights above the floor as they are.")

    @field_validator("window")
    @classmethod
    def _check_window(cls, window: int) -> int:
        if window % 2 == 0:
            raise ValueError("must be odd: as many frames before as after")
        return window


class ExampleRef(Request):
    """A revision of a clip, as it is or mirrored."""

    item: str
    revision: int = Field(ge=1)
    mirrored: bool = False


class AlignedPlacement(Request):
    """Where the body stood in the first frame of the source; a point p stood at R(heading) p + (x, y, z)."""

    heading_rad: Metres = 0.0
    x: Metres = 0.0
    y: Metres = Field(0.0, allow_inf_nan=False, description="What was taken off all heights.")
    z: Metres = 0.0
    joint: JointName | None = Field(None, description="The joint that stood there; default: the root.")


class AlignmentInfo(Request):
    """Part `info` of an aligned clip: which set it belongs to, and the way back to its source.

    Part `motion` holds its canonical frames.
    """

    schema_: Literal["marey/alignment@1"] = Field("marey/alignment@1", alias="schema")
    name: str = Field("", max_length=300, description="Of the example, for people.")
    clip: ExampleRef | None = Field(None, description="The source; absent where it is not in the store.")
    reference: ExampleRef | None = Field(None, description="The example whose time is the canonical time.")
    set: Digest | None = Field(None, description="Of everything that was aligned together, and how.")
    frame_rate_hz: float = Field(gt=0, allow_inf_nan=False, description="Of canonical frames, and of those counted in.")
    source_frames: int = Field(ge=2, description="Frames of the source at this rate.")
    time_function: Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=1)] = Field(
        description="Fractional frame of the source at each canonical frame, increasing from 0 to the last one."
    )
    placement: AlignedPlacement = AlignedPlacement()
    keyframes: dict[Label, Annotated[int, Field(ge=0)]] = Field(
        default_factory=dict, max_length=10_000, description="Canonical frame by label."
    )
    cost: float = Field(
        0.0, ge=0, allow_inf_nan=False, description="Mean cost per frame of the alignment, metres squared."
    )
    options: AlignParams | None = Field(None, description="How it was aligned, where that is known.")

    @model_validator(mode="after")
    def _check_times(self) -> Self:
        times = self.time_function
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise ValueError("time_function: must increase strictly over at least two canonical frames")
        if times[0] != 0 or times[-1] != self.source_frames - 1:
            raise ValueError(f"time_function: must go from 0 to {self.source_frames - 1}, the last frame of the source")
        for label, frame in self.keyframes.items():
            if frame >= len(times):
                raise ValueError(f"keyframes.{label}: there are {len(times)} canonical frames")
        return self
