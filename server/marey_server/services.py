"""What one server process holds and every handler may use."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeVar

from marey_server.observe import Metrics
from marey_server.settings import Settings
from marey_server.store.database import Database

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Description:
    """The API described, as bytes: the OpenAPI document, the page, and a name of this state of both."""

    document: bytes
    page: bytes
    tag: str


@dataclass
class Services:
    """Database, threads, metrics and the state of a server that is starting, serving or draining."""

    settings: Settings
    database: Database
    description: Callable[[], Description]
    metrics: Metrics = field(default_factory=Metrics)
    draining: asyncio.Event = field(default_factory=asyncio.Event)
    in_flight: set[Any] = field(default_factory=set)
    compute: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(max(2, os.cpu_count() or 2), thread_name_prefix="marey-compute")
    )

    def submit(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run numeric work or file work in a thread, away from the event loop."""
        return self.compute.submit(function, *args, **kwargs)

    def close(self) -> None:
        """Wait for what runs, then let go of everything."""
        self.compute.shutdown(wait=True)
        self.database.close()
