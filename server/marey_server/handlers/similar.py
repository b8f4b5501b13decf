"""Resource that searches by example."""

from __future__ import annotations

from functools import partial

from marey_schemas.similar import SimilarAnswer, SimilarRequest
from marey_server.http.declarations import Access, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.motions import similar
from marey_server.motions.similar import FoundWindows, ShardFiles
from marey_server.store import motion_indexes
from marey_server.store.motion_indexes import FoundIndex


class SimilarMoments(Resource):
    """Search for moments that resemble an example."""

    path = "/projects/{project}/similar"
    tag = "Items"

    @reads(access=Access.READER, body=SimilarRequest, answer=SimilarAnswer)
    async def post(self, project: str, body: SimilarRequest) -> Reply:
        """Return the moments of the project's clips that resemble some frames of a clip, the most similar first.

        An index of motions is searched, which a job of the kind `index` builds and updates. The result is that of a
        comparison with all windows of all clips in the index. Clips that were deleted or changed since the update are
        left out; `behind` counts those that the index does not have.
        """
        example = await self.look_up(similar.read_example, project, body)
        index = await self.look_up(motion_indexes.find_index, project, body.index)
        shards = await self._files_of(index)
        order = partial(similar.search_order, body, example, index, shards)
        found = await self.compute_apart(similar.SEARCH_INDEX, order, FoundWindows.unpack)
        clips = await self.look_up(motion_indexes.name_clips, project, {one.clip for one in found.windows})
        return Reply(similar.answer_of(found, index, clips))

    async def _files_of(self, index: FoundIndex) -> tuple[ShardFiles, ...]:
        """Copy the files of an index to this server, as far as they are not here yet."""
        files = self.services.index_files
        missing = await self.compute(files.missing, index.document)
        if missing:
            self.services.disk.require()
        for digest in missing:
            await self.look_up(files.copy, digest)
        return tuple(
            ShardFiles(
                clips=str(files.path(shard.clips.blob)),
                poses=str(files.path(shard.poses.blob)),
                dropped=shard.dropped,
            )
            for shard in index.document.shards
        )


RESOURCES: tuple[type[Resource], ...] = (SimilarMoments,)
