"""Edits: lists of commands that are saved, applied to any clips, and replayed exactly."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.editing.commands import Concatenate, MotionCommand, Paste
from marey_schemas.editing.constraints import ConstraintCommand

MOST_COMMANDS = 256
AnyCommand = MotionCommand | ConstraintCommand
EditCommand = Annotated[AnyCommand, Field(discriminator="command")]
COMMAND_MODELS: dict[str, type[AnyCommand]] = {
    get_args(model.model_fields["command"].annotation)[0]: model for model in get_args(AnyCommand)
}
"""Pydantic model of each command, by the name of the command."""


class EditDocument(Request):
    """Part `edit`: commands in the order in which they are applied."""

    schema_: Literal["marey/edit@1"] = Field("marey/edit@1", alias="schema")
    title: str = Field("", max_length=200, description="Purpose of the edit, for people.")
    commands: tuple[EditCommand, ...] = Field(min_length=1, max_length=MOST_COMMANDS)

    @property
    def sources(self) -> tuple[str, ...]:
        """Ids of the clips to which the commands refer."""
        return tuple(dict.fromkeys(str(one.source) for one in self.commands if isinstance(one, Concatenate | Paste)))
