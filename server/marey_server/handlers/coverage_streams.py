"""Resources that measure coverage during a recording: they receive frames, and return which motions to record next.

Coverage is the number of seconds of recorded motion at each speed and turn rate. A stream is stored in a row of the
database, which is updated before each answer. So no acknowledged frame is lost if the server crashes.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from marey_schemas.coverage_streams import (
    CoverageFrames,
    CoverageProgress,
    CoverageStream,
    CoverageStreamCreate,
    CoverageStreamState,
)
from marey_schemas.sizes import MIB
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.motions import coverage
from marey_server.motions.child import unpack_tree
from marey_server.motions.coverage import AdvancedStream, BegunStream, NextFrames
from marey_server.store import coverage_streams
from marey_server.store.coverage_streams import NewStream, Stream, StreamStep

MOST_FRAMES_BYTES = 16 * MIB


class ProjectCoverageStreams(Resource):
    """Coverage streams of a project."""

    path = "/projects/{project}/coverage-streams"
    tag = "Evaluations"

    @reads(access=Access.READER, query=PageQuery, answer=CoverageStream, paged=True)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the coverage streams of a project, newest first."""
        return await self.answer(coverage_streams.list_streams, project, cursor=query.cursor, limit=query.limit)

    @writes(
        access=Access.CONTRIBUTOR,
        body=CoverageStreamCreate,
        answer=CoverageStreamState,
        status=201,
        etag=True,
        idempotency="key",
    )
    async def post(self, project: str, body: CoverageStreamCreate) -> Rendered:
        """Create a stream, which measures the coverage of a recording.

        The stream starts with no coverage, or with the coverage of an evaluation. A stream that receives no frames for
        a day is deleted; the number of streams of a project is limited.
        """
        inputs = await self.look_up(coverage.read_stream_inputs, project, body)
        order = partial(coverage.begin_order, body, inputs)
        begun = await self.compute_apart(coverage.BEGIN_COVERAGE, order, BegunStream.unpack)

        def created(stream: Stream) -> Reply:
            location = f"/projects/{project}/coverage-streams/{stream.id}"
            return Reply(CoverageStreamState(**stream.shown(), **begun.shown), rev=stream.rev, location=location)

        new = NewStream(begun.settings, inputs.rig, begun.state)
        return await self.answer_with(created, coverage_streams.create_stream, project, new)


class CoverageStreamResource(Resource):
    """A coverage stream."""

    path = "/projects/{project}/coverage-streams/{stream}"
    tag = "Evaluations"

    @reads(access=Access.READER, answer=CoverageStreamState, etag=True)
    async def get(self, project: str, stream: str) -> Reply:
        """Return a stream with its coverage map, the performer's state, and the motions to record next."""
        held = await self.look_up(coverage_streams.read_stream, project, stream)
        state = await self.compute_apart(coverage.LOOK_AT_COVERAGE, partial(coverage.look_order, held), unpack_tree)
        return Reply(CoverageStreamState(**held.shown(), **state), rev=held.rev)

    @writes(access=Access.CONTRIBUTOR)
    async def delete(self, project: str, stream: str) -> Rendered:
        """Delete a stream."""
        return await self.answer(coverage_streams.delete_stream, project, stream)


class CoverageStreamFrames(Resource):
    """Frames of a coverage stream."""

    path = "/projects/{project}/coverage-streams/{stream}/frames"
    tag = "Evaluations"

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(CoverageFrames, max_bytes=MOST_FRAMES_BYTES),
        answer=CoverageProgress,
    )
    async def post(self, project: str, stream: str, body: CoverageFrames) -> Rendered | Reply:
        """Send the next frames of a stream; the answer lists the speeds and turn rates that are still missing.

        Frames are poses of the stream's skeleton, or root positions. If the last frames are sent again at the same
        offset, the answer is repeated. If the offset is not the number of frames of the stream, the answer is 409 with
        this number in `context.offset`.
        """
        held = await self.look_up(coverage_streams.read_to_advance, project, stream)
        given = await self.compute(coverage.next_frames, held, body)
        if not isinstance(given, NextFrames):
            return _progress(given)
        made = await self.compute_apart(coverage.ADVANCE_COVERAGE, lambda: given.order, AdvancedStream.unpack)
        step = StreamStep(given.digest, made.answer, made.offset, made.state)
        return await self.answer_with(_progress, coverage_streams.advance_stream, project, held, step)


def _progress(answer: dict[str, Any]) -> Reply:
    return Reply(CoverageProgress.model_validate(answer))


RESOURCES: tuple[type[Resource], ...] = (ProjectCoverageStreams, CoverageStreamResource, CoverageStreamFrames)
