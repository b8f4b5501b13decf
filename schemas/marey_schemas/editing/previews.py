"""Previews of edits, which compute a result without storing it."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.editing.commands import Frames
from marey_schemas.editing.edits import MOST_COMMANDS, EditCommand
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.sizes import MOST_INTEGER


class EditPreviewRequest(Request):
    """Request for a preview of the result of an edit; nothing is stored."""

    commands: tuple[EditCommand, ...] = Field(
        (), max_length=MOST_COMMANDS, description="Commands to apply; absent: those of `edit`."
    )
    edit: ItemInput | None = Field(
        None, description="Edit to apply if `commands` are absent; by default its newest revision."
    )
    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision of the clip; absent: the newest.")
    frames: Frames = Field(
        (0, None), description="Half-open range of the result's frames to return; the part beyond the end is left out."
    )
    piece: int = Field(0, ge=0, lt=10_000, description="Index of the result to return, if the commands split the clip.")
    fields: tuple[Literal["motion", "positions", "findings"], ...] = Field(
        ("motion", "findings"),
        max_length=3,
        description="Content of the answer, in addition to the numbers of clips and frames.",
    )

    @model_validator(mode="after")
    def _check_commands(self) -> Self:
        if (self.edit is None) == (not self.commands):
            raise ValueError("give either commands or an edit, not both")
        return self


class EditPreview(Answer):
    """Frames of the result of an edit that was computed but not stored."""

    pieces: int = Field(description="Number of clips that result from the edit of the clip.")
    frame_count: int = Field(description="Number of frames of the whole result.")
    frame_rate_hz: float
    frames: tuple[int, int] = Field(description="Half-open range of the frames in this answer.")
    motion: MotionDocument | None = Field(
        None, description="Motion of the frames in this answer; null if the request did not ask for it."
    )
    positions: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=3, columns=3)] | None = Field(
        None,
        description="[frames, joints, 3]: positions of the joints in metres; null if the request did not ask for them.",
    )
    findings: tuple[dict[str, Any], ...] = Field(
        (), description="Measurements that commands made, each with its `command`."
    )
