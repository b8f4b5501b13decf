"""Readiness of the store: whether requests can be served."""

from __future__ import annotations

from marey_server.store.database.schema import schema_fits
from marey_server.store.transaction import Transaction


def find_faults(tx: Transaction) -> list[str]:
    """Return descriptions, for the operator, of faults that prevent the server from serving requests."""
    faults = []
    if not schema_fits(tx.connection):
        faults.append("the tables of the database are not those of this version of the server; run `marey db upgrade`")
    try:
        tx.blobs.check_writable()
    except OSError as error:
        faults.append(f"blobs cannot be written: {error.strerror}")
    return faults
