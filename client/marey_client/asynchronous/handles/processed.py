"""Counterparts of `marey_client.handles.processed` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.poses.handle import AsyncPosesHandle
from marey_client.handles.processed import ProcessedHandle
from marey_schemas.documents.alignments import AlignmentInfo


@counterpart_of(ProcessedHandle)
class AsyncProcessedHandle(AsyncPosesHandle):
    """Handle of an aligned clip: poses at the canonical frames of an action, and the source frame of each of them.

    Positions are in the canonical frame of reference.
    """

    _sync: ProcessedHandle

    async def info(self, *, revision: int | None = None) -> AlignmentInfo:
        """Return the part `info`: keyframes, cost and options of the alignment, and the time function."""
        return await self._run(self._sync.info, revision=revision)

    async def time_function(self) -> NDArray[np.float64]:
        """Return the source frame of each canonical frame, as an array (N,) of fractional frame numbers.

        Source frames are counted at the rate of the aligned clip.
        """
        return await self._run(self._sync.time_function)

    async def source(self) -> AsyncClipHandle | None:
        """Return the source clip at its newest revision; None if the source is not a stored clip."""
        exchanged: AsyncClipHandle | None = await self._exchange(self._sync.source)
        return exchanged
