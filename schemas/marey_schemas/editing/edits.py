"""Edits: lists of commands that are saved, applied to any clips, and replayed exactly."""

from __future__ import annotations

from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.editing.commands import (
    CloseLoop,
    Concatenate,
    Face,
    FindContacts,
    FindGround,
    FixDrift,
    FlipAxes,
    Mirror,
    MoveToGround,
    MoveToOrigin,
    Paste,
    Resample,
    Retime,
    Rotate,
    RotateJoint,
    Scale,
    Smooth,
    Split,
    Translate,
    Trim,
)
from marey_schemas.editing.constraints import Constrain, PlantFeet
from marey_schemas.names import NameSuffix, Tag

MOST_COMMANDS = 256

AnyCommand = (
    Trim
    | Split
    | Concatenate
    | Resample
    | Retime
    | CloseLoop
    | Translate
    | Rotate
    | Face
    | MoveToOrigin
    | Scale
    | FlipAxes
    | FixDrift
    | MoveToGround
    | FindGround
    | FindContacts
    | Mirror
    | Smooth
    | RotateJoint
    | Paste
    | Constrain
    | PlantFeet
)
EditCommand = Annotated[AnyCommand, Field(discriminator="command")]

COMMAND_MODELS: dict[str, type[Request]] = {
    get_args(model.model_fields["command"].annotation)[0]: model for model in get_args(AnyCommand)
}
"""Model by the name of the command."""


class EditDocument(Request):
    """Part `edit`: commands in the order in which they are applied."""

    schema_: Literal["marey/edit@1"] = Field("marey/edit@1", alias="schema")
    title: str = Field("", max_length=200, description="What the edit is for.")
    commands: tuple[EditCommand, ...] = Field(min_length=1, max_length=MOST_COMMANDS)

    @property
    def sources(self) -> tuple[str, ...]:
        """Ids of the clips that the commands name."""
        return tuple(dict.fromkeys(str(one.source) for one in self.commands if isinstance(one, Concatenate | Paste)))


class EditParams(Request):
    """Parameters of `edit`."""

    commands: tuple[EditCommand, ...] = Field(
        (), max_length=MOST_COMMANDS, description="What to do, in order, where the input `edit` does not say it."
    )
    in_place: bool = Field(
        False, description="Make each result the next revision of its clip; otherwise it is a clip of its own."
    )
    suffix: NameSuffix = Field("", description="Appended to the names.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the results.")

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.in_place and self.suffix:
            raise ValueError("suffix: results that take the place of their clips keep their names")
        return self

    def unclear_place(self, into: str) -> str | None:
        """Why results that go into this collection would change the clips themselves unasked, or not though asked."""
        if self.in_place and into:
            return f"the results cannot both take the place of the clips and go to {into}"
        if not (self.in_place or into or self.suffix):
            return "the results would take the place of the clips; give a folder or a suffix, or in_place"
        return None
