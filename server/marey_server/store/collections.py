"""Collections: the folders of a project. The root is the collection with the empty path, created on first use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, Row, func, literal, or_, select, update

from marey_schemas.access import Role
from marey_schemas.items import Collection, CollectionChange, CollectionCreate, Page
from marey_server.access.folder_rights import FolderRights
from marey_server.errors import BadRequestProblem, ConflictProblem, InvalidProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.violations import taken
from marey_server.store.folder_roles.rights import (
    forget_rights,
    lock_places,
    rights_of_caller,
    rights_shown,
)
from marey_server.store.ids import new_id
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.quotas import holdings
from marey_server.store.revs import ExpectedRev, change_row
from marey_server.store.tables import collection, item
from marey_server.store.transaction import Transaction

MAX_PATH_LENGTH = 1024
MAX_PATH_BYTES = 2048
"""Greatest size of a path in bytes, well below the limit of an index entry in Postgres."""

_ALIVE = collection.c.deleted_us.is_(None)


def ensure(tx: Transaction, project_row: ProjectRow, path: str) -> str:
    """Return the id of the collection at `path`, and lock it against deletion.

    The collection and its parents are created if they are missing.
    """
    check_length(path)
    found = _lock(tx, project_row.id, path)
    while found is None:
        if path:
            ensure(tx, project_row, path.rpartition("/")[0])
        row = {
            "id": new_id("collection"), "project_id": project_row.id, "path": path,
            "created_us": tx.now_us, "updated_us": tx.now_us,
        }  # fmt: skip
        made = tx.execute(tx.insert_or_ignore(collection, row).returning(collection.c.id)).scalar()
        if made is not None:
            tx.emit("collection.created", made, project_id=project_row.id, path=path)
        found = made or _lock(tx, project_row.id, path)
    return found


def _lock(tx: Transaction, project_id: str, path: str) -> str | None:
    statement = select(collection.c.id).where(collection.c.project_id == project_id, collection.c.path == path, _ALIVE)
    found: str | None = tx.execute(statement.with_for_update(read=True)).scalar()
    return found


def check_length(path: str) -> None:
    """Raise `InvalidProblem` if a path is too long to be stored."""
    if len(path) > MAX_PATH_LENGTH or len(path.encode()) > MAX_PATH_BYTES:
        raise InvalidProblem(
            f"The path of a folder may have at most {MAX_PATH_LENGTH} characters and {MAX_PATH_BYTES} bytes; this path "
            f"has {len(path)} characters and {len(path.encode())} bytes.",
            code="long-path",
        )


def at_or_below(path: str) -> ColumnElement[bool]:
    """Return the SQL condition for the rows of the folder at `path` and of all folders below it."""
    if not path:
        return literal(True)
    return or_(collection.c.path == path, func.substr(collection.c.path, 1, len(path) + 1) == f"{path}/")


# -- reading ----------------------------------------------------------------------------------------------------------


def read_collection(tx: Transaction, project: str, collection_id: str) -> Collection:
    """Return a collection as a document that contains the caller's role in the collection."""
    project_row = projects.require(tx, project)
    return _shown(tx, project_row, _find(tx, project_row, collection_id, _ALIVE))


def list_collections(
    tx: Transaction,
    project: str,
    *,
    path: str = "",
    directly_in: str | None = None,
    name: str | None = None,
    deleted: bool = False,
    cursor: str | None = None,
    limit: int = listing.DEFAULT_LIMIT,
) -> Page:
    """List the collections at and below `path`, without the root, in the order of their paths.

    With `directly_in`, only the direct subfolders of this folder are listed. `name` selects among these the subfolder
    of this name or, if `name` ends with `*`, the subfolders whose names begin with the text before the `*`. With
    `deleted`, only deleted collections are listed.

    Raises `BadRequestProblem` if `name` is given without `directly_in`.
    """
    project_row = projects.require(tx, project, at_least=Role.CONTRIBUTOR if deleted else Role.READER)
    order = listing.parse_order("path", {"path": collection.c.path, "id": collection.c.id})
    statement = select(collection).where(
        collection.c.project_id == project_row.id,
        collection.c.path != "",
        at_or_below(path),
        *_children(directly_in, name),
        collection.c.deleted_us.is_not(None) if deleted else _ALIVE,
    )
    newer = () if directly_in is None else (directly_in, name)  # without them, cursors of version 0.1 are valid
    identity = ["collections", project_row.id, path, deleted, *newer]
    rows, next_cursor = listing.read_page(tx, statement, order, identity, cursor, limit)
    rights = rights_shown(tx, project_row)
    return Page(items=tuple(_document(project_row, rights, row) for row in rows), next_cursor=next_cursor)


def _children(directly_in: str | None, name: str | None) -> list[ColumnElement[bool]]:
    """Return the SQL conditions for the direct subfolders of a folder; none if `directly_in` is None.

    With `name`, only the subfolder of this name is selected, or, if `name` ends with `*`, the subfolders whose names
    begin with the text before the `*`.
    """
    if directly_in is None:
        if name is not None:
            raise BadRequestProblem(
                "The parameter `name` selects among the subfolders of one folder; add `directly_in`.", code="bad-filter"
            )
        return []
    folder = f"{directly_in}/" if directly_in else ""
    if name is not None and not name.endswith("*"):
        return [collection.c.path == f"{folder}{name}"]
    start = folder + (name or "*")[:-1]
    rest = func.substr(collection.c.path, len(folder) + 1)
    return [collection.c.path >= start, func.substr(collection.c.path, 1, len(start)) == start, ~rest.contains("/")]


def lock_collection(tx: Transaction, project_row: ProjectRow, collection_id: str) -> Row[Any]:
    """Lock and return the row of a folder that is not deleted.

    Raises `NotFoundProblem` if there is no such folder.
    """
    return _find(tx, project_row, collection_id, _ALIVE, lock=True)


def _find(
    tx: Transaction, project_row: ProjectRow, collection_id: str, state: ColumnElement[bool], *, lock: bool = False
) -> Row[Any]:
    """Return the row of the collection with an id, if it meets the condition `state`, such as `_ALIVE`.

    With `lock`, the row is locked. Raises `NotFoundProblem` if there is no such collection.
    """
    statement = select(collection).where(
        collection.c.id == collection_id, collection.c.project_id == project_row.id, state
    )
    row = tx.execute(statement.with_for_update() if lock else statement).first()
    if row is None:
        raise _no_collection(collection_id)
    return row


def _no_collection(collection_id: str) -> NotFoundProblem:
    return NotFoundProblem(f"The project has no collection {collection_id!r}.", code="no-collection")


def _shown(tx: Transaction, project_row: ProjectRow, row: Row[Any]) -> Collection:
    return _document(project_row, rights_shown(tx, project_row), row)


def _document(project_row: ProjectRow, rights: FolderRights, row: Row[Any]) -> Collection:
    role = None if project_row.guest else rights.role_in(row.path, row.deleted_us)
    return Collection(
        id=row.id, path=row.path, role=role,
        created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us),
        deleted_at=None if row.deleted_us is None else datetime_of(row.deleted_us), rev=row.rev,
    )  # fmt: skip


# -- changing ---------------------------------------------------------------------------------------------------------


def create_collection(tx: Transaction, project: str, request: CollectionCreate) -> Collection:
    """Create a folder, and missing folders above it. Raises `ConflictProblem` if the folder exists already."""
    project_row = projects.require(tx, project)
    rights_of_caller(tx, project_row).require(request.path.rpartition("/")[0], Role.CONTRIBUTOR)
    if _lock(tx, project_row.id, request.path) is not None:
        raise _path_taken(request.path)
    return _shown(tx, project_row, _find(tx, project_row, ensure(tx, project_row, request.path), _ALIVE))


def _path_taken(path: str) -> ConflictProblem:
    return ConflictProblem(
        f"There is already a collection {path!r}; choose another path.",
        code="path-taken",
        unnamed="There is already a collection with this path; choose another path.",
    )


def move_collection(
    tx: Transaction, project: str, collection_id: str, request: CollectionChange, *, expected_rev: ExpectedRev
) -> Collection:
    """Rename or move a folder with its contents and the roles in it.

    Raises `ConflictProblem` if the new path is taken, and `InvalidProblem` for the root collection and for a path
    inside the folder itself.
    """
    project_row = projects.require(tx, project)
    lock_places(tx, project_row)
    old, new = _find(tx, project_row, collection_id, _ALIVE, lock=True).path, request.path
    _require_no_root(old)
    inside = _lock_inside(tx, project_row, old)
    rights = rights_of_caller(tx, project_row)
    rights.require_entry(old, Role.CONTRIBUTOR)
    rights.require(new.rpartition("/")[0], Role.CONTRIBUTOR)
    if new.startswith(f"{old}/"):
        raise InvalidProblem(
            f"The collection {old!r} cannot be moved into itself; choose a path outside of it.",
            code="into-itself",
            unnamed="The collection cannot be moved into itself; choose a path outside of it.",
        )
    if new != old:
        ensure(tx, project_row, new.rpartition("/")[0])
    with taken(_path_taken(new)):
        row = change_row(
            tx, collection, (collection.c.id == collection_id, collection.c.path == old, _ALIVE),
            {"path": new, "updated_us": tx.now_us}, expected_rev=expected_rev, absent=_no_collection(collection_id),
        )  # fmt: skip
        _move_contents(tx, project_row, inside, old, new)
    forget_rights(tx)
    tx.emit("collection.moved", collection_id, project_id=project_row.id, path=new, was=old)
    return _shown(tx, project_row, row)


def _move_contents(tx: Transaction, project_row: ProjectRow, inside: Sequence[str], old: str, new: str) -> None:
    for path in inside:
        check_length(new + path[len(old) :])
    tx.execute(
        update(collection)
        .where(*_inside(project_row, old))
        .values(path=literal(new) + func.substr(collection.c.path, len(old) + 1), rev=collection.c.rev + 1)
    )


def _inside(project_row: ProjectRow, path: str) -> tuple[ColumnElement[bool], ...]:
    return collection.c.project_id == project_row.id, _ALIVE, at_or_below(path), collection.c.path != path


def _lock_inside(tx: Transaction, project_row: ProjectRow, path: str) -> Sequence[str]:
    """Lock all folders below the locked folder at `path`, and return their paths.

    No folder below `path` is changed or added before this write ends, because `ensure` locks the parent while it adds a
    folder. While this function waits for the lock of a folder, subfolders may be added to this folder. So the search is
    repeated until there are no more unlocked folders.
    """
    statement = select(collection.c.path).where(*_inside(project_row, path)).order_by(collection.c.path)
    paths: Sequence[str] = []
    while len(found := tx.execute(statement.with_for_update()).scalars().all()) > len(paths):
        paths = found
    return paths


def delete_collection(tx: Transaction, project: str, collection_id: str, *, expected_rev: ExpectedRev) -> None:
    """Hide a folder and its contents; `restore_collection` restores them.

    Raises `InvalidProblem` for the root collection, which cannot be deleted.
    """
    project_row = projects.require(tx, project)
    lock_places(tx, project_row)
    path = _find(tx, project_row, collection_id, _ALIVE, lock=True).path
    _require_no_root(path)
    _lock_inside(tx, project_row, path)
    rights_of_caller(tx, project_row).require_entry(path, Role.MAINTAINER)
    change_row(
        tx, collection, (collection.c.id == collection_id, collection.c.path == path, _ALIVE),
        {"deleted_us": tx.now_us, "updated_us": tx.now_us}, expected_rev=expected_rev,
        absent=_no_collection(collection_id),
    )  # fmt: skip
    forget_rights(tx)
    below = (collection.c.project_id == project_row.id, at_or_below(path))
    tx.execute(update(collection).where(*below, _ALIVE).values(deleted_us=tx.now_us, rev=collection.c.rev + 1))
    hidden = select(collection.c.id).where(*below, collection.c.deleted_us == tx.now_us)
    gone = tx.execute(
        update(item)
        .where(item.c.collection_id.in_(hidden), item.c.deleted_us.is_(None))
        .values(deleted_us=tx.now_us, rev=item.c.rev + 1)
        .returning(item.c.creator_id, item.c.stored_bytes)
    )
    holdings.count_removed(tx, project_row.id, holdings.by_creator(gone))
    tx.audit("collection.deleted", collection_id, about=path, project_id=project_row.id, path=path)


def restore_collection(
    tx: Transaction, project: str, collection_id: str, *, expected_rev: ExpectedRev = None
) -> Collection:
    """Restore a deleted folder with the contents and the roles that were deleted along with it.

    Raises `ConflictProblem` if another folder now has the same path.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    lock_places(tx, project_row)
    gone = _find(tx, project_row, collection_id, collection.c.deleted_us.is_not(None), lock=True)
    above = gone.path.rpartition("/")[0]
    rights = rights_of_caller(tx, project_row)
    for path in (gone.path, above):
        rights.require(path, Role.MAINTAINER, gone.deleted_us)
    ensure(tx, project_row, above)
    with taken(_path_taken(gone.path)):
        row = change_row(
            tx, collection, (collection.c.id == collection_id, collection.c.deleted_us == gone.deleted_us),
            {"deleted_us": None, "updated_us": tx.now_us}, expected_rev=expected_rev,
            absent=_no_collection(collection_id),
        )  # fmt: skip
        together = (collection.c.project_id == project_row.id, at_or_below(gone.path))
        hidden = collection.c.deleted_us == gone.deleted_us
        tx.execute(update(collection).where(*together, hidden).values(deleted_us=None, rev=collection.c.rev + 1))
    forget_rights(tx)
    rights_of_caller(tx, project_row).require_entry(gone.path, Role.MAINTAINER)  # with the roles that are restored
    back = tx.execute(
        update(item)
        .where(item.c.collection_id.in_(select(collection.c.id).where(*together, _ALIVE)))
        .where(item.c.deleted_us == gone.deleted_us)
        .values(deleted_us=None, rev=item.c.rev + 1)
        .returning(item.c.creator_id, item.c.stored_bytes)
    )
    holdings.count_added(tx, project_row.id, holdings.by_creator(back))
    tx.audit("collection.restored", collection_id, about=gone.path, project_id=project_row.id, path=gone.path)
    return _shown(tx, project_row, row)


def _require_no_root(path: str) -> None:
    if not path:
        raise InvalidProblem("The root collection of a project cannot be moved or deleted.", code="is-root")
