"""Counterparts of `marey_client.handles.bisections` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from marey_client.handles.bisections import VersionTest
from marey_schemas.datasets.commits import Commit

AsyncIsBad = Callable[[Commit], Awaitable[bool | None] | (bool | None)]

AsyncOnStep = Callable[[VersionTest, int], Awaitable[None] | None]
