"""Counterparts of `marey_client.handles.edits` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Sequence

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.items import AsyncItemHandle, AsyncItems
from marey_client.handles.edits import Command, EditHandle, Edits
from marey_schemas.editing.edits import EditDocument
from marey_schemas.items import Item


@counterpart_of(EditHandle)
class AsyncEditHandle(AsyncItemHandle):
    """Handle of an edit: a saved list of commands with a title."""

    _sync: EditHandle

    async def document(self, *, revision: int | None = None) -> EditDocument:
        """Return the edit's title and commands; default: those of the newest revision."""
        return await self._run(self._sync.document, revision=revision)

    async def put(self, edit: EditDocument, *, message: str | None = None) -> Item:
        """Replace the commands of the edit; the item gets a new revision.

        Raises `PreconditionFailed` if the edit was changed since it was read.
        """
        return await self._run(self._sync.put, edit, message=message)


AsyncCommands = AsyncEditHandle | EditDocument | Command | Sequence[Command]


@counterpart_of(Edits)
class AsyncEdits(AsyncItems[AsyncEditHandle]):
    """Edits (saved lists of commands) of a project."""

    _sync: Edits

    async def save(
        self,
        name: str,
        commands: EditDocument | Command | Sequence[Command],
        *,
        title: str = "",
        collection: str = "",
        message: str = "",
    ) -> AsyncEditHandle:
        """Save commands as an edit; an edit of this name in the folder `collection` gets a new revision."""
        exchanged: AsyncEditHandle = await self._exchange(
            self._sync.save, name, commands, title=title, collection=collection, message=message
        )
        return exchanged
