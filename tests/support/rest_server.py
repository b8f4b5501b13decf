"""A server for tests: the real application on a real socket, in a thread, with a database of its own."""

import asyncio
import contextlib
import functools
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.patience import PATIENCE_S

from marey_schemas.access import MemberChange, ProjectCreate, Role, TokenCreate, UserCreate
from marey_schemas.encoding.digests import digest_of
from marey_server.access.principal import SYSTEM, Principal
from marey_server.app import Application, create_app, listening
from marey_server.process.children import Children
from marey_server.process.memory import Holding
from marey_server.process.settings import PREFIX, Settings
from marey_server.store import members, projects, users
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database

ALL_SCOPES = ("read", "write", "jobs", "work", "admin")
USER_SCOPES = ("read", "write", "jobs")
SCRIPTS_AT = "https://git.invalid/"
"""Address below which the servers of tests allow the repositories of scripts."""


def noted_memory(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which each later request adds the numbers of bytes that it takes from the memory of requests."""
    taken: list[int] = []
    grow = Holding.grow

    def noted(holding: Holding, more: int) -> None:
        taken.append(more)
        grow(holding, more)

    monkeypatch.setattr(Holding, "grow", noted)
    return taken


def stored_file(client: httpx.Client, content: bytes) -> dict[str, Any]:
    """Store a blob; return the reference with which documents and results name it."""
    digest = digest_of(content)
    assert client.put(f"/blobs/{digest}", content=content).is_success
    return {"blob": digest, "size_bytes": len(content)}


@dataclass
class People:
    """Users of the server at an address, and their clients."""

    address: str
    database: Database
    _clients: dict[str | None, httpx.Client] = field(default_factory=dict, init=False)

    @property
    def api(self) -> str:
        return f"{self.address}/api/v1"

    def client(self, token: str | None = None) -> httpx.Client:
        """Return a client that sends `token` with each request."""
        if token not in self._clients:
            headers = {"Authorization": f"Bearer {token}"} if token else {}
            self._clients[token] = httpx.Client(base_url=self.api, headers=headers, timeout=PATIENCE_S)
        return self._clients[token]

    def make_user(self, name: str, *, administrator: bool = False, scopes: tuple[str, ...] = USER_SCOPES) -> str:
        """Create a user, and return a token of this user."""
        made = self.database.write(SYSTEM, users.create_user, UserCreate(name=name, administrator=administrator))
        return self.make_token(made.id, name, administrator=administrator, scopes=scopes)

    def make_token(self, user_id: str, name: str, *, administrator: bool = False, scopes: tuple[str, ...]) -> str:
        principal = Principal("user", user_id, name, administrator, ALL_SCOPES)
        return self.database.write(principal, tokens.create_token, TokenCreate(name="test", scopes=scopes)).secret

    def make_project(self, name: str = "lab", *, owner: str = "olga", **others: Role) -> str:
        """Create an owner and a project, with the existing users in `others` as members; return the owner's token."""
        token = self.make_user(owner)
        person = self.database.read(SYSTEM, tokens.resolve_token, token)
        self.database.write(person, projects.create_project, ProjectCreate(name=name))
        for member, role in others.items():
            self.database.write(person, members.put_member, name, member, MemberChange(role=role))
        return token

    def close(self) -> None:
        for client in self._clients.values():
            client.close()


@dataclass
class Server(People):
    """A running server in this process, and the people who use it."""

    app: Application
    stop: Any

    def close(self) -> None:
        super().close()
        self.stop()


class SharedChildren(Children):
    """Child processes that all servers of a test run use, because starting them takes long; they are never closed."""

    def close(self) -> None:
        """Do nothing, so that the next server can use the child processes, too."""


@functools.cache
def shared_children() -> SharedChildren:
    """Return the children of this test run with the default limits."""
    return SharedChildren(Settings().child_limits)


_CHOSEN: dict[str, Settings] = {}


def chosen_settings(folder: Path, given: dict[str, Any]) -> Settings:
    """Return the settings of a server whose data is in a folder.

    Settings that differ only in this folder are read and checked once, because this takes 3 ms.
    """
    given = {"drain_s": 5, **given}
    variables = sorted(one for one in os.environ.items() if one[0].startswith(PREFIX))
    key = repr((Path.cwd(), variables, sorted(given.items())))
    if key not in _CHOSEN:
        _CHOSEN[key] = Settings(data=folder, port=0, **given)
    return _CHOSEN[key].model_copy(update={"data": folder})


@contextlib.contextmanager
def running(database: Database, folder: Path, **settings: Any) -> Iterator[Server]:
    """Run a server with a database until the `with` block ends."""
    started: dict[str, Any] = {}
    ready = threading.Event()

    async def main() -> None:
        stop = asyncio.Event()
        chosen = chosen_settings(folder, {"script_repositories": (SCRIPTS_AT,), "warm_up": False} | settings)
        children = shared_children() if chosen.child_limits == shared_children().limits else None
        app = create_app(chosen, database, children)
        try:
            async with listening(app) as listener:
                loop = asyncio.get_running_loop()

                def stop_server() -> None:
                    with contextlib.suppress(RuntimeError):  # it has ended already
                        loop.call_soon_threadsafe(stop.set)

                started.update(app=app, address=listener.address, stop=stop_server)
                ready.set()
                await stop.wait()
        finally:
            ready.set()

    thread = threading.Thread(target=lambda: asyncio.run(main()), name="marey-test-server")
    thread.start()
    assert ready.wait(PATIENCE_S), "the server did not start"
    assert started, "the server failed to start"
    server = Server(started["address"], database, started["app"], started["stop"])
    try:
        yield server
    finally:
        server.close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), "the server did not stop"


@pytest.fixture
def server(database: Database, tmp_path: Path) -> Iterator[Server]:
    """A running server, on SQLite and on Postgres."""
    with running(database, tmp_path) as one:
        yield one


@pytest.fixture
def owner(server: Server) -> httpx.Client:
    """The client of the owner of the project `lab`."""
    return server.client(server.make_project())


@pytest.fixture
def worker(server: Server) -> httpx.Client:
    """The client of the user who runs jobs."""
    return server.client(server.make_user("wanda", administrator=True, scopes=("work",)))
