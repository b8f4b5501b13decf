"""Changes of items: creation, new revisions of parts, renaming, moving, deletion."""

from __future__ import annotations

from typing import Any

from sqlalchemy import delete, insert

from marey_schemas.access import Role
from marey_schemas.items import Item, ItemChange, ItemCreate, ItemRevert
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.lineage import RESTORED
from marey_schemas.problems import FieldError
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.prepared_documents import PreparedDocument, prepared
from marey_server.store import collections, documents, projects
from marey_server.store.database.violations import taken
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.items.drafts import Draft
from marey_server.store.items.facets import repeat_facets
from marey_server.store.items.history import no_revision
from marey_server.store.items.publishing import publish
from marey_server.store.items.reading import find_item, no_item, shown_items
from marey_server.store.items.references import ReferenceCheck
from marey_server.store.items.revisions import (
    NewRevision,
    StoredContent,
    event_of_item,
    read_part_digests,
    write_head,
    write_revisions,
)
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.quotas import daily, holdings
from marey_server.store.quotas.holdings import ItemTotals
from marey_server.store.revs import ExpectedRev, change_row, is_expected, moved_on
from marey_server.store.tables import item, item_tag, lineage
from marey_server.store.transaction import Transaction
from marey_versions.records import RevisionKey


def prepare_parts(kind: Kind, parts: dict[str, Any]) -> dict[str, PreparedDocument]:
    """Check and encode the documents of an item's parts, as `create_item` and `put_part` require.

    Checking and encoding is the slow part of a write and needs no database. Raises `InvalidProblem`; its JSON Pointers
    start with the name of the part.
    """
    return {part: prepare_part(kind, part, tree) for part, tree in parts.items()}


def prepare_part(kind: Kind, part: str, tree: Any) -> PreparedDocument:
    """Check and encode the document of one part of an item.

    Raises `InvalidProblem`, whose JSON Pointers begin with the name of the part, if the kind has no such part or the
    document is not valid.
    """
    spec = PARTS[kind].get(part)
    if spec is None:
        detail = f"A {kind} has no part {part!r}; it has {', '.join(PARTS[kind])}."
        raise InvalidProblem(
            detail, code="no-part", errors=[FieldError(pointer=f"/{part}", code="no-part", detail=detail)]
        )
    try:
        return prepared(tree, schema=spec.schema)
    except InvalidProblem as error:
        moved = [found.model_copy(update={"pointer": f"/{part}{found.pointer}"}) for found in error.errors]
        detail = error.detail
        if moved:  # the text names the place of the first fault
            first = error.errors[0]
            detail = detail.replace(f"{first.pointer}: {first.detail}", f"{moved[0].pointer}: {first.detail}", 1)
        raise InvalidProblem(detail, code=error.error_code, errors=moved, context=error.context) from error


def create_item(tx: Transaction, project: str, kind: Kind, request: ItemCreate) -> Item:
    """Create an item, and count the bytes of its documents that were not stored before.

    Raises `ConflictProblem` if the name is taken in its collection, and `QuotaExceededProblem` if the project or the
    caller would have too many items or bytes.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    draft = Draft(
        name_in_batch="", kind=kind, item_name=request.name, parts=request.parts, collection=request.collection,
        tags=request.tags, reuse="new", message=request.message,
    )  # fmt: skip
    rights = rights_of_caller(tx, project_row)
    made = publish(tx, project_row, [draft], author_id=tx.principal.user_id, rights=rights)[0]
    daily.count_sent(tx, tx.new_document_bytes)
    return _shown(tx, project_row, kind, made.item)


def put_part(
    tx: Transaction,
    project: str,
    kind: Kind,
    item_id: str,
    part: str,
    content: Any,
    *,
    expected_rev: ExpectedRev,
    message: str = "",
) -> Item:
    """Create a revision in which one part is replaced; if the content is unchanged, no revision is created.

    Raises `PreconditionFailedProblem` if the item is no longer at `expected_rev`.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = _find_to_change(tx, project_row, kind, item_id)
    prepared = prepare_part(kind, part, content)
    digest = documents.store_document(tx, prepared)
    ReferenceCheck(tx, project_row).require(kind, {part: prepared.body})
    while is_expected(found.rev, expected_rev):
        parts = read_part_digests(tx, [(item_id, found.head)])[item_id, found.head]
        if parts.get(part) == digest:
            return _shown(tx, project_row, kind, item_id)
        parts[part] = digest
        added = documents.stored_bytes_of(tx, [digest])[digest]
        bodies, unchanged = {part: prepared.body}, item.c.rev == found.rev
        if write_head(tx, kind, item_id, parts, bodies, unchanged, added_bytes=added):
            made = NewRevision(item_id, found.head + 1, parts, message)
            write_revisions(tx, [made], author_id=tx.principal.user_id, job_id=None)
            holdings.count_added(tx, project_row.id, {found.creator_id: ItemTotals(stored_bytes=added)})
            daily.count_sent(tx, tx.new_document_bytes)
            shown = _shown(tx, project_row, kind, item_id)
            tx.emit("item.revised", **event_of_item(project_row, shown), revision=shown.revision, job=None)
            return shown
        found = _find_to_change(tx, project_row, kind, item_id)
    raise moved_on(found.rev)


def restore_content(
    tx: Transaction, project_row: ProjectRow, kind: Kind, item_id: str, source: StoredContent, message: str
) -> None:
    """Create a revision with the documents of `source`, unless the newest revision has the same documents.

    The lineage of the new revision names `source`. The caller's access to `source` is not checked. Raises
    `PreconditionFailedProblem` if another request changes the item.
    """
    found, parts = _find_to_change(tx, project_row, kind, item_id), source.parts
    before = read_part_digests(tx, [(item_id, found.head)])[item_id, found.head]
    if before == parts:
        return
    sizes = documents.stored_bytes_of(tx, parts.values())
    added = sum(sizes[digest] for part, digest in parts.items() if before.get(part) != digest)
    if not write_head(tx, kind, item_id, parts, {}, item.c.rev == found.rev, added_bytes=added):
        raise moved_on(found.rev)
    made = NewRevision(item_id, found.head + 1, parts, message)
    write_revisions(tx, [made], author_id=tx.principal.user_id, job_id=None)
    tx.execute(
        insert(lineage).values(
            item_id=item_id, number=made.number, role=RESTORED, position=0, input_item_id=source.key.item,
            input_number=source.key.revision,
        )
    )  # fmt: skip
    holdings.count_added(tx, project_row.id, {found.creator_id: ItemTotals(stored_bytes=added)})
    shown = _shown(tx, project_row, kind, item_id)
    tx.emit("item.revised", **event_of_item(project_row, shown), revision=shown.revision, job=None)


def revert_item(
    tx: Transaction, project: str, kind: Kind, item_id: str, request: ItemRevert, *, expected_rev: ExpectedRev
) -> Item:
    """Create a revision with the content of an earlier revision; if this is the present content, create none.

    Raises `NotFoundProblem` if there is no such revision, and `PreconditionFailedProblem` if the item is no longer at
    `expected_rev`.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    found = _find_to_change(tx, project_row, kind, item_id)
    if not is_expected(found.rev, expected_rev):
        raise moved_on(found.rev)
    parts = read_part_digests(tx, [(item_id, request.revision)])[item_id, request.revision]
    if not parts:
        raise no_revision(item_id, request.revision)
    source = StoredContent(RevisionKey(item_id, request.revision), parts)
    message = request.message or f"Revert to revision {request.revision}"
    restore_content(tx, project_row, kind, item_id, source, message)
    repeat_facets(tx, item_id, request.revision, _find_to_change(tx, project_row, kind, item_id).head)
    return _shown(tx, project_row, kind, item_id)


def change_item(
    tx: Transaction, project: str, kind: Kind, item_id: str, request: ItemChange, *, expected_rev: ExpectedRev
) -> Item:
    """Rename or move an item, or replace its tags.

    Raises `ConflictProblem` if another item of the kind has the name in the collection, `ForbiddenProblem` if the
    caller may not write to the old or the new folder, and `PreconditionFailedProblem` if the item has changed.
    """
    project_row = projects.require(tx, project)
    rights = rights_of_caller(tx, project_row)
    found = _find_to_change(tx, project_row, kind, item_id)
    values: dict[str, Any] = {"updated_us": tx.now_us}
    if request.name is not None:
        values |= {"name": request.name, "name_folded": request.name.casefold()}
    if request.collection is not None:
        rights.require(request.collection, Role.CONTRIBUTOR)
        values["collection_id"] = collections.ensure(tx, project_row, request.collection)
    which = (*_in_folder(project_row, kind, found), item.c.deleted_us.is_(None))
    name_taken = f"There is already a {kind} with this name in the collection; choose another name."
    with taken(ConflictProblem(name_taken, code="name-taken")):
        change_row(tx, item, which, values, expected_rev=expected_rev, absent=_moved_away(kind, item_id))
    if request.tags is not None:
        tx.execute(delete(item_tag).where(item_tag.c.item_id == item_id))
        if request.tags:
            tx.execute(insert(item_tag), [{"item_id": item_id, "tag": tag} for tag in dict.fromkeys(request.tags)])
    shown = _shown(tx, project_row, kind, item_id)
    tx.emit("item.changed", **event_of_item(project_row, shown), fields=sorted(request.model_fields_set))
    return shown


def delete_item(tx: Transaction, project: str, kind: Kind, item_id: str, *, expected_rev: ExpectedRev) -> None:
    """Hide an item, which can be restored; references to revisions of the item stay valid.

    Raises `ForbiddenProblem` unless the caller is a maintainer in the folder of the item.
    """
    project_row = projects.require(tx, project)
    found = _find_to_change(tx, project_row, kind, item_id, Role.MAINTAINER)
    which = (*_in_folder(project_row, kind, found), item.c.deleted_us.is_(None))
    gone = shown_items(tx, [found])[0]
    absent = _moved_away(kind, item_id)
    row = change_row(tx, item, which, {"deleted_us": tx.now_us}, expected_rev=expected_rev, absent=absent)
    holdings.count_removed(tx, project_row.id, {row.creator_id: ItemTotals(1, row.stored_bytes)})
    tx.audit("item.deleted", about=gone.name, **event_of_item(project_row, gone))


def restore_item(tx: Transaction, project: str, kind: Kind, item_id: str, *, expected_rev: ExpectedRev = None) -> Item:
    """Restore a deleted item, and its collection if the collection was deleted, too.

    Raises `ConflictProblem` if another item of the collection has the same name now, and `GoneProblem` if the item was
    purged.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    rights = rights_of_caller(tx, project_row)
    gone = find_item(tx, project_row, kind, item_id, deleted=True)
    rights.require_restoration(gone.path, gone.folder_deleted_us)
    collection_id = collections.ensure(tx, project_row, gone.path)
    which = (*_this(project_row, kind, item_id), item.c.deleted_us.is_not(None), item.c.purged_us.is_(None))
    values = {"deleted_us": None, "updated_us": tx.now_us, "collection_id": collection_id}
    name_taken = ConflictProblem(
        f"The collection now contains another {kind} named {gone.name!r}. Rename it, then restore this one.",
        code="name-taken",
        unnamed=f"The collection now contains another {kind} with the same name. Rename it, then restore this one.",
    )
    with taken(name_taken):
        row = change_row(tx, item, which, values, expected_rev=expected_rev, absent=no_item(kind, item_id))
    holdings.count_added(tx, project_row.id, {row.creator_id: ItemTotals(1, row.stored_bytes)})
    shown = _shown(tx, project_row, kind, item_id)
    tx.audit("item.restored", about=shown.name, **event_of_item(project_row, shown))
    return shown


def _find_to_change(
    tx: Transaction, project_row: ProjectRow, kind: Kind, item_id: str, needed: Role = Role.CONTRIBUTOR
) -> Any:
    """Return the row of an item whose folder the caller may write to.

    Raises `NotFoundProblem` if there is no such item. Raises `ForbiddenProblem` if the caller's role in the folder of
    the item is lower than `needed`.
    """
    rights = rights_of_caller(tx, project_row)
    found = find_item(tx, project_row, kind, item_id)
    rights.require(found.path, needed)
    return found


def _in_folder(project_row: ProjectRow, kind: Kind, found: Any) -> tuple[Any, ...]:
    """Return the SQL conditions that an item is still in the folder in which the caller's role was checked."""
    return *_this(project_row, kind, found.id), item.c.collection_id == found.collection_id


def _moved_away(kind: Kind, item_id: str) -> ConflictProblem:
    return ConflictProblem(
        f"Another request moved or deleted the {kind} {item_id!r} at the same time; try again.", code="contended"
    )


def _this(project_row: ProjectRow, kind: Kind, item_id: str) -> tuple[Any, ...]:
    return item.c.id == item_id, item.c.project_id == project_row.id, item.c.kind == kind.value


def _shown(tx: Transaction, project_row: ProjectRow, kind: Kind, item_id: str) -> Item:
    return shown_items(tx, [find_item(tx, project_row, kind, item_id)])[0]
