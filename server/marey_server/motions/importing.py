"""Import of uploaded files: child processes read and encode the files; the server stores them.

Several files are stored in one transaction.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, NamedTuple

from marey_schemas.access import Role
from marey_schemas.documents.clips import Check
from marey_schemas.imports import ImportEntry, Refusal, published_entry, refused_entry
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions, UpAxis
from marey_server.access.folder_rights import FolderRoleProblem
from marey_server.errors import ApiProblem, InvalidProblem
from marey_server.motions.loading import LOADING
from marey_server.prepared_documents import PreparedDocument, prepare_document
from marey_server.store import blobs, items, projects
from marey_server.store.blob_backings import Spool
from marey_server.store.folder_roles.rights import rights_of_caller, rights_shown
from marey_server.store.items import Draft, Namesakes, Published
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.quotas import daily
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules take a second to load, so they are loaded only for imports
    from marey_motion.importing.items import GivenSkeleton, ImportedGraph
    from marey_motion.importing.plan import PlannedFile
    from marey_motion.importing.siblings import AxisFinding

REFUSED_ALTOGETHER = (401, 403, 404, 499, 503, 507)
"""HTTP status codes of errors that concern the whole request and not a single file."""

MAIN_KINDS = (Kind.CLIP, Kind.PROCESSED, Kind.MODEL, Kind.GRAPH, Kind.SKELETON, Kind.RECORD)
"""Kinds of items: each imported file contains at least one item of these kinds, and may also contain annotations."""

READ_FILE = "marey_server.motions.reading:read_file"
FIND_MAPPING = "marey_server.motions.reading:find_mapping"
"""Function that child processes run; so is `READ_FILE`."""


@dataclass(frozen=True, slots=True)
class SourceFile:
    """File to import: received bytes, or a stored blob (`content` is None)."""

    name: str
    digest: str
    size_bytes: int
    content: bytes | Spool | None

    def read(self) -> bytes:
        """Return the content of the file."""
        assert self.content is not None
        return b"".join(self.content.chunks()) if isinstance(self.content, Spool) else self.content


@dataclass(frozen=True, slots=True)
class PreparedImport:
    """File of an import after a child process has read it, ready to be stored.

    If there is nothing to store, `entry` is the answer's entry for the file. `axis` states which axis of the file
    points up, and how clearly the motion shows this.
    """

    name: str
    sources: tuple[SourceFile, ...] = ()
    drafts: tuple[Draft, ...] = ()
    checks: tuple[Check, ...] = ()
    frames: int | None = None
    graph: ImportedGraph | None = None
    entry: ImportEntry | None = None
    axis: AxisFinding | None = None


def read_skeleton(tx: Transaction, project: str, item_id: str) -> GivenSkeleton:
    """Return the skeleton given in the options of an import. Raises `NotFoundProblem` if it does not exist."""
    with LOADING:
        from marey_motion.importing.items import GivenSkeleton

    part = items.read_part(tx, project, Kind.SKELETON, item_id, "hierarchy")
    return GivenSkeleton(item_id, part.revision, part.tree)


def plan(names: Sequence[str]) -> tuple[list[PlannedFile], list[int]]:
    """Decide for each file of an import whether it is read, read together with another file, or refused.

    Return these decisions in the order of `names`, and the indices of the files in the order in which they are read.
    """
    with LOADING:
        from marey_motion.importing.plan import plan_imports, reading_order

    plans = plan_imports(names)
    return plans, reading_order(plans)


def planned_entry(planned: PlannedFile) -> PreparedImport | None:
    """Return the entry in the answer for a file that needs no order of its own, or None if the file is to be read.

    Files that are read together with another file need no order, and neither do files whose names are refused.
    """
    with LOADING:
        from marey_motion.importing.files import planned_entry

    entry = planned_entry(planned)
    return None if entry is None else PreparedImport(planned.name, entry=entry)


def file_order(
    planned: PlannedFile,
    sources: Sequence[SourceFile],
    options: ImportOptions,
    skeleton: GivenSkeleton | None,
    sibling_axis: UpAxis | None,
) -> bytes:
    """Return the packed message that asks a child process to read a file together with the files that accompany it.

    `sources` are these files with their content. `sibling_axis` is the upward axis that other files with the same
    skeleton show.
    """
    with LOADING:
        from marey_server.motions.reading import FileOrder, packed_skeleton

    named = {source.name: source for source in sources}
    file = named[planned.name]
    companion = None if planned.companion is None else named[planned.companion]
    notes = None if planned.notes is None else named[planned.notes]
    return FileOrder(
        planned=planned,
        content=file.read(),
        digest=file.digest,
        options=options,
        companion=None if companion is None else companion.read(),
        companion_digest=None if companion is None else companion.digest,
        skeleton=packed_skeleton(skeleton),
        sibling_axis=sibling_axis,
        notes=None if notes is None else notes.read(),
        notes_digest=None if notes is None else notes.digest,
    ).pack()


def prepared_import(name: str, sources: Sequence[SourceFile], answer: bytes) -> PreparedImport:
    """Convert the answer of a child process that has read a file to a `PreparedImport`."""
    with LOADING:
        from marey_server.motions.reading import ReadFile

    found = ReadFile.unpack(answer)
    if found.refusal is not None:
        return PreparedImport(name, entry=refused_entry(name, found.refusal), axis=found.axis)
    drafts = tuple(
        Draft(
            item.name, item.kind, item.item_name, item.documents(), item.collection, item.tags, reuse=item.reuse,
            same_skeleton=item.same_skeleton,
        )
        for item in found.items
    )  # fmt: skip
    graph = None if found.graph is None else found.graph.graph()
    return PreparedImport(name, tuple(sources), drafts, found.checks, found.frames, graph=graph, axis=found.axis)


class WaitingFiles:
    """Files of an import that need other files: graphs of models, and files that do not show which axis points up.

    They wait until all other files have been read and stored: a graph refers to models, and another file with the same
    skeleton may show the axis.
    """

    def __init__(self) -> None:
        self._files: dict[int, PreparedImport] = {}
        self._findings: list[AxisFinding] = []

    def take(self, place: int, file: PreparedImport) -> bool:
        """Record the upward axis found in a file; return whether the file must wait for the other files.

        `place` is the index of the file in the import. A graph that contains its models (a zipped graph) need not wait.
        """
        if file.graph is not None and not file.drafts:
            self._files[place] = file
            return True
        if file.axis is None:
            return False
        self._findings.append(file.axis)
        if file.axis.is_clear:
            return False
        self._files[place] = file
        return True

    def files(self) -> Iterator[tuple[int, PreparedImport, UpAxis | None]]:
        """Yield the waiting files: index in the import, the file as it was read, and the upward axis to use.

        The file must be read again with this axis; if the axis is None, it need not be read again.
        """
        with LOADING:
            from marey_motion.importing.siblings import axes_of_skeletons, axis_of_siblings

        axes = axes_of_skeletons(self._findings)
        for place, file in self._files.items():
            yield place, file, axis_of_siblings(file.axis, axes)


def refused_import(name: str, error: ApiProblem) -> PreparedImport:
    """Return the import of a refused file, with the reason in its entry.

    Raises `error` again if it concerns the whole request and not a single file.
    """
    if error.status in REFUSED_ALTOGETHER:
        raise error
    return PreparedImport(name, entry=_refused(name, error))


def new_skeletons(tx: Transaction, project: str, files: Sequence[PreparedImport]) -> set[str]:
    """Return the digests of those skeletons in the files that the project does not have yet."""
    digests = {_hierarchy(draft).digest for file in files for draft in file.drafts if draft.kind is Kind.SKELETON}
    return digests - items.find_contents(tx, project, Kind.SKELETON, "hierarchy", digests)


def firsts_of_skeletons(files: Sequence[PreparedImport], new: Collection[str]) -> dict[str, PreparedImport]:
    """Return a mapping from the digest of each new skeleton to the first file that contains the skeleton."""
    firsts: dict[str, PreparedImport] = {}
    for file in files:
        for digest in new:
            if _has_skeleton(file, digest):
                firsts.setdefault(digest, file)
    return firsts


def mapping_order(file: PreparedImport) -> bytes:
    """Return the packed message that asks a child process to find the joint mapping and axes of a file's skeleton."""
    with LOADING:
        from marey_server.motions.reading import ReadDocument

    return ReadDocument.of(_hierarchy(file.drafts[0])).pack()


def found_mapping(answer: bytes) -> PreparedDocument:
    """Unpack the part `mapping` from the answer of a child process."""
    with LOADING:
        from marey_server.motions.reading import ReadDocument

    return ReadDocument.unpack(answer).document()


def add_mapping(files: Sequence[PreparedImport], digest: str, mapping: PreparedDocument) -> list[PreparedImport]:
    """Add `mapping` to the skeleton with the given digest in each file that has this skeleton; return all files."""

    def with_mapping(draft: Draft) -> Draft:
        if draft.kind is not Kind.SKELETON or "mapping" in draft.parts:
            return draft
        return replace(draft, parts={**draft.parts, "mapping": mapping})

    return [
        replace(file, drafts=tuple(map(with_mapping, file.drafts))) if _has_skeleton(file, digest) else file
        for file in files
    ]


def refuse_with_skeleton(files: Sequence[PreparedImport], digest: str, error: ApiProblem) -> list[PreparedImport]:
    """Replace each file that contains the skeleton with this digest by a refusal; return all files.

    `error` is the reason why no joint mapping could be derived for the skeleton.
    """
    return [refused_import(file.name, error) if _has_skeleton(file, digest) else file for file in files]


def _has_skeleton(file: PreparedImport, digest: str) -> bool:
    return any(draft.kind is Kind.SKELETON and _hierarchy(draft).digest == digest for draft in file.drafts)


def _hierarchy(draft: Draft) -> PreparedDocument:
    return _part(draft, "hierarchy")


def _part(draft: Draft, part: str) -> PreparedDocument:
    document = draft.parts[part]
    assert isinstance(document, PreparedDocument)
    return document


def _refused(name: str, error: ApiProblem) -> ImportEntry:
    return refused_entry(name, Refusal(code=error.error_code, detail=error.detail))


def require_folder(tx: Transaction, project: str, folder: str) -> None:
    """Raise `ForbiddenProblem` unless the caller may import files into a folder."""
    rights_shown(tx, projects.require(tx, project)).require(folder, Role.CONTRIBUTOR)


def publish(tx: Transaction, project: str, files: Sequence[PreparedImport]) -> list[ImportEntry]:
    """Store the original files and the items read from them; return one entry for each file.

    A file that cannot be stored is refused and does not affect other files. The sent bytes are counted last, because
    other requests of the user must wait from this count to the end of the transaction.
    """
    row = projects.require(tx, project)
    hold_off_purges(tx, row.id)
    rights_of_caller(tx, row)  # here, because a rollback below would release their lock
    entries: list[ImportEntry] = []
    sent_bytes = 0
    for together in _runs(files):
        try:
            stored = [_publish(tx, row, together, sent_bytes)]
        except ApiProblem as error:
            if _concerns_request(error):
                raise
            stored = []
            for file in together:
                stored.append(_publish_alone(tx, row, file, sent_bytes + sum(one.sent_bytes for one in stored)))
        entries += [entry for one in stored for entry in one.entries]
        sent_bytes += sum(one.sent_bytes for one in stored)
    daily.count_sent(tx, sent_bytes)
    return entries


class _Stored(NamedTuple):
    """Result of storing some files together: their entries in the answer, and the number of bytes new to the server."""

    entries: list[ImportEntry]
    sent_bytes: int = 0


def _runs(files: Sequence[PreparedImport]) -> Iterator[list[PreparedImport]]:
    """Split files into groups of consecutive files that are stored together.

    Each graph is a group of its own, because a graph can refer to models in earlier files, which must be stored first.
    """
    for is_graph, run in itertools.groupby(files, lambda file: file.graph is not None):
        if is_graph:
            yield from ([file] for file in run)
        else:
            yield list(run)


def _concerns_request(error: ApiProblem) -> bool:
    """Return whether an error concerns the whole request.

    A missing role in a folder concerns only files in this folder.
    """
    return error.status in REFUSED_ALTOGETHER and not isinstance(error, FolderRoleProblem)


def _publish_alone(tx: Transaction, row: ProjectRow, file: PreparedImport, sent_bytes: int) -> _Stored:
    try:
        return _publish(tx, row, [file], sent_bytes)
    except ApiProblem as error:
        if _concerns_request(error):
            raise
        return _Stored([_refused(file.name, error)])


def _publish(tx: Transaction, row: ProjectRow, files: Sequence[PreparedImport], sent_bytes: int) -> _Stored:
    """Store files together, or none of them, if an error occurs.

    `sent_bytes` is the number of new bytes of the files that this request has stored before; they count towards the
    caller's daily quota.
    """
    with tx.connection.begin_nested():
        fresh = [file for file in files if file.entry is None]
        sources = {one.digest: one.content for file in fresh for one in file.sources if one.content is not None}
        new_bytes = blobs.put_uncounted(tx, sources, project_id=row.id) if sources else 0
        if new_bytes:
            daily.require_sendable(tx, sent_bytes + new_bytes)
        rights = rights_of_caller(tx, row)
        store = partial(items.publish, tx, row, author_id=tx.principal.user_id, rights=rights)
        made = {one.name: one for one in store([draft for file in fresh for draft in file.drafts])}
        graphs = [graph_draft(tx, row.name, file.graph) for file in fresh if file.graph is not None]
        made |= {one.name: one for one in store(graphs)}
    return _Stored([file.entry or _entry(file, made) for file in files], new_bytes)


def graph_draft(tx: Transaction, project: str, graph: ImportedGraph) -> Draft:
    """Return the draft of a graph whose nodes refer to models of the project by name.

    Raises `InvalidProblem` if a model is missing or ambiguous.
    """
    with LOADING:
        from marey_motion.errors import MotionError
        from marey_motion.importing.graphs import FEW, NamedModel, graph_item

    names = {name for _, name in graph.graph.nodes}

    @cache
    def namesakes(folder: str | None) -> dict[str, Namesakes]:
        return items.find_namesakes(tx, project, Kind.MODEL, names, directly_in=folder, most=FEW)

    def find(name: str, folder: str | None) -> tuple[int, list[NamedModel]]:
        found = namesakes(folder).get(name)
        if found is None:
            return 0, []
        return found.count, [NamedModel(path, {"item": one, "revision": number}) for path, one, number in found.first]

    try:
        item = graph_item(graph, find)
    except MotionError as error:
        raise InvalidProblem(str(error), code=error.code) from error
    parts = {part: prepare_document(tree, schema=tree["schema"]) for part, tree in item.parts.items()}
    return Draft(item.name, item.kind, item.item_name, parts, item.collection, item.tags, reuse=item.reuse)


def _entry(file: PreparedImport, made: Mapping[str, Published]) -> ImportEntry:
    if file.graph is None and not any(draft.kind in MAIN_KINDS for draft in file.drafts):
        wanted = ", ".join(MAIN_KINDS)
        raise RuntimeError(f"none of {wanted} was created from {file.name!r}; this is a server error")
    read = ImportEntry(name=file.name, status="created", frames=file.frames, warnings=file.checks)
    return published_entry(read, made)
