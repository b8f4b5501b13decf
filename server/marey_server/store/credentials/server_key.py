"""Secret key that all servers of a database share; with it, a server recognizes cursors and tokens that it issued."""

from __future__ import annotations

import hmac
import secrets

from sqlalchemy import select

from marey_server.store.database.prepared import Prepared
from marey_server.store.tables import server_state
from marey_server.store.transaction import Transaction

_KEY_NAME = "cursor_key"  # because it signed only cursors in earlier versions
_SERVER_KEY = Prepared(select(server_state.c.value).where(server_state.c.key == _KEY_NAME))


def read_server_key(tx: Transaction) -> bytes:
    """Return the secret key of all servers that share the database."""
    (row,) = tx.run(_SERVER_KEY, {})
    return bytes.fromhex(row.value)


def read_seal_key(tx: Transaction) -> bytes:
    """Return the key with which servers sign the tokens of attempts, and recognize the tokens that they signed."""
    return hmac.digest(read_server_key(tx), b"tokens of attempts", "sha256")


def make_server_key(tx: Transaction) -> None:
    """Create the secret key of the servers, unless the database already contains it."""
    row = {"key": _KEY_NAME, "value": secrets.token_hex(32)}
    tx.execute(tx.insert_or_ignore(server_state, row))
