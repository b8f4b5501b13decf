"""Rights in the folders of a project: of the caller, and of the author of a job.

Every function that changes something in a folder checks these rights. They are read once per transaction, or once per
savepoint. The transaction then holds a lock until its end, or until the rollback to this savepoint. While the lock is
held, nobody changes the roles in folders, and nobody moves, deletes or restores a folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Row, and_, bindparam, or_, select

from marey_schemas.access import EVERY_MEMBER, Role
from marey_server.access.folder_rights import FolderRights, FolderState
from marey_server.store.database.prepared import Prepared
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection, folder_role, member, user
from marey_server.store.transaction import Transaction

_CONCERNED = and_(
    folder_role.c.project_id == bindparam("project_id"),
    or_(folder_role.c.user_id == bindparam("user_id"), folder_role.c.user_id == bindparam("every_member")),
)
_OVERRIDES = Prepared(
    select(
        member.c.role.label("project_role"),
        collection.c.path, collection.c.deleted_us, folder_role.c.user_id, folder_role.c.role,
    )
    .select_from(
        member.outerjoin(folder_role, _CONCERNED).outerjoin(collection, collection.c.id == folder_role.c.collection_id)
    )
    .where(member.c.project_id == bindparam("project_id"), member.c.user_id == bindparam("user_id"))
)  # fmt: skip
"""Query of the roles in folders that concern a member; each row also contains the member's role in the project."""
_AUTHOR = Prepared(
    select(user.c.administrator, user.c.disabled, member.c.role)
    .select_from(
        user.outerjoin(member, and_(member.c.user_id == user.c.id, member.c.project_id == bindparam("project_id")))
    )
    .where(user.c.id == bindparam("user_id"))
)


def lock_name(project_id: str) -> str:
    """Return the name of the lock on a project's roles in folders.

    Transactions that read the roles hold the lock shared; transactions that change them hold it exclusively.
    """
    return f"folder-roles:{project_id}"


def lock_places(tx: Transaction, project: ProjectRow) -> None:
    """Lock the roles in folders, and the paths of the folders with roles, until the transaction ends.

    Requests call this function if they move, delete or restore a folder, or change a role in a folder or in the
    project. They call it before they lock an item, a folder or a job. The function waits until all writes that have
    read the roles have ended. Later writes that read the roles wait until this transaction has ended. So a write never
    compares the path of a folder with roles at outdated paths.
    """
    tx.lock(lock_name(project.id))
    forget_rights(tx)


def rights_of_caller(tx: Transaction, project: ProjectRow) -> FolderRights:
    """Return the caller's rights in the folders of a project, which stay the same until the transaction ends.

    Call this function before the write reads the path of an item or a folder, because the path may change before the
    call. Call it also before the write locks rows, because changes of roles lock rows after they lock the roles.
    """
    return _kept(tx, project, tx.principal.user_id, project.role)


def rights_shown(tx: Transaction, project: ProjectRow) -> FolderRights:
    """Return the caller's rights in the folders of a project, read without a lock, only to show them in an answer."""
    if not _has_overrides(tx.principal.user_id, project.role) or project.guest:
        return FolderRights(project.name, project.role)
    return tx.folder_rights.get((project.id, tx.principal.user_id)) or _read(tx, project, tx.principal.user_id)


def rights_of_author(tx: Transaction, project: ProjectRow, author_id: str | None) -> FolderRights:
    """Return the present rights of the author of a job; a job of the server itself has no author and may write."""
    if author_id is None:
        return FolderRights(project.name, Role.OWNER)
    known = tx.folder_rights.get((project.id, author_id))
    if known is not None:
        return known
    found = tx.first(_AUTHOR, {"project_id": project.id, "user_id": author_id})
    if found is None or found.disabled:
        return FolderRights(project.name, Role.READER)
    if found.administrator:
        return FolderRights(project.name, Role.OWNER)
    if found.role is None:
        return FolderRights(project.name, Role.READER)
    return _kept(tx, project, author_id, Role(found.role))


def forget_rights(tx: Transaction) -> None:
    """Discard the rights that were read, because this transaction has changed folders or roles.

    They are read again when they are needed next.
    """
    tx.folder_rights.clear()


def _has_overrides(user_id: str | None, role: Role) -> bool:
    """Return whether roles in folders may apply to a user; they never apply to an owner or to an attempt of a job."""
    return user_id is not None and role is not Role.OWNER


def _kept(tx: Transaction, project: ProjectRow, user_id: str | None, role: Role) -> FolderRights:
    if not _has_overrides(user_id, role):
        return FolderRights(project.name, role)
    key = (project.id, user_id)
    known = tx.folder_rights.get(key)
    if known is not None:
        return known
    tx.lock(lock_name(project.id), shared=True)  # in a statement of its own, because the next one reads after it
    found = _read(tx, project, user_id)
    if not tx.connection.in_nested_transaction():  # whose rollback would release the lock
        tx.folder_rights[key] = found
    return found


def _read(tx: Transaction, project: ProjectRow, user_id: str | None) -> FolderRights:
    """Read a member's rights in folders, together with the role in the project, while the lock on roles is held.

    The role in the project is read again, because it may have changed before the lock was acquired.
    """
    rows = tx.run(_OVERRIDES, {"project_id": project.id, "user_id": user_id, "every_member": EVERY_MEMBER})
    role = Role(rows[0].project_role) if rows else Role.READER  # of a user who is no member any more
    if role is Role.OWNER:
        return FolderRights(project.name, role)
    return FolderRights(project.name, role, _by_state([row for row in rows if row.role is not None]))


def _by_state(rows: Sequence[Row[Any]]) -> Mapping[FolderState, Mapping[str, Role]]:
    found: dict[FolderState, dict[str, Role]] = {}
    for row in sorted(rows, key=lambda row: row.user_id != EVERY_MEMBER):  # a role of one's own replaces it
        found.setdefault(row.deleted_us, {})[row.path] = Role(row.role)
    return found
