"""Whether the store can serve."""

from __future__ import annotations

from marey_server.store.database.schema import schema_at_head
from marey_server.store.transaction import Transaction


def find_faults(tx: Transaction) -> list[str]:
    """What keeps the server from serving, in words for its operator; empty where all is well."""
    faults = []
    if not schema_at_head(tx.connection):
        faults.append("the database's tables are not those of this version: run `marey db upgrade`")
    try:
        tx.blobs.check_writable()
    except OSError as error:
        faults.append(f"blobs cannot be written: {error.strerror}")
    return faults
