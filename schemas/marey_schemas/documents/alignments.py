"""Aligned examples of an action: part `info` of an item of the kind `processed`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.metrics import MetricIdentity
from marey_schemas.documents.originals import StoredOriginal
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.names import Digest, JointName, Label
from marey_schemas.queue.job_params import AlignParams

Metres = Annotated[float, Field(allow_inf_nan=False)]


class ExampleRef(Request):
    """Reference to an example of an action: a revision of a clip, used as it is or mirrored."""

    item: str
    revision: int = Field(ge=1)
    mirrored: bool = False


class AlignedPlacement(Request):
    """Placement of an aligned clip: position and heading of the body in the first frame of the source clip.

    A point p of the aligned clip is at R(heading_rad)·p + (x, y, z) in the source, where R turns about +Y.
    """

    heading_rad: Metres = 0.0
    x: Metres = 0.0
    y: Metres = Field(0.0, allow_inf_nan=False, description="Height that was subtracted from the clip, in metres.")
    z: Metres = 0.0
    joint: JointName | None = Field(
        None, description="The joint whose position on the ground is (x, z); default: the root."
    )


class PredecessorAlignedOrigin(Request):
    """Files of Marey's predecessor that an aligned clip was imported from."""

    motion: StoredOriginal | None = Field(
        None, description="The file of the motion; absent if the file does not have the predecessor's format."
    )
    alignment: StoredOriginal


class AlignmentInfo(Request):
    """Part `info` of an aligned clip: its set of examples, and the mapping of its time to the source clip.

    The part `motion` contains the frames of the aligned clip.
    """

    schema_: Literal["marey/alignment@1"] = Field("marey/alignment@1", alias="schema")
    name: str = Field("", max_length=300, description="Name of the example, shown to people.")
    clip: ExampleRef | None = Field(None, description="The source clip; absent if it is not stored.")
    take: str | None = Field(
        None,
        max_length=300,
        description="The recording that the clip comes from, for example the id of the clip that it was cut "
        "from; examples with the same value are never used to test each other. Absent: unknown.",
    )
    subject: str | None = Field(None, description="Performer, under a pseudonym; absent: not recorded.")
    reference: ExampleRef | None = Field(
        None,
        description="The reference example. Its time is the canonical time, to which the time of all other "
        "examples is mapped. Absent: unknown.",
    )
    set: Digest | None = Field(
        None,
        description="Digest of the options and of all clips that were aligned together; it identifies the set of "
        "examples. Absent: unknown.",
    )
    frame_rate_hz: float = Field(
        gt=0, allow_inf_nan=False, description="Rate of the canonical frames and of `source_frames`, in hertz."
    )
    source_frames: int = Field(ge=2, description="Number of frames of the source at `frame_rate_hz`.")
    time_function: Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=1)] = Field(
        description="Fractional source frame at each canonical frame, increasing from 0 to the last source frame."
    )
    placement: AlignedPlacement = AlignedPlacement()
    keyframes: dict[Label, Annotated[int, Field(ge=0)]] = Field(
        default_factory=dict, max_length=10_000, description="Canonical frame of each keyframe, by label."
    )
    cost: float = Field(
        0.0,
        ge=0,
        allow_inf_nan=False,
        description="Mean cost of the alignment per frame, in square metres; without a unit if the cost is a "
        "perceptual metric.",
    )
    metric: MetricIdentity | None = Field(
        None,
        description="Perceptual metric whose distance of poses was the cost of the alignment. Costs under "
        "different metrics are not comparable. Absent: the cost is a geometric distance.",
    )
    options: AlignParams | None = Field(None, description="Options of the alignment; absent if unknown.")
    predecessor: PredecessorAlignedOrigin | None = None

    @model_validator(mode="after")
    def _check_times(self) -> Self:
        times = self.time_function
        if len(times) < 2 or not (np.diff(times) > 0).all():
            raise ValueError("time_function: must increase strictly over at least two canonical frames")
        if times[0] != 0 or times[-1] != self.source_frames - 1:
            raise ValueError(f"time_function: must go from 0 to {self.source_frames - 1}, the last frame of the source")
        for label, frame in self.keyframes.items():
            if frame >= len(times):
                raise ValueError(f"keyframes.{label}: frame {frame} is outside the {len(times)} canonical frames")
        return self
