"""Engines of a test process that compile each statement only once, like a server with its only database.

Each test opens a database of its own. Each engine of SQLAlchemy has a dialect of its own, for which it compiles all
statements again. This took a third of the processor time of the tests of the store.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, MutableMapping
from typing import Any, ParamSpec

import pytest
import sqlalchemy
import sqlalchemy.event
from sqlalchemy import Dialect, Engine
from sqlalchemy.util import LRUCache

from marey_server.store.database import connections

P = ParamSpec("P")

MOST_STATEMENTS = 3000
"""Greatest number of compiled statements that are kept for a kind of database; the store has fewer."""

_SHARED: dict[str, tuple[Dialect, MutableMapping[Any, Any]]] = {}
"""By kind of database, the dialect of an engine that has connected, and the statements compiled for this dialect."""


def sharing(create: Callable[P, Engine]) -> Callable[P, Engine]:
    """Return a function that creates engines as `create` does; engines of one dialect share compiled statements."""

    @functools.wraps(create)
    def create_sharing(*args: P.args, **kwargs: P.kwargs) -> Engine:
        engine = create(*args, **kwargs)
        if engine.name not in _SHARED:
            sqlalchemy.event.listen(
                engine, "engine_connect", _share_dialect
            )  # only now does the dialect know its server
            return engine
        engine.dialect, compiled = _SHARED[engine.name]
        engine.update_execution_options(compiled_cache=compiled)
        return engine

    return create_sharing


def _share_dialect(connection: sqlalchemy.Connection) -> None:
    _SHARED.setdefault(connection.dialect.name, (connection.dialect, LRUCache(MOST_STATEMENTS)))


@pytest.fixture(scope="session", autouse=True)
def _shared_statements() -> Iterator[None]:
    """Let all databases that this process opens share compiled statements."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("sqlite_engine", "postgres_engine"):
            patch.setattr(connections, name, sharing(getattr(connections, name)))
        yield
