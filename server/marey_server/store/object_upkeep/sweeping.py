"""Deletion of objects that no row names: of blobs that were deleted, and of writes that did not commit.

No object is deleted that a row names, now or later:

* An object gets its name before its transfer begins, and no name is used twice. So a delayed request to delete an
  object cannot delete another copy of the same bytes.
* A transaction may name an object only within twelve hours after its transfer began (`COMMIT_WITHIN_US`).
* An object is deleted a day after its transfer began, at the earliest. First a transaction reads the row of the blob
  while no other transaction can write this row. If the row does not name the object, no later transaction will.

Times are those of the database's clock, so differences between the clocks of machines have no influence.
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import delete, select

from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.store.database.connections import Database
from marey_server.store.object_storage.backing import COMMIT_WITHIN_US, ObjectBlobs
from marey_server.store.object_storage.client import StoredObject
from marey_server.store.tables import blob
from marey_server.store.transaction import Transaction, in_lists

LOCKED_AT_ONCE = 100
"""Number of rows of blobs that one transaction locks."""


def sweep_objects(database: Database, grace_us: int) -> int:
    """Delete the objects that no row names and whose transfer began over `grace_us` ago; return their number.

    The grace period is at least `COMMIT_WITHIN_US`.
    """
    if not isinstance(database.blobs, ObjectBlobs):
        return 0
    storage = database.blobs.storage
    deleted = 0
    for page in storage.pages():
        old = database.read(SYSTEM, _unnamed, page, grace_us)
        for start in range(0, len(old), LOCKED_AT_ONCE):
            going = database.write(SYSTEM, _never_named, old[start : start + LOCKED_AT_ONCE], grace_us)
            faults.point("objects.before_delete")
            if going:
                storage.delete([one.name for one in going])
            deleted += len(going)
    return deleted


def _unnamed(tx: Transaction, objects: Sequence[StoredObject], grace_us: int) -> list[StoredObject]:
    """Return the objects whose transfer began over `grace_us` ago, and that the rows of their blobs do not name."""
    before_us = tx.now_us - max(grace_us, COMMIT_WITHIN_US)
    old = [one for one in objects if one.began_us < before_us]
    named: set[tuple[str, str]] = set()
    for some in in_lists(sorted({one.digest for one in old})):
        rows = tx.execute(select(blob.c.digest, blob.c.object_id).where(blob.c.digest.in_(some)))
        named.update((row.digest, row.object_id) for row in rows)
    return [one for one in old if (one.digest, one.id) not in named]


def _never_named(tx: Transaction, objects: Sequence[StoredObject], grace_us: int) -> list[StoredObject]:
    """Return those of the objects that no row names and that no row will ever name.

    The keys of the rows are locked, so that the rows that running transactions insert or change are taken into account.
    """
    digests = sorted({one.digest for one in objects})
    rows = [{"digest": digest, "size_bytes": 0, "created_us": tx.now_us} for digest in digests]
    inserted = list(tx.execute(tx.insert_or_ignore(blob).returning(blob.c.digest), rows).scalars())
    tx.execute(select(blob.c.digest).where(blob.c.digest.in_(digests)).order_by(blob.c.digest).with_for_update()).all()
    going = _unnamed(tx, objects, grace_us)
    tx.execute(delete(blob).where(blob.c.digest.in_(inserted)))
    return going
