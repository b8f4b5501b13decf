"""Handles of annotations, which read the segments and keyframes of clips and change them by commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from marey_client.arguments import checked, checks_arguments, several
from marey_client.items import ItemHandle
from marey_client.transport import as_json, read_model
from marey_schemas.documents.annotations import Annotation
from marey_schemas.editing.annotation_commands import AnnotationChange
from marey_schemas.items import Item


@checks_arguments
class AnnotationHandle(ItemHandle):
    """Handle of an annotation: one layer of segments and keyframes over a clip."""

    def document(self, *, revision: int | None = None) -> Annotation:
        """Return the part `annotation`: the annotated clip, segments and keyframes; default: of the newest revision."""
        return Annotation.model_validate(self.part("annotation", revision=revision))

    def apply(self, commands: Mapping[str, Any] | Sequence[Mapping[str, Any]], *, message: str = "") -> Item:
        """Apply commands in order, all or none, as one new revision.

        A command is a dict, such as `{"command": "split_segment", "at": 120}`. Raises `PreconditionFailed` if the
        annotation was changed since it was read, and `RequestFailed` if a command cannot be applied; the text of the
        error names this command.
        """
        change = checked(AnnotationChange, {"commands": several(commands), "message": message})
        response = self.transport.send(
            "POST", f"{self.url}/commands", content=as_json(change), headers=self._if_match()
        )
        return self._renewed(read_model(Item, response))

    def put(self, annotation: Annotation, *, message: str | None = None) -> Item:
        """Replace the segments and keyframes; the item gets a new revision.

        Raises `PreconditionFailed` if the annotation was changed since it was read.
        """
        return self.put_part("annotation", annotation.model_dump(mode="json", by_alias=True), message=message)
