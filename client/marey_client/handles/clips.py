"""Handles of clips, which read and change poses, descriptions and annotations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Unpack

from marey_client.arguments import checked, checks_arguments
from marey_client.blobs import Blobs
from marey_client.handles.annotations import AnnotationHandle
from marey_client.handles.edits import Commands, preview_edit
from marey_client.items import Items
from marey_client.keywords.asking import EditPreviewKeywords
from marey_client.poses.arrays import MotionArrays as MotionArrays
from marey_client.poses.arrays import frames_text
from marey_client.poses.handle import PosesHandle
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.clips import ClipInfo, MotionDocument
from marey_schemas.editing.annotation_commands import AnnotationImport
from marey_schemas.editing.previews import EditPreview
from marey_schemas.items import Item
from marey_schemas.kinds import Kind


@checks_arguments
class ClipHandle(PosesHandle):
    """Handle of a clip: poses, description (the part `info`) and annotations of the clip."""

    def info(self) -> ClipInfo:
        """Return the part `info`: descriptions of the clip by users and importers."""
        return ClipInfo.model_validate(self.part("info"))

    def put_info(self, info: ClipInfo) -> Item:
        """Replace the description of the clip; the item gets a new revision, in which the poses are unchanged.

        Raises `PreconditionFailed` if the clip was changed since it was read.
        """
        return self.put_part("info", info.model_dump(mode="json", by_alias=True, exclude_none=True))

    def put_motion(self, motion: MotionDocument, *, message: str | None = None) -> Item:
        """Replace the poses of the clip; the item gets a new revision.

        Raises `PreconditionFailed` if the clip was changed since it was read.
        """
        return self.put_part("motion", motion.model_dump(by_alias=True, exclude_none=True), message=message)

    def annotations(self) -> Iterator[AnnotationHandle]:
        """List the annotations of all revisions of the clip, oldest first."""
        found = Items(self.transport, self.project, Kind.ANNOTATION, AnnotationHandle)
        return found.list(sort="created_at", filters={"clip": self.id})

    def annotate(self, layer: str, *, name: str | None = None, **content: Any) -> AnnotationHandle:
        """Create an annotation of this revision of the clip, in the clip's folder.

        `content` has the fields `segments` and `keyframes` of `Annotation`; without these, the annotation is empty.
        """
        document = checked(Annotation, {"clip": self.as_input().model_dump(), "layer": layer, **content})
        return Items(self.transport, self.project, Kind.ANNOTATION, AnnotationHandle).create(
            name or f"{self.name} {layer}",
            {"annotation": document.model_dump(mode="json", by_alias=True)},
            collection=self.item.collection,
        )

    def preview(
        self, commands: Commands, *, frames: slice | None = None, **options: Unpack[EditPreviewKeywords]
    ) -> EditPreview:
        """Apply commands to the clip without storing the result, and return frames of the result.

        `options` are those of `EditPreviewRequest`, such as `piece=1` or `fields=("positions",)`. Raises
        `RequestFailed` if the commands cannot be applied, or would take too long for a preview.
        """
        frames_text(frames)
        bounds = (0, None) if frames is None else (frames.start or 0, frames.stop)
        given: EditPreviewKeywords = {"revision": self.item.revision, **options}
        return preview_edit(self.transport, self.url, commands, bounds, **given)

    def import_annotation(self, document: Mapping[str, Any] | str | Path, **options: Any) -> AnnotationHandle:
        """Create an annotation in the clip's folder from a document of Marey's predecessor, a dict or a file.

        Only an annotation from a file can be exported again byte for byte. `options` are those of `AnnotationImport`,
        such as `layer="phases"` or `end_index="exclusive"`.
        """
        if isinstance(document, Mapping):
            source: dict[str, Any] = {"document": document}
        else:
            path = Path(document)
            source = {"file": {"name": path.name, "blob": Blobs(self.transport).put_file(path)}}
        wanted = checked(AnnotationImport, {**source, **options})
        made = self.transport.post(Item, f"{self.url}/annotations", wanted)
        return AnnotationHandle(self.transport, self.project, made)
