"""Counterparts of `marey_client.handles.coverage_streams` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.coverage_streams import CoverageStreamHandle, CoverageStreams
from marey_schemas.coverage_streams import CoverageProgress, CoverageStream, CoverageStreamState


@counterpart_of(CoverageStreams)
class AsyncCoverageStreams(Counterpart):
    """Coverage streams of a project: each measures which motions a performance has covered, while it is recorded."""

    _sync: CoverageStreams

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def url(self) -> str:
        """The path of the streams, relative to the API's root."""
        return self._sync.url

    async def begin(
        self, frame_rate_hz: float, *, skeleton: str | None = None, evaluation: str | None = None, **options: Any
    ) -> AsyncCoverageStreamHandle:
        """Create a coverage stream.

        `skeleton` is the id of the skeleton of the poses to be sent; `evaluation` is the id of an evaluation whose
        coverage is the initial state. `options` are those of `CoverageStreamCreate`, for example
        `turn_rates_deg_s=(-90, 0, 90)`.
        """
        exchanged: AsyncCoverageStreamHandle = await self._exchange(
            self._sync.begin, frame_rate_hz, skeleton=skeleton, evaluation=evaluation, **options
        )
        return exchanged

    async def get(self, stream_id: str) -> AsyncCoverageStreamHandle:
        """Return a handle that continues a stream after its last frame; another process may have created the stream."""
        exchanged: AsyncCoverageStreamHandle = await self._exchange(self._sync.get, stream_id)
        return exchanged

    def list(self) -> AsyncIterator[CoverageStream]:
        """List the streams that received frames within the last day, newest first."""
        return self._each(self._sync.list)


@counterpart_of(CoverageStreamHandle)
class AsyncCoverageStreamHandle(Counterpart):
    """Handle of a coverage stream, to which the frames of a performance are sent."""

    _sync: CoverageStreamHandle

    @property
    def url(self) -> str:
        """The path of the stream, relative to the API's root."""
        return self._sync.url

    @property
    def stream(self) -> CoverageStream:
        """The stream in the state in which it was read."""
        return self._sync.stream

    @property
    def offset(self) -> int:
        """The number of frames sent so far."""
        return self._sync.offset

    @property
    def id(self) -> str:
        """The id of the stream."""
        return self._sync.id

    async def send(
        self,
        frames: NDArray[np.floating[Any]],
        *,
        translations: NDArray[np.floating[Any]] | None = None,
        translated_joints: str | Sequence[str] = (),
        ends_take: bool = False,
    ) -> CoverageProgress:
        """Send the next n frames, at most 4096; calls usually send 0.1 s to 1 s of motion.

        `frames` are poses (n, 3 + 4·joints): the root position in metres and the local quaternions w, x, y, z; or
        roots (n, 3): x and z in metres, heading in radians. `translations` (n, k, 3), in metres, replace the offsets
        of the k `translated_joints`. If an answer is lost, the frames are sent again, but counted only once. Raises
        `Conflict` if another program sends to the same stream.
        """
        return await self._run(
            self._sync.send, frames, translations=translations, translated_joints=translated_joints, ends_take=ends_take
        )

    async def end_take(self) -> CoverageProgress:
        """End the take, after a pause or lost frames; the next frames are measured as a new take."""
        return await self._run(self._sync.end_take)

    async def read(self) -> CoverageStreamState:
        """Return the whole coverage map, the performer's state, and the motions to record next."""
        return await self._run(self._sync.read)

    async def delete(self) -> None:
        """Delete the stream at once; otherwise, the server deletes it a day after its last frame."""
        await self._run(self._sync.delete)
