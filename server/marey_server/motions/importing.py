"""Import of uploaded files: read and encoded in threads, then stored, several in one transaction."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.clips import Check
from marey_schemas.encoding.codecs import JSON, encode_tree
from marey_schemas.imports import ImportEntry, Refusal, refused_entry
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.options.imports import ImportOptions
from marey_server.errors import ApiProblem, InvalidProblem
from marey_server.store import blobs, items, projects
from marey_server.store.blobs import Spool
from marey_server.store.documents import PreparedDocument, prepare_document
from marey_server.store.items import Draft, ItemFilters, Published
from marey_server.store.projects import ProjectRow
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules take a second to load: only who imports files pays for them
    from marey_motion.importing.items import GivenSkeleton, ImportedFile, ImportedGraph, ImportedItem
    from marey_motion.importing.plan import PlannedFile

REFUSED_ALTOGETHER = (401, 403, 404, 503, 507)
"""Errors that concern the whole request and not a single file."""

_SKELETONS: LruCache[bytes, PreparedDocument] = LruCache(max_entries=64)
"""Cache of checked and encoded skeleton hierarchies, by their JSON."""


@dataclass(frozen=True, slots=True)
class SourceFile:
    """File to import: received bytes, or a stored blob (`content` is None)."""

    name: str
    digest: str
    size_bytes: int
    content: bytes | Spool | None

    def read(self) -> bytes:
        """Return the bytes of the file."""
        assert self.content is not None
        return b"".join(self.content.chunks()) if isinstance(self.content, Spool) else self.content


@dataclass(frozen=True, slots=True)
class PreparedImport:
    """File that was read and encoded, ready to be stored, or its entry in the answer if there is nothing to store."""

    name: str
    sources: tuple[SourceFile, ...] = ()
    drafts: tuple[Draft, ...] = ()
    found: ImportedFile | None = None
    checks: tuple[Check, ...] = ()
    frames: int | None = None
    graph: ImportedGraph | None = None
    entry: ImportEntry | None = None


def read_skeleton(tx: Transaction, project: str, item_id: str) -> GivenSkeleton:
    """Read the skeleton named in the options of an import. Raises `NotFoundProblem`."""
    from marey_motion.importing.items import GivenSkeleton

    part = items.read_part(tx, project, Kind.SKELETON, item_id, "hierarchy")
    return GivenSkeleton(item_id, part.revision, part.tree)


def plan(names: Sequence[str]) -> list[PlannedFile]:
    """Return the import plan of each file of a batch."""
    from marey_motion.importing.plan import plan_imports

    return plan_imports(names)


def prepare(
    planned: PlannedFile, sources: Sequence[SourceFile], options: ImportOptions, skeleton: GivenSkeleton | None
) -> PreparedImport:
    """Read a file with its companion and encode its documents. This is the slow part and needs no database."""
    from marey_motion.importing.files import import_file, planned_entry
    from marey_motion.importing.items import FileToImport

    if (entry := planned_entry(planned)) is not None:
        return PreparedImport(planned.name, entry=entry)
    file, companion = sources[0], sources[1] if len(sources) > 1 else None
    found = import_file(
        FileToImport(
            planned,
            file.read(),
            file.digest,
            options,
            companion=None if companion is None else companion.read(),
            companion_digest=None if companion is None else companion.digest,
            skeleton=skeleton,
        )
    )
    if found.refusal is not None:
        return PreparedImport(planned.name, entry=refused_entry(planned.name, found.refusal))
    try:
        drafts = tuple(map(_draft, found.items))
    except ApiProblem as error:
        return PreparedImport(planned.name, entry=_refused(planned.name, error))
    checks = tuple(map(Check.model_validate, found.checks))
    return PreparedImport(planned.name, tuple(sources), drafts, found, checks, found.frames, graph=found.graph)


def new_skeletons(tx: Transaction, project: str, files: Sequence[PreparedImport]) -> set[str]:
    """Return the digests of the files' skeletons that the project does not have yet."""
    digests = {_hierarchy(draft).digest for file in files for draft in file.drafts if draft.kind is Kind.SKELETON}
    return digests - items.find_contents(tx, project, Kind.SKELETON, "hierarchy", digests)


def add_mappings(files: Sequence[PreparedImport], new: Collection[str]) -> list[PreparedImport]:
    """Add joint mapping and axes to new skeletons, derived from the first file of each skeleton."""
    mappings: dict[str, PreparedDocument] = {}
    return [_with_mapping(file, new, mappings) for file in files]


def _with_mapping(file: PreparedImport, new: Collection[str], mappings: dict[str, PreparedDocument]) -> PreparedImport:
    from marey_motion.importing.files import mapping_part

    drafts = []
    for draft in file.drafts:
        if draft.kind is Kind.SKELETON and (digest := _hierarchy(draft).digest) in new:
            assert file.found is not None
            if digest not in mappings:
                mappings[digest] = prepare_document(mapping_part(file.found))
            draft = replace(draft, parts={**draft.parts, "mapping": mappings[digest]})
        drafts.append(draft)
    return replace(file, drafts=tuple(drafts))


def _hierarchy(draft: Draft) -> PreparedDocument:
    document = draft.parts["hierarchy"]
    assert isinstance(document, PreparedDocument)
    return document


def _draft(item: ImportedItem) -> Draft:
    def prepared(tree: dict[str, Any]) -> PreparedDocument:
        return prepare_document(tree, schema=tree["schema"])

    if item.kind is Kind.SKELETON:  # many files of an upload have the same one
        parts = {
            part: _SKELETONS.get_or_make(encode_tree(tree, JSON), lambda tree=tree: prepared(tree))  # type: ignore[misc]
            for part, tree in item.parts.items()
        }
    else:
        parts = {part: prepared(tree) for part, tree in item.parts.items()}
    return Draft(item.name, item.kind, item.item_name, parts, item.collection, item.tags, reuse=item.reuse)


def _refused(name: str, error: ApiProblem) -> ImportEntry:
    return refused_entry(name, Refusal(code=error.error_code, detail=error.detail))


def publish(tx: Transaction, project: str, files: Sequence[PreparedImport]) -> list[ImportEntry]:
    """Store the original files and the items read from them; return one entry for each file.

    A file that cannot be stored is refused and does not affect others.
    """
    row = projects.require(tx, project)
    entries: list[ImportEntry] = []
    for together in _runs(files):
        try:
            with tx.connection.begin_nested():
                entries += _publish(tx, row, together)
        except ApiProblem as error:
            if error.status in REFUSED_ALTOGETHER:
                raise
            entries += [_publish_alone(tx, row, file) for file in together]
    return entries


def _runs(files: Sequence[PreparedImport]) -> Iterator[list[PreparedImport]]:
    """Split files into runs that are published together; a graph is a separate run, because it names earlier models."""
    for is_graph, run in itertools.groupby(files, lambda file: file.graph is not None):
        if is_graph:
            yield from ([file] for file in run)
        else:
            yield list(run)


def _publish_alone(tx: Transaction, row: ProjectRow, file: PreparedImport) -> ImportEntry:
    try:
        with tx.connection.begin_nested():
            return _publish(tx, row, [file])[0]
    except ApiProblem as error:
        if error.status in REFUSED_ALTOGETHER:
            raise
        return _refused(file.name, error)


def _publish(tx: Transaction, row: ProjectRow, files: Sequence[PreparedImport]) -> list[ImportEntry]:
    drafts: dict[str, tuple[Draft, ...]] = {}
    for file in files:
        if file.entry is None:
            drafts[file.name] = file.drafts if file.graph is None else (graph_draft(tx, row.name, file.graph),)
            for source in file.sources:
                if source.content is not None:
                    blobs.put_blob(tx, source.content, expected=source.digest)
    every = [draft for some in drafts.values() for draft in some]
    published = iter(items.publish(tx, row, every, author_id=tx.principal.user_id))
    made = {name: list(itertools.islice(published, len(some))) for name, some in drafts.items()}
    return [file.entry or _entry(file, made[file.name]) for file in files]


def graph_draft(tx: Transaction, project: str, graph: ImportedGraph) -> Draft:
    """Return the draft of a graph with models of the project. Raises `InvalidProblem`."""
    from marey_motion.errors import MotionError
    from marey_motion.importing.graphs import FEW, NamedModel, graph_item

    def find(name: str, collection: str | None) -> tuple[int, list[NamedModel]]:
        named = ItemFilters(exact_name=name, directly_in=collection)
        page = items.list_items(tx, project, Kind.MODEL, named, limit=FEW, count=True)
        return page.count or 0, [NamedModel(one.path, {"item": one.id, "revision": one.revision}) for one in page.items]

    try:
        return _draft(graph_item(graph, find))
    except MotionError as error:
        raise InvalidProblem(str(error), code=error.code) from error


def _entry(file: PreparedImport, published: Sequence[Published]) -> ImportEntry:
    made = {one.kind: one for one in published}
    kinds = [kind for kind in (Kind.CLIP, Kind.MODEL, Kind.GRAPH, Kind.SKELETON) if kind in made]
    if not kinds:  # not a StopIteration: a future does not accept it, so the request would wait for ever
        raise RuntimeError(f"the import of {file.name} published no clip, model, graph or skeleton")
    main = made[kinds[0]]
    skeleton = made.get(Kind.SKELETON)
    return ImportEntry(
        name=file.name,
        status="created" if any(one.created for one in published if one.kind is main.kind) else "unchanged",
        item=main.item,
        revision=main.revision,
        skeleton=skeleton.item if skeleton is not None else None,
        frames=file.frames,
        warnings=file.checks,
    )
