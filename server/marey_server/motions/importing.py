"""Uploaded files become items: read and encoded in a thread, then published in one transaction per file."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.clips import Check
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.imports import ImportEntry, Refusal
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions
from marey_server.errors import ApiProblem
from marey_server.motions.importing_graphs import ImportedGraph, graph_draft, graph_to_import
from marey_server.store import blobs, items, projects
from marey_server.store.blobs import Spool
from marey_server.store.documents import prepare_document
from marey_server.store.items import Draft, Published
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules take a second to load: only who imports files pays for them
    from marey_motion.errors import MotionError
    from marey_motion.importing.files import ImportedDocuments, ImportRequest
    from marey_motion.importing.plan import PlannedFile

log = logging.getLogger(__name__)

SKELETON_COLLECTION = "skeletons"


@dataclass(frozen=True, slots=True)
class SourceFile:
    """A file to import: bytes that were sent just now, or `content` None for a blob that is stored already."""

    name: str
    digest: str
    size_bytes: int
    content: bytes | Spool | None

    def read(self) -> bytes:
        """All its bytes."""
        assert self.content is not None
        return b"".join(self.content.chunks()) if isinstance(self.content, Spool) else self.content


@dataclass(frozen=True, slots=True)
class PreparedImport:
    """What a file becomes when it is published, or why it does not."""

    name: str
    drafts: tuple[Draft, ...] = ()
    checks: tuple[Check, ...] = ()
    frames: int | None = None
    refusal: Refusal | None = None
    graph: ImportedGraph | None = None


@dataclass(frozen=True, slots=True)
class GivenSkeleton:
    """The skeleton that the caller wants the clips on."""

    item: str
    revision: int
    hierarchy: dict[str, Any]


def require_importer(tx: Transaction, project: str) -> None:
    """Refuse callers who may not import into the project, before their files are taken in."""
    projects.require(tx, project)


def read_skeleton(tx: Transaction, project: str, item_id: str) -> GivenSkeleton:
    """The skeleton that an import names. Raises `NotFoundProblem`."""
    part = items.read_part(tx, project, Kind.SKELETON, item_id, "hierarchy")
    return GivenSkeleton(item_id, part.revision, part.tree)


def plan(names: Sequence[str]) -> list[PlannedFile]:
    """What becomes of each file of a batch."""
    from marey_motion.importing.plan import plan_imports

    return plan_imports(names)


def motion_request(options: ImportOptions, skeleton: GivenSkeleton | None) -> ImportRequest:
    """The options in the words of the readers."""
    from marey_motion import documents
    from marey_motion.importing import files

    readers = files.import_options(options.model_dump())
    own = None
    if skeleton is not None:
        own = documents.skeleton_from_document(SkeletonHierarchy.model_validate(skeleton.hierarchy))
    ref = None if skeleton is None else {"item": skeleton.item, "revision": skeleton.revision}
    return files.ImportRequest(readers, options.subject, options.licence, options.capture_system, own, ref)


def prepare(
    planned: PlannedFile,
    file: SourceFile,
    companion: SourceFile | None,
    options: ImportOptions,
    request: ImportRequest,
) -> PreparedImport:
    """Read one file and encode its documents: the slow part, which needs no database."""
    from marey_motion.errors import MotionError
    from marey_motion.importing.files import FileDigests, import_file

    digests = FileDigests(file.digest)
    if companion is not None:
        digests = FileDigests(file.digest, companion.digest, companion.name)
    try:
        found = import_file(planned, file.read(), digests, request, companion.read() if companion else None)
        return PreparedImport(
            planned.name,
            _drafts(planned, found, options),
            tuple(Check.model_validate(check) for check in found.checks),
            None if found.motion is None else len(found.motion["poses"]),
            graph=graph_to_import(found.modelled, _collection(planned, options), options.tags, file),
        )
    except MotionError as error:
        return PreparedImport(planned.name, refusal=_refusal(error))
    except ApiProblem as error:
        return PreparedImport(planned.name, refusal=Refusal(code=error.error_code, detail=error.detail))


def _refusal(error: MotionError) -> Refusal:
    place = {name: value for name in ("line", "joint") if (value := getattr(error, name, None)) is not None}
    return Refusal(code=error.code, detail=str(error), **place)


def _drafts(planned: PlannedFile, found: ImportedDocuments, options: ImportOptions) -> tuple[Draft, ...]:
    drafts = []
    if found.hierarchy is not None and found.mapping is not None:
        parts = {"hierarchy": found.hierarchy, "mapping": found.mapping}
        drafts.append(_draft("skeleton", Kind.SKELETON, found.skeleton_name, SKELETON_COLLECTION, parts, "by_content"))
    if found.motion is not None and found.info is not None:
        parts = {"motion": found.motion, "info": found.info}
        place = _collection(planned, options)
        drafts.append(_draft("clip", Kind.CLIP, planned.item_name, place, parts, "by_name", options.tags))
    if found.modelled is not None and found.modelled.parts:
        place = _collection(planned, options)
        made = found.modelled
        drafts.append(_draft("model", Kind.MODEL, made.name, place, made.parts, "by_name", options.tags))
    return tuple(drafts)


def _collection(planned: PlannedFile, options: ImportOptions) -> str:
    return "/".join(part for part in (options.collection, planned.folder) if part)


def _draft(
    name: str,
    kind: Kind,
    item_name: str,
    collection: str,
    parts: Mapping[str, dict[str, Any]],
    reuse: Any,
    tags: Sequence[str] = (),
) -> Draft:
    prepared = {part: prepare_document(tree, schema=tree["schema"]) for part, tree in parts.items()}
    return Draft(name, kind, item_name, prepared, collection, tags, reuse=reuse)


def publish(tx: Transaction, project: str, prepared: PreparedImport, sources: Sequence[SourceFile]) -> list[Published]:
    """Store the original files and what was read from them, in one transaction."""
    row = projects.require(tx, project)
    for source in sources:
        if source.content is not None:
            blobs.put_blob(tx, source.content, expected=source.digest)
    author = tx.principal.user_id
    published = items.publish(tx, row, prepared.drafts, author_id=author)
    if prepared.graph is not None:
        published += items.publish(tx, row, [graph_draft(tx, project, prepared.graph)], author_id=author)
    return published


def entry_of(prepared: PreparedImport, published: Sequence[Published]) -> ImportEntry:
    """What the caller is told about a file."""
    if prepared.refusal is not None:
        return ImportEntry(name=prepared.name, status="failed", error=prepared.refusal)
    made = {one.kind: one for one in published}
    main = next(made[kind] for kind in (Kind.CLIP, Kind.MODEL, Kind.GRAPH, Kind.SKELETON) if kind in made)
    skeleton = made.get(Kind.SKELETON)
    return ImportEntry(
        name=prepared.name,
        status="created" if any(one.created for one in published if one.kind is main.kind) else "unchanged",
        item=main.item,
        revision=main.revision,
        skeleton=skeleton.item if skeleton is not None else None,
        frames=prepared.frames,
        warnings=prepared.checks,
    )
