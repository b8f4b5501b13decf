"""Counterparts of `marey_client.places` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias, TypeVar

from marey_client.asynchronous.items import AsyncItemHandle
from marey_schemas.queue.jobs import ExistingInput

AsyncHandle = TypeVar("AsyncHandle", bound=AsyncItemHandle)

AsyncPlace: TypeAlias = str | ExistingInput | AsyncHandle

AsyncPlaces: TypeAlias = AsyncPlace[AsyncHandle] | Sequence[AsyncPlace[AsyncHandle]]
