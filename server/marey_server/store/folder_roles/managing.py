"""Roles of members in folders of a project, which owners set. The module `rights` uses them to check callers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, and_, delete, func, select

from marey_schemas.access import EVERY_MEMBER, FolderRole, FolderRoleChange, Role
from marey_schemas.items import Page
from marey_server.errors import ConflictProblem, InvalidProblem, NotFoundProblem, PreconditionFailedProblem
from marey_server.store import collections, listing, projects
from marey_server.store.collections import at_or_below
from marey_server.store.database.clock import datetime_of
from marey_server.store.folder_roles.rights import lock_places
from marey_server.store.members import lock_project
from marey_server.store.projects import ProjectRow
from marey_server.store.revs import ExpectedRev, at_rev, change_row, moved_on
from marey_server.store.tables import collection, folder_role, member, user
from marey_server.store.transaction import Transaction

MOST_FOLDER_ROLES = 1000
"""Greatest number of roles in the existing folders of a project; a restored folder may add roles beyond this number."""
MOST_WITH_DELETED = 10_000
"""Greatest number of roles in all folders of one project, so that a request can read all roles of its caller."""


# -- reading ----------------------------------------------------------------------------------------------------------


def list_folder_roles(
    tx: Transaction,
    project: str,
    *,
    folder: str = "",
    user_name: str | None = None,
    cursor: str | None = None,
    limit: int = listing.DEFAULT_LIMIT,
) -> Page:
    """List the roles in folders at and below `folder`, in the order of the paths of the folders.

    With `user_name`, only the roles of this user are listed. Guests of a public project may not see any. Roles in
    deleted folders are left out.
    """
    project_row = projects.require(tx, project)
    statement = _rows(project_row).where(at_or_below(folder))
    if user_name is not None:
        statement = statement.where(_is_user(user_name))
    order = listing.parse_order(
        "folder,user", {"folder": collection.c.path, "user": folder_role.c.user_id}, unique="user"
    )
    identity = ["folder-roles", project_row.id, folder, user_name]
    rows, next_cursor = listing.read_page(tx, statement, order, identity, cursor, limit)
    return Page(items=tuple(map(_shown, rows)), next_cursor=next_cursor)


def read_folder_role(tx: Transaction, project: str, collection_id: str, user_name: str) -> FolderRole:
    """Return the role of a member, or of all members, in a folder. Raises `NotFoundProblem` if there is none."""
    project_row = projects.require(tx, project)
    row = tx.execute(_rows(project_row).where(collection.c.id == collection_id, _is_user(user_name))).first()
    if row is None:
        raise _no_role(user_name)
    return _shown(row)


def _rows(project_row: ProjectRow) -> Select[*tuple[Any, ...]]:
    return (
        select(folder_role, collection.c.path, user.c.name)
        .join(collection, collection.c.id == folder_role.c.collection_id)
        .outerjoin(user, user.c.id == folder_role.c.user_id)
        .where(folder_role.c.project_id == project_row.id, collection.c.deleted_us.is_(None))
    )


def _is_user(user_name: str) -> ColumnElement[bool]:
    return folder_role.c.user_id == EVERY_MEMBER if user_name == EVERY_MEMBER else user.c.name == user_name


def _shown(row: Row[Any]) -> FolderRole:
    return FolderRole(
        user=row.name or EVERY_MEMBER, folder=row.path, collection=row.collection_id, role=Role(row.role),
        since=datetime_of(row.since_us), rev=row.rev,
    )  # fmt: skip


def _no_role(user_name: str) -> NotFoundProblem:
    who = "All members together have" if user_name == EVERY_MEMBER else f"{user_name!r} has"
    return NotFoundProblem(f"{who} no role of their own in this folder.", code="no-folder-role")


# -- changing ---------------------------------------------------------------------------------------------------------


def put_folder_role(
    tx: Transaction,
    project: str,
    collection_id: str,
    user_name: str,
    request: FolderRoleChange,
    *,
    expected_rev: ExpectedRev = None,
    absent: bool = False,
) -> FolderRole:
    """Set the role of a member, or of all members, in a folder.

    With `absent`, only a new role is set. Raises `PreconditionFailedProblem` if `absent` is true and the role exists
    already, or if the role is not at `expected_rev`. Raises `NotFoundProblem` if the user is no member of the project,
    `ConflictProblem` if the user is an owner or the project has too many roles in folders, and `InvalidProblem` for the
    root folder.
    """
    project_row, path = _lock(tx, project, collection_id)
    key = _key(project_row, collection_id, _find_member(tx, project_row, user_name))
    which = _has(key)
    was = tx.execute(select(folder_role.c.role).where(*which)).scalar()
    if was is None:
        _require_room(tx, project_row)
    added = None
    if expected_rev is None:
        row = {**key, "role": request.role.value, "since_us": tx.now_us}
        added = tx.execute(tx.insert_or_ignore(folder_role, row).returning(folder_role.c.rev)).first()
        if added is None and absent:
            raise PreconditionFailedProblem(
                f"{user_name!r} already has a role of their own in this folder.", code="folder-role-exists"
            )
    if added is None:
        values = {"role": request.role.value}
        change_row(
            tx, folder_role, which, values, expected_rev=expected_rev, absent=_no_role(user_name)
        )  # fmt: skip
    details = {"path": path, "user": user_name, "role": request.role.value}
    if was is None:
        tx.audit("folder_role.added", collection_id, about=user_name, project_id=project_row.id, **details)
    else:
        tx.audit("folder_role.changed", collection_id, about=user_name, project_id=project_row.id, was=was, **details)
    return read_folder_role(tx, project, collection_id, user_name)


def remove_folder_role(
    tx: Transaction, project: str, collection_id: str, user_name: str, *, expected_rev: ExpectedRev
) -> None:
    """Remove the role of a member, or of all members, in a folder; the roles in the folders above it then apply."""
    project_row, path = _lock(tx, project, collection_id)
    user_id = tx.execute(select(user.c.id).where(user.c.name == user_name)).scalar()
    which = _has(_key(project_row, collection_id, EVERY_MEMBER if user_name == EVERY_MEMBER else user_id or ""))
    removing = delete(folder_role).where(*which, at_rev(folder_role.c.rev, expected_rev))
    was = tx.execute(removing.returning(folder_role.c.role)).scalar()
    if was is None:
        current = tx.execute(select(folder_role.c.rev).where(*which)).scalar()
        raise _no_role(user_name) if current is None else moved_on(current)
    details = {"path": path, "user": user_name, "was": was}
    tx.audit("folder_role.removed", collection_id, about=user_name, project_id=project_row.id, **details)


def _lock(tx: Transaction, project: str, collection_id: str) -> tuple[ProjectRow, str]:
    """Lock the roles in folders of a project, then the folder; return the project and the path of the folder.

    Raises `InvalidProblem` for the root folder, which has no roles of its own.
    """
    project_row = lock_project(tx, project)
    lock_places(tx, project_row)
    path = collections.lock_collection(tx, project_row, collection_id).path
    if not path:
        raise InvalidProblem(
            "The role in the top folder is the role in the project; change the member's role in the project instead.",
            code="is-root",
        )
    return project_row, path


def _key(project_row: ProjectRow, collection_id: str, user_id: str) -> dict[str, str]:
    """Return the primary key of a row of `folder_role`."""
    return {"project_id": project_row.id, "user_id": user_id, "collection_id": collection_id}


def _has(key: Mapping[str, str]) -> tuple[ColumnElement[bool], ...]:
    return tuple(folder_role.c[name] == value for name, value in key.items())


def _find_member(tx: Transaction, project_row: ProjectRow, user_name: str) -> str:
    """Return the id of the member `user_name`; `EVERY_MEMBER` is returned unchanged.

    Raises `NotFoundProblem` if the user is no member, and `ConflictProblem` if the user is an owner.
    """
    if user_name == EVERY_MEMBER:
        return EVERY_MEMBER
    mine = and_(member.c.user_id == user.c.id, member.c.project_id == project_row.id)
    found = tx.execute(select(user.c.id, member.c.role).join(member, mine).where(user.c.name == user_name)).first()
    if found is None:
        raise NotFoundProblem(f"{user_name!r} is no member of this project; add the member first.", code="no-member")
    if found.role == Role.OWNER.value:
        raise ConflictProblem(
            f"{user_name!r} is an owner, and owners have all rights in all folders; give {user_name!r} another role in "
            "the project first.",
            code="is-owner",
        )
    return str(found.id)


def _require_room(tx: Transaction, project_row: ProjectRow) -> None:
    existing = func.count().filter(collection.c.deleted_us.is_(None)).label("existing")
    counts = select(existing, func.count().label("all")).join(
        folder_role, folder_role.c.collection_id == collection.c.id
    )
    held: Row[Any] = tx.execute(counts.where(folder_role.c.project_id == project_row.id)).one()
    if held.existing >= MOST_FOLDER_ROLES:
        raise ConflictProblem(
            f"A project can have at most {MOST_FOLDER_ROLES:,} roles in folders; remove one first.",
            code="too-many-folder-roles",
        )
    if held.all >= MOST_WITH_DELETED:
        raise ConflictProblem(
            f"A project can have at most {MOST_WITH_DELETED:,} roles in folders, and those in deleted folders count; "
            "restore a deleted folder and remove its roles first.",
            code="too-many-folder-roles",
        )
