"""Export of items as files: the sources are read in one transaction, and the file is written in a child process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from marey_schemas.encoding import codecs
from marey_schemas.item_files import ItemToExport, OriginalFile, item_as_json, original_of_clip
from marey_schemas.kinds import Kind
from marey_schemas.options.exporting import MotionFileOptions
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.child import ComputedFile, Message, pack_tree, unpack_tree
from marey_server.motions.predecessor_exports import (
    DOCUMENTS_OF,
    PredecessorOptions,
    unchanged_original,
    write_predecessor,
)
from marey_server.store import items
from marey_server.store.transaction import Transaction

EXPORT_ITEM = "marey_server.motions.exporting:export_item"
"""Function that child processes run."""
WITH_MOTION = (Kind.CLIP, Kind.PROCESSED)
"""Kinds with a part `motion` that can be written as a motion file."""

ExportTime = Literal["canonical", "source"]


class ExportOrder(Message):
    """Message that asks a child process to write the file of an item, whose documents are given as bytes."""

    item: str
    kind: Kind
    name: str
    collection: str
    revision: int
    parts: dict[str, bytes]
    hierarchy: bytes | None
    tags: tuple[str, ...] | None
    file: MotionFileOptions
    time: ExportTime
    options: PredecessorOptions

    def source(self) -> ItemToExport:
        """Return the item with its decoded documents."""
        return ItemToExport(
            self.item, self.kind, self.name, self.collection, self.revision,
            {part: unpack_tree(packed) for part, packed in self.parts.items()},
            None if self.hierarchy is None else unpack_tree(self.hierarchy),
            self.tags,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ExportSource:
    """Item with the documents that an export needs, and their size in bytes."""

    item: ItemToExport
    size_bytes: int


def read_source(
    tx: Transaction, project: str, kind: Kind, item_id: str, revision: int | None, *, permitted: bool
) -> ExportSource:
    """Return an item with all documents that a file format may need.

    Raises `NotFoundProblem` if the item does not exist. Raises `ConflictProblem` if the consent for the clip has ended,
    unless the export is `permitted`.
    """
    found = items.read_item(tx, project, kind, item_id)
    if kind in WITH_MOTION and not permitted:
        items.require_consent(items.find_ended_consents(tx, [item_id]).values())
    number = found.revision if revision is None else revision
    held = items.read_revision(tx, project, kind, item_id, number).parts
    loaded = {part: items.read_part(tx, project, kind, item_id, part, revision=number) for part in sorted(held)}
    parts = {name: part.tree for name, part in loaded.items()}
    size_bytes = sum(part.size_bytes for part in loaded.values())
    hierarchy = None
    if kind in WITH_MOTION or kind is Kind.MODEL:
        ref = parts["model" if kind is Kind.MODEL else "motion"]["skeleton"]
        skeleton = items.read_part(tx, project, Kind.SKELETON, ref["item"], "hierarchy", revision=ref["revision"])
        hierarchy, size_bytes = skeleton.tree, size_bytes + skeleton.size_bytes
    item = ItemToExport(item_id, kind, found.name, found.collection, number, parts, hierarchy, found.tags)
    return ExportSource(item, size_bytes)


def find_unchanged_original(
    tx: Transaction,
    project: str,
    kind: Kind,
    item_id: str,
    revision: int | None,
    options: PredecessorOptions,
    *,
    permitted: bool,
) -> OriginalFile | None:
    """Return the file of Marey's predecessor from which an item was imported, if the item is unchanged since then.

    Return None if the item was changed, if it was not imported from such a file, or if `options` ask for another form
    of the file. Raises `NotFoundProblem` if the item or the revision does not exist. Raises `ConflictProblem` if the
    consent for the clip has ended, unless the export is `permitted`.
    """
    if kind not in DOCUMENTS_OF:
        return None
    found = items.read_item(tx, project, kind, item_id)
    if kind in WITH_MOTION and not permitted:
        items.require_consent(items.find_ended_consents(tx, [item_id]).values())
    number = found.revision if revision is None else revision
    held = items.read_revision(tx, project, kind, item_id, number).parts
    parts = {
        part: items.read_part(tx, project, kind, item_id, part, revision=number, arrays="none").tree
        for part in DOCUMENTS_OF[kind]
        if part in held
    }
    original = unchanged_original(kind, parts, options)
    return None if original is None else OriginalFile(original.name or found.name, original.blob)


def find_original(
    tx: Transaction,
    project: str,
    kind: Kind,
    item_id: str,
    revision: int | None,
    options: PredecessorOptions,
    *,
    permitted: bool,
) -> OriginalFile:
    """Return the file that an item was imported from. Items other than clips must be unchanged since the import.

    Raises `NotFoundProblem` if the item was not imported from a file, or has changed since the import. Raises
    `ConflictProblem` if the consent for the clip has ended, unless the export is `permitted`.
    """
    if kind is Kind.CLIP:
        info = items.read_part(tx, project, kind, item_id, "info", revision=revision, arrays="none").tree
        if not permitted:
            items.require_consent(items.find_ended_consents(tx, [item_id]).values())
        original = original_of_clip(item_id, info)
    else:
        asked = PredecessorOptions(part=options.part)  # in whatever layout it came
        original = find_unchanged_original(tx, project, kind, item_id, revision, asked, permitted=permitted)
    if original is not None:
        return original
    raise NotFoundProblem(
        "The item has no original file, because it was not imported from a file or was changed since; request another "
        "format, such as json, or bvh for a clip.",
        code="no-original",
    )


def export_order(source: ItemToExport, file: MotionFileOptions, time: ExportTime, options: PredecessorOptions) -> bytes:
    """Return the packed message that asks a child process to write the file of an item."""
    return ExportOrder(
        item=source.item,
        kind=source.kind,
        name=source.name,
        collection=source.collection,
        revision=source.revision,
        parts={part: pack_tree(tree) for part, tree in source.parts.items()},
        hierarchy=None if source.hierarchy is None else pack_tree(source.hierarchy),
        tags=None if source.tags is None else tuple(source.tags),
        file=file,
        time=time,
        options=options,
    ).pack()


# -- in the child ------------------------------------------------------------------------------------------------------


def export_item(packed: bytes) -> bytes:
    """Write the file of an item, in a child process.

    `packed` is an `ExportOrder`; the result is a `ComputedFile` as bytes.
    """
    order = ExportOrder.unpack(packed)
    return write_file(order.source(), order.file, order.time, order.options).pack()


def write_file(
    source: ItemToExport, file: MotionFileOptions, time: ExportTime, options: PredecessorOptions
) -> ComputedFile:
    """Return the file of an item in a format. Raises `InvalidProblem` if the format cannot represent the item."""
    if time == "source" and source.kind is not Kind.PROCESSED:
        raise InvalidProblem(
            "Only aligned clips can be exported with the timing of their source clip (time=source); leave out `time`.",
            code="no-such-export",
        )
    beside = source.kind is Kind.PROCESSED and options.part == "alignment"
    if file.format == "predecessor" and (beside or source.kind not in WITH_MOTION):
        name, data = write_predecessor(source.kind, source.name, source.parts, source.hierarchy, options)
        return ComputedFile(name=name, media_type=codecs.JSON, data=data)
    if file.format == "json":
        return ComputedFile(name=f"{source.name}.json", media_type=codecs.JSON, data=item_as_json(source))
    if source.kind not in WITH_MOTION or source.hierarchy is None:
        raise InvalidProblem(
            f"An item of the kind {source.kind} has no file in this format; request json.", code="no-such-export"
        )
    from marey_motion.errors import MotionError
    from marey_motion.exporting import write_motion_file

    try:
        written = write_motion_file(source, file, time=time)
    except MotionError as error:
        raise InvalidProblem(str(error), code="cannot-be-exported") from error
    return ComputedFile(name=source.name + written.suffix, media_type=written.media_type, data=written.data)
