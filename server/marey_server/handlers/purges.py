"""Resources of purges, which permanently remove items and datasets that were deleted before."""

from __future__ import annotations

from marey_schemas.purges import DatasetPurgeAnswer, DatasetPurgeRequest, PurgeAnswer, PurgeRequest
from marey_server.http.declarations import Access, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import purging


class ProjectPurges(Resource):
    """Purges of deleted items."""

    path = "/projects/{project}/purges"
    tag = "Items"

    @writes(access=Access.OWNER, body=PurgeRequest, answer=PurgeAnswer, idempotency="key")
    async def post(self, project: str, body: PurgeRequest) -> Rendered:
        """Purge deleted items: remove their revisions, documents and names permanently, or preview the purge.

        An item is not purged if a version of a dataset, a document of another item, or an unfinished job still needs
        it. The answer lists what needs each of these items. If the only requested item is still needed, the answer is
        409, with the same list in `context`. Garbage collection frees the bytes later. One request examines a limited
        number of items; to continue, send the value of `next` in the answer as `after`.
        """
        if body.preview:
            return await self.render_document(Reply(await self.look_up(purging.preview_purge, project, body)))
        prepared = await self.look_up(purging.prepare_purge, project, body)
        return await self.answer(purging.record_purge, project, body, prepared)


class DatasetPurges(Resource):
    """Purges of deleted datasets."""

    path = "/projects/{project}/dataset-purges"
    tag = "Datasets"

    @writes(access=Access.OWNER, body=DatasetPurgeRequest, answer=DatasetPurgeAnswer, idempotency="key")
    async def post(self, project: str, body: DatasetPurgeRequest) -> Rendered:
        """Purge a deleted dataset: remove its versions, branches, tags and proposals permanently, or preview the purge.

        A version is still needed by items that a job made from it, and by unfinished jobs that read it. If there are
        such items or jobs, the answer is 409 (`still-held`), and `context` lists them. The purge does not delete the
        items in the versions. After the purge, items of these versions that are marked as deleted can be purged, too.
        """
        if body.preview:
            return await self.render_document(Reply(await self.look_up(purging.preview_dataset_purge, project, body)))
        prepared = await self.look_up(purging.prepare_dataset_purge, project, body)
        return await self.answer(purging.record_dataset_purge, project, body, prepared)


RESOURCES: tuple[type[Resource], ...] = (ProjectPurges, DatasetPurges)
