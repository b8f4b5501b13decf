"""Counterparts of `marey_client.handles.crossings` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from marey_client.handles.bisections import VersionTest
from marey_client.handles.crossings import Measurement

AsyncOnMeasured = Callable[[VersionTest, Measurement, int], Awaitable[None] | None]
