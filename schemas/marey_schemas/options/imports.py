"""Options of imports: what the caller knows and the files do not say."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.formats import LengthUnit
from marey_schemas.names import CollectionPath, Tag


class ImportOptions(Request):
    """Facts that the user knows better than the files. Absent: inferred from evidence, or refused when ambiguous."""

    collection: CollectionPath = Field("", description="Folder of the project that the clips go to.")
    skeleton: str | None = Field(
        None, description="Item id of the skeleton the clips must use; absent: found or created."
    )
    unit: LengthUnit | None = Field(
        None, description="Unit of length of the files; cmu is 1/0.45 inch. Absent: inferred."
    )
    unit_scale_m: float | None = Field(None, gt=1e-6, lt=1e3, description="Metres per unit, where no named unit fits.")
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | None = Field(
        None, description="Axis that points up in the files. Absent: inferred."
    )
    handedness: Literal["right", "left"] = Field("right", description="left: mirror the files, which are left-handed.")
    align_floor: bool = Field(False, description="Shift each clip vertically, so that the feet stand at height 0.")
    frame_rate_hz: float | None = Field(
        None, gt=0, le=100_000, description="Frames per second. Absent: those of the files."
    )
    trim_rest_pose: bool = Field(False, description="Drop rest poses at both ends.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of every clip.")
    subject: str | None = Field(None, max_length=255, description="Who moves.")
    licence: str | None = Field(None, max_length=255, description="What the data may be used for.")
    capture_system: str | None = Field(None, max_length=255, description="What recorded it.")
