"""Counterparts of `marey_client.handles.annotations` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.items import AsyncItemHandle
from marey_client.handles.annotations import AnnotationHandle
from marey_schemas.documents.annotations import Annotation
from marey_schemas.items import Item


@counterpart_of(AnnotationHandle)
class AsyncAnnotationHandle(AsyncItemHandle):
    """Handle of an annotation: one layer of segments and keyframes over a clip."""

    _sync: AnnotationHandle

    async def document(self, *, revision: int | None = None) -> Annotation:
        """Return the part `annotation`: the annotated clip, segments and keyframes; default: of the newest revision."""
        return await self._run(self._sync.document, revision=revision)

    async def apply(self, commands: Mapping[str, Any] | Sequence[Mapping[str, Any]], *, message: str = "") -> Item:
        """Apply commands in order, all or none, as one new revision.

        A command is a dict, such as `{"command": "split_segment", "at": 120}`. Raises `PreconditionFailed` if the
        annotation was changed since it was read, and `RequestFailed` if a command cannot be applied; the text of the
        error names this command.
        """
        return await self._run(self._sync.apply, commands, message=message)

    async def put(self, annotation: Annotation, *, message: str | None = None) -> Item:
        """Replace the segments and keyframes; the item gets a new revision.

        Raises `PreconditionFailed` if the annotation was changed since it was read.
        """
        return await self._run(self._sync.put, annotation, message=message)
