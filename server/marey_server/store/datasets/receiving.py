"""Receipt of versions from archives and other servers; received revisions and commits keep their digests.

For each received revision that the project lacks, a new item is created. If the revision is the content of a dataset
entry, the item is hidden, and no folder shows it. Other items, such as the skeletons of clips, are in the folder
`IMPORTED`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Row, select

from marey_schemas.datasets.commits import Commit
from marey_schemas.datasets.contents import ReceivedCommit, ReceivedRevision, StoredRevisions
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import items, projects
from marey_server.store.datasets.chunks import StoredChunks, store_chunks
from marey_server.store.datasets.committing import (
    PreparedCommit,
    author_of,
    head_of,
    insert_commit,
    move_branch_to,
)
from marey_server.store.datasets.history import read_commit, revisions_with, tree_of
from marey_server.store.datasets.naming import dataset_replaced, find_dataset, find_ref
from marey_server.store.datasets.partial_contents import Bases, bases_named_in, load_bases, restored
from marey_server.store.datasets.protection import Mover
from marey_server.store.datasets.revisions import item_name, publish_contents, require_contents
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.items import Draft, StoredDocument
from marey_server.store.items.facets import fill_facets
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges, last_purge, require_no_purge_since
from marey_server.store.quotas import daily
from marey_server.store.tables import dataset_commit, item, revision
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import (
    CommitRecord,
    RevisionKey,
    contents_in,
    key_of,
    local_document,
    references_in,
    revision_content,
)
from marey_versions.tree.building import build
from marey_versions.tree.chunks import Value
from marey_versions.tree.editing import change
from marey_versions.tree.reading import Tree

IMPORTED = "imported"
"""Folder for new items whose revisions are not the content of entries; it has a subfolder for each kind of item."""


@dataclass(frozen=True)
class LocalRevisions:
    """Revisions of the project that a request contains or refers to (`held`), by content digest, with their data."""

    held: Mapping[str, RevisionKey]
    documents: Mapping[str, Mapping[str, str]]
    """Digests of the revisions' documents: by the content digest of the revision, then by the name of the part."""
    last_purge: int
    """Time in microseconds of the last purge of the project before the revisions were found, 0 if there was none."""
    facets: Mapping[str, Mapping[str, float]]
    """Facets of the received revisions, by content digest."""
    bases: Bases
    """Arrays of the project from which partial arrays and array differences of the request are restored."""


def find_local(
    tx: Transaction, project: str, received: Sequence[ReceivedRevision], take_bytes: Callable[[int], None]
) -> LocalRevisions:
    """Find those revisions of a request that the project has already, and the revisions to which the request refers.

    `take_bytes` is called with the total sizes of arrays that are restored and of their bases, before these take
    memory.

    Raises `ConflictProblem` if the project lacks a revision that a received revision refers to. Raises `InvalidProblem`
    if a received revision refers to an item of this project by its id, and for a partial array without its base.
    """
    project_row = projects.require(tx, project)
    last = last_purge(tx, project_row.id)
    _require_no_own_ids(tx, project_row.id, received)
    places = bases_named_in(received, take_bytes)
    wanted = {content for one in received for content in contents_in(one.parts)} | {one.content for one in places}
    found = revisions_with(tx, project_row.id, wanted | {one.content for one in received})
    require_contents(wanted - found.keys())
    parts = read_part_digests(tx, set(found.values()))
    held = {content: RevisionKey(*key) for content, key in found.items()}
    stored = {content: parts[key] for content, key in held.items()}
    facets = {one.content: one.facets for one in received}
    return LocalRevisions(held, stored, last, facets, load_bases(tx, places, stored, take_bytes))


def _require_no_own_ids(tx: Transaction, project_id: str, received: Sequence[ReceivedRevision]) -> None:
    """Raise `InvalidProblem` if a received document refers to an item of this project by its id.

    In this project, the id would count as a reference, so the document would get another content digest than the sender
    has computed. Senders replace the ids of their own project by content digests, but anybody can write ids of other
    projects into members of a document that have no schema.
    """
    named = {key: one for one in received for key in references_in(one.parts)}
    ids = sorted({key.item for key in named})
    for some in in_lists(ids):
        own = select(revision.c.item_id, revision.c.number).join(item, item.c.id == revision.c.item_id)
        for row in tx.execute(own.where(revision.c.item_id.in_(some), item.c.project_id == project_id)):
            one = named.get(RevisionKey(row.item_id, row.number))
            if one is not None:
                raise InvalidProblem(
                    f"The {one.kind.value} {one.path or one.content!r} refers to the item {row.item_id} of this "
                    f"project by id, so the content digest of the {one.kind.value} would change here. Receive the "
                    "versions in another project.",
                    code="other-content",
                    context={"content": one.content, "item": row.item_id, "revision": row.number},
                )


def prepare_revisions(received: Sequence[ReceivedRevision], local: LocalRevisions) -> dict[str, Draft]:
    """Check and encode the revisions that the project does not have; return their drafts by content digest.

    Raises `InvalidProblem` for a document that is not valid.
    """
    return {one.content: _draft(one, local) for one in received if one.content not in local.held}


def _draft(one: ReceivedRevision, local: LocalRevisions) -> Draft:
    parts: dict[str, PreparedDocument | StoredDocument] = {}
    for part, tree in one.parts.items():
        if isinstance(tree, dict) and tree.keys() == {"content"}:
            parts[part] = StoredDocument(_stored(one, part, str(tree["content"]), local))
        else:
            whole = restored(tree, part, local.bases)
            parts[part] = items.prepare_part(one.kind, part, local_document(whole, local.held.get))
    return Draft(
        name_in_batch=one.content, kind=one.kind, parts=dict(parts), reuse="new",
        item_name=item_name(one.path or one.kind.value, one.content),
        collection="" if one.path is not None else f"{IMPORTED}/{one.kind.plural}", hidden=one.path is not None,
    )  # fmt: skip


def _stored(one: ReceivedRevision, part: str, content: str, local: LocalRevisions) -> str:
    digest = local.documents.get(content, {}).get(part)
    if digest is None:
        raise InvalidProblem(
            f"The request takes the part {part!r} of the {one.kind} {one.path or one.content!r} from the revision "
            f"{content}, which has no such part.",
            code="no-part",
        )
    return digest


def store_revisions(
    tx: Transaction, project: str, name: str, drafts: Mapping[str, Draft], local: LocalRevisions
) -> StoredRevisions:
    """Store received revisions; `drafts` maps content digests to drafts that were made with `local`.

    If a revision is the content of a dataset entry, its item is hidden. Raises `InvalidProblem` if the content digest
    of a stored revision is not the one that the request gives. Raises `ConflictProblem` if items were purged since the
    drafts were made.
    """
    project_row = projects.require(tx, project)
    require_no_purge_since(tx, project_row.id, local.last_purge)
    tx.lock(f"received revisions {project_row.id}")  # another sender of the same revisions waits, and then finds them
    folder = find_dataset(tx, project_row, name).path or ""
    placed = {
        content: replace(draft, collection=folder) if draft.hidden else draft for content, draft in drafts.items()
    }
    rights = rights_of_caller(tx, project_row)
    added = publish_contents(tx, project_row, placed, author_id=tx.principal.user_id, rights=rights)
    fill_facets(tx, project_row.id, local.facets)
    daily.count_sent(tx, tx.new_document_bytes)
    return StoredRevisions(added=added)


@dataclass(frozen=True)
class PreparedReceipt:
    """Commit from an archive or another server, with the chunks of its tree; the digest of the tree was checked."""

    dataset_id: str
    record: CommitRecord
    entries: int
    chunks: Mapping[str, bytes]
    last_purge: int
    """Time in microseconds of the last purge of the project before the receipt was prepared, 0 if there was none."""


def prepare_receipt(tx: Transaction, project: str, name: str, request: ReceivedCommit) -> PreparedReceipt:
    """Compute the tree of a commit from an archive or another server.

    Raises `ConflictProblem` if a parent is missing from the dataset or a revision is missing from the project.
    Raises `InvalidProblem` if the changes do not give the tree that the commit names.
    """
    project_row = projects.require(tx, project)
    found = find_dataset(tx, project_row, name)
    record = CommitRecord(request.tree, request.parents, request.author, request.message, request.at)
    last = last_purge(tx, project_row.id)
    if _is_known(tx, found, record.digest):
        return PreparedReceipt(found.id, record, 0, {}, last)
    _require_parents(tx, found, record)
    changes = {key_of(one.path, one.kind): _value(one.parts, one.tags) for one in request.changes}
    contents = {revision_content(one.kind, one.parts) for one in request.changes if one.parts is not None}
    require_contents(contents - revisions_with(tx, project_row.id, contents).keys())
    store = StoredChunks(tx)
    before = tree_of(tx, found.id, record.parents[0]) if record.parents else build(store, ())
    tree = change(store, before, changes)
    if tree != record.tree:
        raise InvalidProblem(
            f"The changes give a version with the tree {tree}, but the commit names {record.tree}. Send all changes "
            "between the commit and its first parent.",
            code="other-tree",
        )
    return PreparedReceipt(found.id, record, len(Tree(store, tree)), store.new, last)


def _value(parts: Mapping[str, str] | None, tags: Iterable[str]) -> Value | None:
    return None if parts is None else {"parts": dict(parts), "tags": sorted(tags)}


def record_receipt(
    tx: Transaction, project: str, name: str, request: ReceivedCommit, prepared: PreparedReceipt
) -> Commit:
    """Record a commit from an archive or another server; recording it again has no effect.

    If the request names a branch without commits, the branch is set to this commit. Raises the errors of
    `require_move`. Raises `ConflictProblem` if the branch has other commits, or if items were purged or the dataset was
    replaced since the receipt was prepared.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = find_dataset(tx, project_row, name)
    if found.id != prepared.dataset_id:
        raise dataset_replaced(name)
    digest = prepared.record.digest
    tx.lock(f"commit {found.id} {digest}")  # so that another sender of the same commit waits, and finds it
    if not _is_known(tx, found, digest):
        _require_parents(tx, found, prepared.record)
        require_no_purge_since(tx, project_row.id, prepared.last_purge)
        if request.begins is not None:
            find_ref(tx, found.id, request.begins, lock=True)  # in the order of other commits: branch, chunks
        store_chunks(tx, prepared.chunks)
        insert_commit(tx, found.id, prepared.record, entries=prepared.entries)
        tx.emit("commit.received", found.id, project_id=project_row.id, commit=digest)
    if request.begins is not None:
        _begin(tx, project_row, found, request.begins, digest)
    return read_commit(tx, project, name, digest)


def _begin(tx: Transaction, project_row: ProjectRow, found: Row[Any], branch: str, digest: str) -> None:
    head = head_of(tx, found.id, branch, None)
    if head == digest:
        return
    mover = Mover(author_of(tx), project_row.role)
    move_branch_to(tx, PreparedCommit(found.id, branch, None, (), "", None), digest, mover)
    tx.emit("branch.moved", found.id, project_id=project_row.id, branch=branch, commit=digest)


def _is_known(tx: Transaction, found: Row[Any], digest: str) -> bool:
    return bool(_known(tx, found, [digest]))


def _require_parents(tx: Transaction, found: Row[Any], record: CommitRecord) -> None:
    if missing := sorted(set(record.parents) - _known(tx, found, record.parents)):
        raise ConflictProblem(
            f"The dataset does not have the parent {missing[0]} of the commit; send it first.",
            code="missing-parents",
            context={"commits": missing},
        )


def _known(tx: Transaction, found: Row[Any], digests: Sequence[str]) -> set[str]:
    """Return those of `digests` that are commits of a dataset."""
    of_dataset = (dataset_commit.c.dataset_id == found.id, dataset_commit.c.digest.in_(digests))
    return set(tx.execute(select(dataset_commit.c.digest).where(*of_dataset)).scalars())
