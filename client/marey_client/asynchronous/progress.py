"""Counterparts of `marey_client.progress` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

AsyncOnProgress = Callable[[str, int, int | None], Awaitable[None] | None]
