"""Administrator tokens for the owner of the machine: created at the first start, or to replace a lost token."""

from __future__ import annotations

import os
from pathlib import Path

from marey_schemas.access import TokenCreate
from marey_server.store import users
from marey_server.store.credentials import tokens
from marey_server.store.transaction import Transaction


def make_first_administrator(tx: Transaction, token_file: Path) -> None:
    """Create the user `admin` in a database without users, and write a token of this user to a file."""
    if users.ensure_first_administrator(tx) is not None:
        give_token(tx, users.FIRST_ADMINISTRATOR, token_file, name="first start")


def give_token(tx: Transaction, administrator: str | None, token_file: Path, *, name: str) -> None:
    """Create an administrator's token with every scope and no expiry, and write it to a private file.

    The token belongs to the user `administrator`, or if this is None, to the administrator who was created first. The
    file is written before the transaction commits, so that no valid token is lost if the process dies in between.
    Raises `NotFoundProblem` if no active administrator has this name.
    """
    tx.principal = users.administrator_principal(tx, administrator)
    wanted = TokenCreate(name=name, scopes=tx.principal.scopes, expires_in_s=None)
    write_secret(token_file, tokens.create_token(tx, wanted).secret)


def write_secret(file: Path, secret: str) -> None:
    """Write a secret to a file that only its owner can read. Readers see the old file or the new one, never a part."""
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    partial_file = file.with_name(f"{file.name}.partial")
    partial_file.unlink(missing_ok=True)
    with open(os.open(partial_file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as opened:
        opened.write(f"{secret}\n")
        opened.flush()
        os.fsync(opened.fileno())
    partial_file.replace(file)
