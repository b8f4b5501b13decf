"""Previews of edits, before anything is stored."""

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
from marey_schemas.jobs import ItemInput


class EditPreviewRequest(Request):
    """Preview of the result of an edit; nothing is stored."""

    commands: tuple[EditCommand, ...] = Field((), max_length=MOST_COMMANDS, description="Absent: those of `edit`.")
    edit: ItemInput | None = Field(None, description="An edit, where `commands` are not given; default: its newest.")
    revision: int | None = Field(None, ge=1, lt=2**31, description="Of the clip; absent: its newest.")
    frames: Frames = Field((0, None), description="Which frames of the result; what lies beyond its end is left out.")
    piece: int = Field(0, ge=0, lt=10_000, description="Which of the results, where the clip is split.")
    fields: tuple[Literal["motion", "positions", "findings"], ...] = Field(
        ("motion", "findings"), max_length=3, description="What to answer beside the counts."
    )

    @model_validator(mode="after")
    def _check_commands(self) -> Self:
        if (self.edit is None) == (not self.commands):
            raise ValueError("give either commands or an edit, and not both")
        return self


class EditPreview(Answer):
    """Frames of what an edit makes of a clip."""

    pieces: int = Field(description="How many clips the edit makes of the clip.")
    frame_count: int = Field(description="Frames of the whole result.")
    frame_rate_hz: float
    frames: tuple[int, int] = Field(description="Which of them these are: half-open.")
    motion: MotionDocument | None = Field(None, description="The motion of these frames.")
    positions: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=3, columns=3)] | None = Field(
        None, description="[frames, joints, 3]: where the joints are, metres."
    )
    findings: tuple[dict[str, Any], ...] = Field((), description="What commands found out, each with its `command`.")
