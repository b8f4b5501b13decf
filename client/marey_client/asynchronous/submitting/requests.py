"""Counterparts of `marey_client.submitting.requests` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from marey_client.asynchronous.handles.annotations import AsyncAnnotationHandle
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.handles.processed import AsyncProcessedHandle
from marey_client.asynchronous.places import AsyncPlaces
from marey_client.imports import LocalFile

AsyncClips: TypeAlias = AsyncPlaces[AsyncClipHandle]

AsyncAnnotations: TypeAlias = AsyncPlaces[AsyncAnnotationHandle]

AsyncAlignedClips: TypeAlias = AsyncPlaces[AsyncProcessedHandle]

AsyncTakes: TypeAlias = AsyncClips | Sequence[LocalFile]
