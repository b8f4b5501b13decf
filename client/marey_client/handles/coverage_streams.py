"""Coverage streams: measure a performance while it is recorded, and get the motions to record next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_client.arguments import checked, checks_arguments, several
from marey_client.paging import pages
from marey_client.transport import Transport, named_path, read_model
from marey_schemas.coverage_streams import (
    CoverageProgress,
    CoverageStream,
    CoverageStreamCreate,
    CoverageStreamState,
)
from marey_schemas.encoding.codecs import MSGPACK, encode_tree

ROOT_COLUMNS = 3


@checks_arguments
@dataclass(frozen=True)
class CoverageStreams:
    """Coverage streams of a project: each measures which motions a performance has covered, while it is recorded."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path of the streams, relative to the API's root."""
        return f"/projects/{self.project}/coverage-streams"

    def begin(
        self, frame_rate_hz: float, *, skeleton: str | None = None, evaluation: str | None = None, **options: Any
    ) -> CoverageStreamHandle:
        """Create a coverage stream.

        `skeleton` is the id of the skeleton of the poses to be sent; `evaluation` is the id of an evaluation whose
        coverage is the initial state. `options` are those of `CoverageStreamCreate`, for example
        `turn_rates_deg_s=(-90, 0, 90)`.
        """
        request = checked(
            CoverageStreamCreate,
            {"frame_rate_hz": frame_rate_hz, "skeleton": skeleton, "evaluation": evaluation, **options},
        )
        return CoverageStreamHandle(self.transport, self.url, self.transport.post(CoverageStream, self.url, request))

    def get(self, stream_id: str) -> CoverageStreamHandle:
        """Return a handle that continues a stream after its last frame; another process may have created the stream."""
        return CoverageStreamHandle(
            self.transport, self.url, self.transport.get(CoverageStream, named_path(self.url, stream_id))
        )

    def list(self) -> Iterator[CoverageStream]:
        """List the streams that received frames within the last day, newest first."""
        return pages(self.transport, CoverageStream, self.url)


@checks_arguments
class CoverageStreamHandle:
    """Handle of a coverage stream, to which the frames of a performance are sent."""

    transport: Transport
    url: str
    """The path of the stream, relative to the API's root."""
    stream: CoverageStream
    """The stream in the state in which it was read."""
    offset: int
    """The number of frames sent so far."""

    def __init__(self, transport: Transport, streams_url: str, stream: CoverageStream) -> None:
        self.transport = transport
        self.url = f"{streams_url}/{stream.id}"
        self.stream = stream
        self.offset = stream.offset

    @property
    def id(self) -> str:
        """The id of the stream."""
        return self.stream.id

    def send(
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
        body: dict[str, Any] = {"poses" if frames.shape[-1] != ROOT_COLUMNS else "roots": frames}
        if translations is not None:
            body |= {"translations": translations, "translated_joints": list(several(translated_joints))}
        return self._send({"offset": self.offset, "ends_take": ends_take, **body})

    def end_take(self) -> CoverageProgress:
        """End the take, after a pause or lost frames; the next frames are measured as a new take."""
        return self._send({"offset": self.offset, "ends_take": True})

    def read(self) -> CoverageStreamState:
        """Return the whole coverage map, the performer's state, and the motions to record next."""
        return self.transport.get(CoverageStreamState, self.url)

    def delete(self) -> None:
        """Delete the stream at once; otherwise, the server deletes it a day after its last frame."""
        self.transport.send("DELETE", self.url)

    def _send(self, body: dict[str, Any]) -> CoverageProgress:
        response = self.transport.send(
            "POST", f"{self.url}/frames", content=encode_tree(body, MSGPACK), media_type=MSGPACK, repeatable=True
        )
        progress = read_model(CoverageProgress, response)
        self.offset = progress.offset
        return progress
