"""Options of imports: what the caller knows and the files do not say."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.formats import LengthUnit
from marey_schemas.names import CollectionPath, Tag


class ImportOptions(Request):
    """Facts that the user knows better than the files. Absent: inferred from evidence, or refused when ambiguous."""

    collection: CollectionPath = Field("", description="Folder of the project that receives the clips.")
    skeleton: str | None = Field(
        None, description="Item id of the skeleton that the clips must use; absent: found or created."
    )
    unit: LengthUnit | None = Field(
        None, description="Unit of length of the files; cmu is 1/0.45 inch. Absent: inferred."
    )
    unit_scale_m: float | None = Field(
        None, gt=1e-6, lt=1e3, description="Metres per unit of length, for units without a name."
    )
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | None = Field(
        None, description="Axis that points up in the files. Absent: inferred."
    )
    handedness: Literal["right", "left"] = Field("right", description="left: mirror the files, which are left-handed.")
    align_floor: bool = Field(
        False, description="Shift each clip vertically, so that its feet are on the ground at height 0."
    )
    frame_rate_hz: float | None = Field(
        None, gt=0, le=100_000, description="Frame rate in frames per second. Absent: the rate in the files."
    )
    trim_rest_pose: bool = Field(False, description="Remove rest poses at both ends.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags that every clip gets.")
    subject: str | None = Field(None, max_length=255, description="The performer.")
    licence: str | None = Field(None, max_length=255, description="Licence of the data.")
    capture_system: str | None = Field(None, max_length=255, description="The device or system that recorded the data.")
