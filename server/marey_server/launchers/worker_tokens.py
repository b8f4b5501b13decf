"""Tokens of the workers that a server starts. With such a token, a worker can claim jobs and do nothing else."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from pathlib import Path

from marey_schemas.access import TokenCreate
from marey_schemas.names import MAX_NAME_LENGTH
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem
from marey_server.process.administrators import write_secret
from marey_server.process.settings import Settings
from marey_server.store import users
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction


def make_worker_token(database: Database, settings: Settings, port: int) -> str:
    """Create a token for the workers that end with this process, which listens at `port`.

    Tokens of earlier starts at this address are revoked; servers at other addresses with the same database keep
    their tokens.
    """
    name = f"workers beside the server at {_place(settings.host, port)}"
    return database.write(SYSTEM, _replace_token, name, {})


def keep_pool_token(
    database: Database, settings: Settings, port: int, pool: str, labels: Mapping[str, str], file: Path
) -> str:
    """Return the token for the workers of a pool of the server at `port`, which may announce only `labels`.

    The token in `file` stays in use if it is valid and has these labels, because workers that an earlier server started
    use it. Otherwise, a new token is created and written to `file`, which workers read again.
    """
    kept = _read_token(file)
    if kept is not None and _is_usable(database, kept, labels):
        return kept
    name = f"workers of the pool {pool} of the server at {_place(settings.host, port)}"
    return database.write(SYSTEM, _replace_token, name, labels, file)


def _place(host: str, port: int) -> str:
    return f"{host}:{port} on {socket.gethostname()}"


def _read_token(file: Path) -> str | None:
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None


def _is_usable(database: Database, token: str, labels: Mapping[str, str]) -> bool:
    try:
        holder = database.read(SYSTEM, tokens.resolve_token, token)
    except ApiProblem:
        return False
    return holder.administrator and holder.scopes == ("work",) and dict(holder.labels or {}) == dict(labels)


def _replace_token(tx: Transaction, name: str, labels: Mapping[str, str], file: Path | None = None) -> str:
    """Create a token, and revoke earlier tokens with the same name.

    `file` is written before the transaction commits, so that no valid token is lost if the process dies in between.
    """
    tx.principal = users.administrator_principal(tx)
    name = name[:MAX_NAME_LENGTH]
    tokens.revoke_named(tx, name)
    wanted = TokenCreate(name=name, scopes=("work",), labels=dict(labels), expires_in_s=None)
    secret = tokens.create_token(tx, wanted).secret
    if file is not None:
        write_secret(file, secret)
    return secret
