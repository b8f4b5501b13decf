"""Searches in indexes of motions: moments that resemble an example, and clips that meet conditions of queries."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from marey_schemas.kinds import Kind
from marey_schemas.search import SimilarAnswer, SimilarRequest
from marey_server.http.declarations import Access, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.motions import likeness, similar
from marey_server.motions.index_shards import ShardFiles
from marey_server.motions.likeness import AlikeClips
from marey_server.motions.similar import FoundWindows
from marey_server.store import motion_indexes
from marey_server.store.items import ItemFilters
from marey_server.store.motion_indexes import FoundIndex


class IndexSearcher(Resource):
    """Base of resources that search an index of motions."""

    async def searched(self, project: str, kind: Kind, filters: ItemFilters) -> ItemFilters:
        """Evaluate the conditions `like(...)` in the query of `filters`.

        Return the filters, to which the clips that meet each condition are added. Only clips can meet such a condition;
        items of other kinds have no motion. A query for deleted items may not contain such conditions.
        """
        if not likeness.may_compare_motion(filters.query) or filters.deleted:
            return filters
        if kind is not Kind.CLIP:
            return replace(filters, alike=await self.compute(likeness.nothing_alike, str(filters.query)))
        found = await self.look_up(likeness.read_likenesses, project, str(filters.query))
        if not found:
            return filters
        index = await self.look_up(motion_indexes.find_index, project, None)
        alike = {}
        for one in found:
            shards = await self.files_of(index)
            order = partial(likeness.likeness_order, one, index, shards)
            clips = await self.compute_apart(likeness.SEARCH_CLIPS, order, AlikeClips.unpack)
            alike[one.condition.source] = likeness.clips_of(project, one.condition, clips)
        await self.look_up(motion_indexes.require_all_clips, project, index)
        return replace(filters, alike=alike)

    async def files_of(self, index: FoundIndex) -> tuple[ShardFiles, ...]:
        """Copy missing files of an index to this server, and return the paths of all files, by shard.

        Raises `StorageFullProblem` if the disk is full.
        """
        files = self.services.index_files
        missing = await self.compute(files.missing, index.document)
        if missing:
            self.services.disk.require()
        for file in missing:
            await self.look_up(files.copy, file)
        return tuple(
            ShardFiles(
                clips=str(files.path(shard.clips.blob)),
                poses=str(files.path(shard.poses.blob)),
                dropped=shard.dropped,
            )
            for shard in index.document.shards
        )


class SimilarMoments(IndexSearcher):
    """Search for moments that resemble an example."""

    path = "/projects/{project}/similar"
    tag = "Items"

    @reads(access=Access.READER, body=SimilarRequest, answer=SimilarAnswer)
    async def post(self, project: str, body: SimilarRequest) -> Reply:
        """Return the moments of the project's clips that resemble some frames of a clip, the most similar first.

        An index of motions is searched, which a job of the kind `index` builds and updates. The result is the same as
        if the example were compared with every window of every clip in the index. Clips that were deleted or changed
        after the last update of the index are left out; `behind` is the number of clips that were created or changed
        after it.
        """
        example = await self.look_up(similar.read_example, project, body)
        metric = await self.look_up(similar.read_metric, project, body.metric)
        index = await self.look_up(motion_indexes.find_index, project, body.index)
        shards = await self.files_of(index)
        order = similar.search_order(body, metric, example, index, shards).pack
        found = await self.compute_apart(similar.SEARCH_INDEX, order, FoundWindows.unpack)
        clips = await self.look_up(motion_indexes.name_clips, project, {one.clip for one in found.windows})
        return Reply(similar.answer_of(found, metric, index, clips))


RESOURCES: tuple[type[Resource], ...] = (SimilarMoments,)
