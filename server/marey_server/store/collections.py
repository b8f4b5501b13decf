"""Collections: the folders of a project."""

from __future__ import annotations

from sqlalchemy import select

from marey_server.store.database import Transaction
from marey_server.store.ids import new_id
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection


def ensure(tx: Transaction, project_row: ProjectRow, path: str) -> str:
    """Id of the collection at `path`, made with those above it where there is none; it cannot be deleted meanwhile."""
    found = _lock(tx, project_row.id, path)
    while found is None:
        if path:
            ensure(tx, project_row, path.rpartition("/")[0])
        row = {
            "id": new_id("coll"), "project_id": project_row.id, "path": path,
            "created_us": tx.now_us, "updated_us": tx.now_us,
        }  # fmt: skip
        made = tx.execute(tx.insert_or_ignore(collection, row).returning(collection.c.id)).scalar()
        if made is not None:
            tx.emit("collection.created", made, project_id=project_row.id, path=path)
        found = made or _lock(tx, project_row.id, path)
    return found


def _lock(tx: Transaction, project_id: str, path: str) -> str | None:
    statement = select(collection.c.id).where(
        collection.c.project_id == project_id, collection.c.path == path, collection.c.deleted_us.is_(None)
    )
    found: str | None = tx.execute(statement.with_for_update(read=True)).scalar()
    return found
