"""The rooms that the commands `serve`, `worker`, `demo` and `db` open on this machine.

Nothing else of the client reaches the server, the worker or the motion package, and these load only when such a command
runs: a machine with the client alone stays a client.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from marey_client.credentials import Credential
from marey_client.errors import MareyError


class NotInstalled(MareyError):
    """A part of Marey that this command needs is not installed here."""


def serve(**settings: Any) -> None:
    """Run a server until it is stopped; settings that are None come from the environment or `marey.toml`."""
    commands = _room("marey_server.commands", "server")
    with _refusals_of(commands):
        commands.serve(**_given(settings))


def database(action: str, *, data: Path | None, database_url: str | None, **options: Any) -> None:
    """Run one of the database commands."""
    commands = _room("marey_server.commands", "server")
    with _refusals_of(commands):
        getattr(commands, action)(**_given({"data": data, "database_url": database_url}), **options)


def work(credential: Credential, **options: Any) -> None:
    """Run jobs until stopped."""
    _room("marey_worker.commands", "worker").work(credential, **options)


def demo(motion: Path | None, **options: Any) -> None:
    """Run the demonstration."""
    _room("marey_worker.demo", "all").demonstrate(motion, **options)


@contextmanager
def _refusals_of(commands: ModuleType) -> Iterator[None]:
    """Turn the refusals of a room's commands into the client's own errors."""
    try:
        yield
    except commands.CommandFailed as refusal:
        raise MareyError(str(refusal)) from refusal


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if value is not None}


def _room(module: str, extra: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise NotInstalled(
            f"this needs a part that is not installed ({error.name}); pip install 'marey[{extra}]'"
        ) from error
