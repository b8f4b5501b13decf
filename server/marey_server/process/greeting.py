"""What a server says first: where it listens, where its data lives, who administrates it, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from marey_server.access.principal import SYSTEM
from marey_server.process.administrators import TOKEN_FILE
from marey_server.process.settings import Settings
from marey_server.store import users
from marey_server.store.database.connections import Database

FIRST_COMMAND = "marey project create lab"


def greeting(settings: Settings, address: str, database: Database) -> Iterator[str]:
    """Its lines, without any secret."""
    yield f"listening on {address}"
    data = settings.data.absolute()
    yield f"data: {data}; database: {database.shown}"
    administrator = database.read(SYSTEM, users.administrator_principal).user_name
    token_file = data / TOKEN_FILE
    if token_file.is_file():
        yield f"administrator: {administrator}; a token of an administrator is in {token_file}"
    else:
        yield f"administrator: {administrator}; `marey db admin-token` makes a token where there is none any more"
    yield f"next, in another terminal{next_command(settings, address)}"


def next_command(settings: Settings, address: str) -> str:
    """Where to type the first command, and the command; with server and token where it would not find them itself."""
    reachable = address.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")
    defaults = Settings.model_fields
    usual_address = f"http://{defaults['host'].default}:{defaults['port'].default}"
    if reachable == usual_address and settings.data.absolute() == defaults["data"].default.absolute():
        return f" in this folder: {FIRST_COMMAND}"
    token_file = settings.data.absolute() / TOKEN_FILE
    if not token_file.is_file():
        return f": marey login --server {reachable}"
    program, words = FIRST_COMMAND.split(" ", 1)
    return f": {program} --server {reachable} --token-file {shlex.quote(str(token_file))} {words}"
