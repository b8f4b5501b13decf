"""Handles of edits: saved lists of commands, which are previewed on clips and applied to clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Unpack

from pydantic import BaseModel

from marey_client.arguments import checked, checks_arguments, several
from marey_client.items import ItemHandle, Items
from marey_client.keywords.asking import EditPreviewKeywords
from marey_client.transport import BLOCKS, Transport, as_json, read_tree
from marey_schemas.editing.edits import EditDocument
from marey_schemas.editing.previews import EditPreview, EditPreviewRequest
from marey_schemas.items import Item


@checks_arguments
class EditHandle(ItemHandle):
    """Handle of an edit: a saved list of commands with a title."""

    def document(self, *, revision: int | None = None) -> EditDocument:
        """Return the edit's title and commands; default: those of the newest revision."""
        return EditDocument.model_validate(self.part("edit", revision=revision))

    def put(self, edit: EditDocument, *, message: str | None = None) -> Item:
        """Replace the commands of the edit; the item gets a new revision.

        Raises `PreconditionFailed` if the edit was changed since it was read.
        """
        return self.put_part("edit", edit.model_dump(mode="json", by_alias=True), message=message)


Command = Mapping[str, Any] | BaseModel
Commands = EditHandle | EditDocument | Command | Sequence[Command]
"""Edit as a handle or a document, or a list of commands such as `{"command": "trim", "start": 10}`."""


@checks_arguments
class Edits(Items[EditHandle]):
    """Edits (saved lists of commands) of a project."""

    def save(
        self,
        name: str,
        commands: EditDocument | Command | Sequence[Command],
        *,
        title: str = "",
        collection: str = "",
        message: str = "",
    ) -> EditHandle:
        """Save commands as an edit; an edit of this name in the folder `collection` gets a new revision."""
        edit = as_edit(commands, title=title)
        held = next(self.list(path=f"{collection}/{name}".lstrip("/"), page_size=1), None)
        if held is not None:
            held.put(edit, message=message or None)
            return held
        parts = {"edit": edit.model_dump(mode="json", by_alias=True)}
        return self.create(name, parts, collection=collection, message=message)


def as_edit(commands: EditDocument | Command | Sequence[Command], *, title: str = "") -> EditDocument:
    """Return commands as the document of an edit. Raises `BadArgument`, which names the first faulty command."""
    if isinstance(commands, EditDocument):
        return commands if not title else commands.model_copy(update={"title": title})
    return checked(EditDocument, {"title": title, "commands": several(commands)})


def preview_edit(
    transport: Transport,
    url: str,
    commands: Commands,
    frames: tuple[int, int | None],
    **options: Unpack[EditPreviewKeywords],
) -> EditPreview:
    """Apply commands to the clip at `url` without storing the result; return frames of the result.

    `options` are those of `EditPreviewRequest`.
    """
    if isinstance(commands, EditHandle):
        request = checked(EditPreviewRequest, {"edit": commands.as_input().model_dump(), "frames": frames, **options})
    else:
        request = checked(EditPreviewRequest, {"commands": as_edit(commands).commands, "frames": frames, **options})
    response = transport.send(
        "POST", f"{url}/edit-preview", content=as_json(request), headers={"Accept": BLOCKS}, repeatable=True
    )
    return EditPreview.model_validate(read_tree(response))
