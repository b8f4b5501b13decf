"""Counterparts of `marey_client.handles.clips` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, Unpack

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.annotations import AsyncAnnotationHandle
from marey_client.asynchronous.handles.edits import AsyncCommands
from marey_client.asynchronous.poses.handle import AsyncPosesHandle
from marey_client.handles.clips import ClipHandle
from marey_client.keywords.asking import EditPreviewKeywords
from marey_schemas.documents.clips import ClipInfo, MotionDocument
from marey_schemas.editing.previews import EditPreview
from marey_schemas.items import Item


@counterpart_of(ClipHandle)
class AsyncClipHandle(AsyncPosesHandle):
    """Handle of a clip: poses, description (the part `info`) and annotations of the clip."""

    _sync: ClipHandle

    async def info(self) -> ClipInfo:
        """Return the part `info`: descriptions of the clip by users and importers."""
        return await self._run(self._sync.info)

    async def put_info(self, info: ClipInfo) -> Item:
        """Replace the description of the clip; the item gets a new revision, in which the poses are unchanged.

        Raises `PreconditionFailed` if the clip was changed since it was read.
        """
        return await self._run(self._sync.put_info, info)

    async def put_motion(self, motion: MotionDocument, *, message: str | None = None) -> Item:
        """Replace the poses of the clip; the item gets a new revision.

        Raises `PreconditionFailed` if the clip was changed since it was read.
        """
        return await self._run(self._sync.put_motion, motion, message=message)

    def annotations(self) -> AsyncIterator[AsyncAnnotationHandle]:
        """List the annotations of all revisions of the clip, oldest first."""
        return self._each(self._sync.annotations)

    async def annotate(self, layer: str, *, name: str | None = None, **content: Any) -> AsyncAnnotationHandle:
        """Create an annotation of this revision of the clip, in the clip's folder.

        `content` has the fields `segments` and `keyframes` of `Annotation`; without these, the annotation is empty.
        """
        exchanged: AsyncAnnotationHandle = await self._exchange(self._sync.annotate, layer, name=name, **content)
        return exchanged

    async def preview(
        self, commands: AsyncCommands, *, frames: slice | None = None, **options: Unpack[EditPreviewKeywords]
    ) -> EditPreview:
        """Apply commands to the clip without storing the result, and return frames of the result.

        `options` are those of `EditPreviewRequest`, such as `piece=1` or `fields=("positions",)`. Raises
        `RequestFailed` if the commands cannot be applied, or would take too long for a preview.
        """
        exchanged: EditPreview = await self._exchange(self._sync.preview, commands, frames=frames, **options)
        return exchanged

    async def import_annotation(
        self, document: Mapping[str, Any] | str | Path, **options: Any
    ) -> AsyncAnnotationHandle:
        """Create an annotation in the clip's folder from a document of Marey's predecessor, a dict or a file.

        Only an annotation from a file can be exported again byte for byte. `options` are those of `AnnotationImport`,
        such as `layer="phases"` or `end_index="exclusive"`.
        """
        exchanged: AsyncAnnotationHandle = await self._exchange(self._sync.import_annotation, document, **options)
        return exchanged
