"""Exports that need no numeric code: an item as one JSON document, and the file that a clip was imported from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from marey_schemas.encoding import codecs
from marey_schemas.kinds import Kind
from marey_schemas.names import base_name


@dataclass(frozen=True, slots=True)
class ItemToExport:
    """Documents of an item at one revision.

    `hierarchy` belongs to the skeleton of the motion or model. If `tags` is None, the file contains no tags: jobs omit
    tags, because these can change without a new revision.
    """

    item: str
    kind: Kind
    name: str
    collection: str
    revision: int
    parts: Mapping[str, Any]
    hierarchy: Mapping[str, Any] | None = None
    tags: Sequence[str] | None = None


@dataclass(frozen=True, slots=True)
class OriginalFile:
    """The file from which an item was imported, byte for byte."""

    name: str
    digest: str


def item_as_json(source: ItemToExport) -> bytes:
    """Return an item with all its parts, and its skeleton's hierarchy, as one JSON document."""
    tree: dict[str, Any] = {
        "schema": "marey/item@1",
        "item": source.item,
        "kind": source.kind.value,
        "name": source.name,
        "collection": source.collection,
        "revision": source.revision,
    }
    if source.tags is not None:
        tree["tags"] = list(source.tags)
    tree["parts"] = source.parts
    if source.hierarchy is not None:
        tree["skeleton"] = source.hierarchy
    return codecs.encode_tree(tree, codecs.JSON)


def original_of_clip(item: str, info: Mapping[str, Any] | None) -> OriginalFile | None:
    """Return the file that a clip was imported from, according to its part `info`; None if it was not imported."""
    source = (info or {}).get("source") or {}
    if not source.get("file"):
        return None
    name = str(source.get("file_name") or item)  # with its folders if an earlier version imported it
    return OriginalFile(base_name(name), source["file"])
