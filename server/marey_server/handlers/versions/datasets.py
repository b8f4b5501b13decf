"""Resources of datasets: versions, branches, tags and differences."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.datasets.checkouts import CheckoutAnswer, CheckoutRequest
from marey_schemas.datasets.commits import Commit, CommitCreate, Entry, EntryOrigins, EntryPath
from marey_schemas.datasets.differences import DatasetDifference, ListedCommit
from marey_schemas.datasets.merges import MergeAnswer, MergeRequest, PickRequest
from marey_schemas.datasets.naming import MAIN, Dataset, DatasetCreate, Ref, RefCreate, RefMove, Version
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.kinds import Kind
from marey_schemas.names import CollectionPath
from marey_schemas.sizes import MIB
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import datasets, purging

MAX_COMMIT_BYTES = 16 * MIB


class ProjectDatasets(Resource):
    """Datasets of a project."""

    path = "/projects/{project}/datasets"
    tag = "Datasets"

    @reads(access=Access.READER, query=PageQuery, answer=Dataset, paged=True)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the datasets of a project in the order of their names."""
        return await self.answer(datasets.list_datasets, project, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.CONTRIBUTOR, body=DatasetCreate, answer=Dataset, status=201, etag=True, idempotency="key")
    async def post(self, project: str, body: DatasetCreate) -> Rendered:
        """Create a dataset, which has the branch `main` and no commits."""
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/projects/{project}/datasets/{made.name}"),
            datasets.create_dataset,
            project,
            body,
        )


class DatasetResource(Resource):
    """A dataset."""

    path = "/projects/{project}/datasets/{dataset}"
    tag = "Datasets"

    @reads(access=Access.READER, answer=Dataset, etag=True)
    async def get(self, project: str, dataset: str) -> Rendered:
        """Return a dataset."""
        return await self.answer(datasets.read_dataset, project, dataset)

    @writes(access=Access.MAINTAINER, precondition="required")
    async def delete(self, project: str, dataset: str) -> Rendered:
        """Delete a dataset; its items are not deleted."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(datasets.delete_dataset, project, dataset, expected_rev=expected_rev)


class DatasetRefs(Resource):
    """Branches and tags of a dataset."""

    path = "/projects/{project}/datasets/{dataset}/refs"
    tag = "Datasets"

    @reads(access=Access.READER, query=PageQuery, answer=Ref, paged=True)
    async def get(self, project: str, dataset: str, query: PageQuery) -> Rendered:
        """List the branches and tags of a dataset in the order of their names."""
        return await self.answer(datasets.list_refs, project, dataset, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.CONTRIBUTOR, body=RefCreate, answer=Ref, status=201, etag=True, idempotency="key")
    async def post(self, project: str, dataset: str, body: RefCreate) -> Rendered:
        """Create a branch or a tag at a version."""
        return await self.answer(datasets.create_ref, project, dataset, body)


class DatasetRef(Resource):
    """A branch or a tag."""

    path = "/projects/{project}/datasets/{dataset}/refs/{ref}"
    tag = "Datasets"

    @reads(access=Access.READER, answer=Ref, etag=True)
    async def get(self, project: str, dataset: str, ref: str) -> Rendered:
        """Return a branch with its protection, or a tag."""
        return await self.answer(datasets.read_ref, project, dataset, ref)

    @writes(access=Access.MAINTAINER, body=RefMove, answer=Ref, etag=True, precondition="required")
    async def patch(self, project: str, dataset: str, ref: str, body: RefMove) -> Rendered:
        """Move a branch to any version of the dataset; no commit is deleted."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(datasets.move_branch, project, dataset, ref, body, expected_rev=expected_rev)

    @writes(access=Access.MAINTAINER, precondition="required")
    async def delete(self, project: str, dataset: str, ref: str) -> Rendered:
        """Delete a branch or a tag; no commit is deleted.

        A tag cannot be deleted while something cites its version, unless another tag names the same version. Jobs that
        have not ended, and items that a job made, can cite versions.
        """
        citing = await self.look_up(purging.find_citations, project, dataset, ref)
        expected_rev = self.precondition.expected_rev
        return await self.answer(purging.delete_uncited_ref, project, dataset, ref, citing, expected_rev=expected_rev)


class BranchProtection(Resource):
    """Protection rule of a branch."""

    path = "/projects/{project}/datasets/{dataset}/refs/{ref}/protection"
    tag = "Datasets"

    @writes(access=Access.MAINTAINER, body=ProtectionRule, answer=Ref, etag=True, precondition="required")
    async def put(self, project: str, dataset: str, ref: str, body: ProtectionRule) -> Rendered:
        """Protect a branch, or replace its protection rule. A protected branch can be neither deleted nor reset."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(datasets.protect_branch, project, dataset, ref, body, expected_rev=expected_rev)

    @writes(access=Access.MAINTAINER, answer=Ref, etag=True, precondition="required")
    async def delete(self, project: str, dataset: str, ref: str) -> Rendered:
        """Remove the protection rule of a branch."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(datasets.protect_branch, project, dataset, ref, None, expected_rev=expected_rev)


class CommitsQuery(PageQuery):
    """Query parameters for listing commits."""

    version: Version = Field(MAIN, description="Version at which the list begins.")
    path: CollectionPath = Field(
        "",
        description="Entry or folder: only commits that changed it or anything below it are listed, each with the "
        "number of entries by kind of change. A page may then be shorter than `limit`, even if more pages follow.",
    )


class DatasetCommits(Resource):
    """Commits of a dataset."""

    path = "/projects/{project}/datasets/{dataset}/commits"
    tag = "Datasets"

    @reads(access=Access.READER, query=CommitsQuery, answer=ListedCommit, paged=True)
    async def get(self, project: str, dataset: str, query: CommitsQuery) -> Rendered:
        """List a version and the versions before it, newest first; only the first parent of a merge is followed."""
        return await self.answer(
            datasets.list_commits,
            project,
            dataset,
            query.version,
            path=query.path,
            cursor=query.cursor,
            limit=query.limit,
        )

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(CommitCreate, max_bytes=MAX_COMMIT_BYTES),
        answer=Commit,
        status=201,
        idempotency="key",
    )
    async def post(self, project: str, dataset: str, body: CommitCreate) -> Rendered:
        """Record a new version on a branch: the content of the dataset's folder, or a list of changes."""
        prepared = await self.look_up(datasets.prepare_commit, project, dataset, body)
        return await self.answer(datasets.record_commit, project, dataset, prepared)


class DatasetMerges(Resource):
    """Merges of versions into branches."""

    path = "/projects/{project}/datasets/{dataset}/merges"
    tag = "Datasets"

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(MergeRequest, max_bytes=MAX_COMMIT_BYTES),
        answer=MergeAnswer,
        idempotency="key",
        names=True,
    )
    async def post(self, project: str, dataset: str, body: MergeRequest) -> Rendered:
        """Merge a version into a branch, entry by entry and part by part, or preview the result.

        Annotations that both sides have changed are merged segment by segment.
        Conflicts without a resolution are answered with 409 and listed in `context`; then nothing changes.
        """
        merge = await self.look_up(datasets.prepare_merge, project, dataset, body)
        return await self.answer(datasets.record_merge, project, dataset, body, merge)


class CherryPicks(Resource):
    """Cherry-picks: the changes of single commits, repeated on branches."""

    path = "/projects/{project}/datasets/{dataset}/cherry-picks"
    tag = "Datasets"

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(PickRequest, max_bytes=MAX_COMMIT_BYTES),
        answer=MergeAnswer,
        idempotency="key",
        names=True,
    )
    async def post(self, project: str, dataset: str, body: PickRequest) -> Rendered:
        """Repeat the changes of one commit on a branch, or preview the result.

        Conflicts without a resolution are answered with 409 and listed in `context`; then nothing changes.
        """
        merge = await self.look_up(datasets.prepare_pick, project, dataset, body, undo=False)
        return await self.answer(datasets.record_merge, project, dataset, body, merge)


class DatasetReverts(Resource):
    """Reverts: the changes of single commits, undone on branches."""

    path = "/projects/{project}/datasets/{dataset}/reverts"
    tag = "Datasets"

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(PickRequest, max_bytes=MAX_COMMIT_BYTES),
        answer=MergeAnswer,
        idempotency="key",
        names=True,
    )
    async def post(self, project: str, dataset: str, body: PickRequest) -> Rendered:
        """Undo the changes of one commit on a branch, but not later changes, or preview the result.

        Conflicts without a resolution are answered with 409 and listed in `context`; then nothing changes.
        """
        merge = await self.look_up(datasets.prepare_pick, project, dataset, body, undo=True)
        return await self.answer(datasets.record_merge, project, dataset, body, merge)


class FolderCheckout(Resource):
    """Checkout of a version into the folder of a dataset."""

    path = "/projects/{project}/datasets/{dataset}/checkout"
    tag = "Datasets"

    @writes(access=Access.MAINTAINER, body=CheckoutRequest, answer=CheckoutAnswer)
    async def post(self, project: str, dataset: str, body: CheckoutRequest) -> Rendered:
        """Bring the folder of the dataset to the state of a version: items are added, changed, moved and removed.

        With `query` or `paths`, only the selected entries are checked out. The server stores the selection with the
        folder: later commits of the folder keep all other entries of the version.

        If the folder has changes that no commit has recorded, the request is refused with 409, unless it asks to
        discard them. Removed items can be restored, and earlier revisions of items remain.
        """
        selected = await self.look_up(datasets.select_entries, project, dataset, body)
        return await self.answer(datasets.check_out, project, dataset, body, selected)


class DatasetCommit(Resource):
    """A commit."""

    path = "/projects/{project}/datasets/{dataset}/commits/{version}"
    tag = "Datasets"

    @reads(access=Access.READER, answer=Commit)
    async def get(self, project: str, dataset: str, version: str) -> Rendered:
        """Return the commit of a version, which is given as a branch, a tag or a digest."""
        return await self.answer(datasets.read_commit, project, dataset, version)


class EntriesQuery(PageQuery):
    """Query parameters of a list of entries."""

    version: Version = Field(MAIN, description="Version whose entries are listed.")
    path: CollectionPath = Field("", description="Entry, or folder whose entries are listed; empty: all entries.")


class DatasetEntries(Resource):
    """Entries of a version."""

    path = "/projects/{project}/datasets/{dataset}/entries"
    tag = "Datasets"

    @reads(access=Access.READER, query=EntriesQuery, answer=Entry, paged=True, compressed=True)
    async def get(self, project: str, dataset: str, query: EntriesQuery) -> Rendered:
        """List the entries of a version in the order of their paths; all pages are from the same commit."""
        return await self.answer(
            datasets.list_entries,
            project,
            dataset,
            query.version,
            path=query.path,
            cursor=query.cursor,
            limit=query.limit,
        )


class BlameQuery(Request):
    """Query parameters for the origins of an entry's content."""

    version: Version = Field(MAIN, description="Version that has the entry.")
    entry: EntryPath = Field(description="Path of the entry.")
    kind: Kind = Field(description="Kind of the entry.")


class EntryBlame(Resource):
    """Origins of the content of an entry."""

    path = "/projects/{project}/datasets/{dataset}/blame"
    tag = "Datasets"

    @reads(access=Access.READER, query=BlameQuery, answer=EntryOrigins)
    async def get(self, project: str, dataset: str, query: BlameQuery) -> Rendered:
        """Return the commits that last changed the parts, the path and the tags of an entry.

        If the version does not have the entry, the error `no-entry` names the commit that removed it.
        """
        return await self.answer(
            datasets.read_origins, project, dataset, query.version, path=query.entry, kind=query.kind
        )


class DifferenceQuery(Request):
    """Query parameters for the difference of two versions."""

    before: Version = Field(f"{MAIN}~1", description="The earlier version.")
    after: Version = Field(MAIN, description="The later version.")
    path: CollectionPath = Field("", description="Entry or folder to compare; empty: all entries.")
    limit: int = Field(1000, ge=1, le=10_000, description="Greatest number of entries that are listed.")


class VersionDifference(Resource):
    """Difference of two versions."""

    path = "/projects/{project}/datasets/{dataset}/difference"
    tag = "Datasets"

    @reads(access=Access.READER, query=DifferenceQuery, answer=DatasetDifference, compressed=True)
    async def get(self, project: str, dataset: str, query: DifferenceQuery) -> Rendered:
        """Return the entries that were added, removed, moved or changed between two versions."""
        return await self.answer(
            datasets.compare_versions,
            project,
            dataset,
            query.before,
            query.after,
            path=query.path,
            limit=query.limit,
        )


RESOURCES: tuple[type[Resource], ...] = (
    ProjectDatasets,
    DatasetResource,
    DatasetRefs,
    DatasetRef,
    BranchProtection,
    DatasetCommits,
    DatasetMerges,
    CherryPicks,
    DatasetReverts,
    FolderCheckout,
    DatasetCommit,
    DatasetEntries,
    EntryBlame,
    VersionDifference,
)
