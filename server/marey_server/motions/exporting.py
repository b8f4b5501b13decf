"""Items as files: what a file needs is read in one transaction, and written in a thread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.encoding import codecs
from marey_schemas.formats import ExportFormat
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.predecessor_exports import PredecessorOptions, unchanged_original, write_predecessor
from marey_server.store import items
from marey_server.store.transaction import Transaction

WITH_MOTION = (Kind.CLIP, Kind.PROCESSED)
"""The kinds whose part `motion` can be written as a file of motion."""

ExportTime = Literal["canonical", "source"]


@dataclass(frozen=True, slots=True)
class ExportSource:
    """An item's documents at one revision; for motions and models also the hierarchy of their skeleton."""

    item: Item
    revision: int
    parts: dict[str, dict[str, Any]]
    hierarchy: dict[str, Any] | None


@dataclass(frozen=True, slots=True)
class ServedFile:
    """A file to hand out."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class OriginalFile:
    """The file that an item was imported from, as it came."""

    name: str
    digest: str


def read_source(tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None) -> ExportSource:
    """Everything that a file of an item can need. Raises `NotFoundProblem`."""
    found = items.read_item(tx, project, kind, item_id)
    number = found.revision if revision is None else revision
    held = items.read_revision(tx, project, kind, item_id, number).parts
    parts = {part: items.read_part(tx, project, kind, item_id, part, revision=number).tree for part in sorted(held)}
    hierarchy = None
    if kind in WITH_MOTION or kind is Kind.MODEL:
        ref = parts["model" if kind is Kind.MODEL else "motion"]["skeleton"]
        hierarchy = items.read_part(tx, project, Kind.SKELETON, ref["item"], "hierarchy", revision=ref["revision"]).tree
    return ExportSource(found, number, parts, hierarchy)


def find_unchanged_original(
    tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None, options: PredecessorOptions
) -> OriginalFile | None:
    """The file that a model, a tree or a graph was imported from, if that still says the same.

    Raises `NotFoundProblem`.
    """
    if kind not in (Kind.MODEL, Kind.GRAPH):
        return None
    found = items.read_item(tx, project, kind, item_id)
    number = found.revision if revision is None else revision
    held = items.read_revision(tx, project, kind, item_id, number).parts
    wanted = [part for part in held if part in ("model", "graph", options.part)]
    parts = {
        part: items.read_part(tx, project, kind, item_id, part, revision=number, arrays="none").tree for part in wanted
    }
    original = unchanged_original(kind, parts, options)
    return None if original is None else OriginalFile(original.name or found.name, original.blob)


def find_original(
    tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None, options: PredecessorOptions
) -> OriginalFile:
    """The file that an item, or a model's tree, was imported from.

    Raises `NotFoundProblem` where it was made otherwise.
    """
    if kind in (Kind.MODEL, Kind.GRAPH):
        asked = PredecessorOptions(part=options.part)  # in whatever layout it came
        unchanged = find_unchanged_original(tx, project, kind, item_id, revision, asked)
        if unchanged is not None:
            return unchanged
    if kind is Kind.CLIP:
        info = items.read_part(tx, project, kind, item_id, "info", revision=revision, arrays="none").tree
        source = info.get("source", {})
        if source.get("file"):
            name = str(source.get("file_name") or item_id).replace("\\", "/").rpartition("/")[2]
            return OriginalFile(name, source["file"])
    raise NotFoundProblem("It was not made from a file; ask for another format, such as bvh.", code="no-original")


def write_file(
    source: ExportSource, file_format: ExportFormat, unit: str, time: ExportTime, options: PredecessorOptions
) -> ServedFile:
    """The file of an item. Raises `InvalidProblem` where the format cannot hold it."""
    if time == "source" and source.item.kind is not Kind.PROCESSED:
        raise InvalidProblem(
            "Only an aligned clip has a time of its own and that of its source.", code="no-such-export"
        )
    beside = source.item.kind is Kind.PROCESSED and options.part == "alignment"
    if file_format == "predecessor" and (beside or source.item.kind not in WITH_MOTION):
        name, data = write_predecessor(source.item.kind, source.item.name, source.parts, source.hierarchy, options)
        return ServedFile(name, codecs.JSON, data)
    if file_format == "json":
        return ServedFile(f"{source.item.name}.json", codecs.JSON, codecs.encode_tree(_as_tree(source), codecs.JSON))
    if source.item.kind not in WITH_MOTION or source.hierarchy is None:
        raise InvalidProblem(f"A {source.item.kind} is exported as json.", code="no-such-export")
    from marey_motion.alignment.aligned_documents import restored_clip
    from marey_motion.documents import clip_from_document, skeleton_from_document
    from marey_motion.errors import MotionError
    from marey_motion.exporting import write_clip_file

    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(source.hierarchy))
    clip = clip_from_document(MotionDocument.model_validate(source.parts["motion"]), skeleton)
    try:
        if time == "source":
            clip = restored_clip(clip, AlignmentInfo.model_validate(source.parts["info"]).model_dump())
        written = write_clip_file(clip, file_format, unit=unit, info=source.parts.get("info"))
    except MotionError as error:
        raise InvalidProblem(str(error), code="cannot-be-exported") from error
    return ServedFile(source.item.name + written.suffix, written.media_type, written.data)


def _as_tree(source: ExportSource) -> dict[str, Any]:
    item = source.item
    tree: dict[str, Any] = {
        "schema": "marey/item@1",
        "item": item.id,
        "kind": item.kind.value,
        "name": item.name,
        "collection": item.collection,
        "revision": source.revision,
        "tags": list(item.tags),
        "parts": source.parts,
    }
    return tree if source.hierarchy is None else {**tree, "skeleton": source.hierarchy}
