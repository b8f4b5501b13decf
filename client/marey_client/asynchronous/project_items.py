"""Counterparts of `marey_client.project_items` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from typing import Any, Unpack

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.asynchronous.handles.annotations import AsyncAnnotationHandle
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.handles.edits import AsyncEdits
from marey_client.asynchronous.handles.evaluations import AsyncEvaluationHandle
from marey_client.asynchronous.handles.metrics import AsyncMetric, AsyncPerceptualMetrics
from marey_client.asynchronous.handles.models import AsyncModelHandle
from marey_client.asynchronous.handles.processed import AsyncProcessedHandle
from marey_client.asynchronous.handles.skeletons import AsyncSkeletonHandle
from marey_client.asynchronous.handles.studies import AsyncStudies
from marey_client.asynchronous.imports import AsyncImports
from marey_client.asynchronous.items import AsyncItems
from marey_client.keywords.asking import PurgeKeywords, SimilarKeywords
from marey_client.project_items import Collections, ProjectItems
from marey_client.transport import Params
from marey_schemas.documents.skeleton_merges import SkeletonMergeAnswer
from marey_schemas.items import Collection, Item
from marey_schemas.kinds import Kind
from marey_schemas.purges import DatasetPurgeAnswer, PurgeAnswer
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.search import SimilarAnswer


@counterpart_of(ProjectItems)
class AsyncProjectItems(Counterpart):
    """Items of a project, given by name; requests are sent only by its methods."""

    _sync: ProjectItems

    @property
    def name(self) -> str:
        """Name of the project."""
        return self._sync.name

    @property
    def imports(self) -> AsyncImports:
        """Imports of files into the project."""
        exchanged: AsyncImports = self._as_async(self._sync.imports)
        return exchanged

    @property
    def clips(self) -> AsyncItems[AsyncClipHandle]:
        """The clips of the project: iterable, and by path or id, as in `clips["raw/walk"]`."""
        exchanged: AsyncItems[AsyncClipHandle] = self._as_async(self._sync.clips)
        return exchanged

    @property
    def skeletons(self) -> AsyncItems[AsyncSkeletonHandle]:
        """The skeletons of the project: iterable, and by path or id."""
        exchanged: AsyncItems[AsyncSkeletonHandle] = self._as_async(self._sync.skeletons)
        return exchanged

    @property
    def annotations(self) -> AsyncItems[AsyncAnnotationHandle]:
        """The annotations of clips in the project: iterable, and by path or id."""
        exchanged: AsyncItems[AsyncAnnotationHandle] = self._as_async(self._sync.annotations)
        return exchanged

    @property
    def processed(self) -> AsyncItems[AsyncProcessedHandle]:
        """The processed data of the project: clips aligned to a reference, with their time functions (time warps)."""
        exchanged: AsyncItems[AsyncProcessedHandle] = self._as_async(self._sync.processed)
        return exchanged

    @property
    def edits(self) -> AsyncEdits:
        """The edits (saved lists of commands) of the project: iterable, and by path or id."""
        exchanged: AsyncEdits = self._as_async(self._sync.edits)
        return exchanged

    @property
    def models(self) -> AsyncItems[AsyncModelHandle]:
        """The generative models of the project: iterable, and by path or id."""
        exchanged: AsyncItems[AsyncModelHandle] = self._as_async(self._sync.models)
        return exchanged

    @property
    def evaluations(self) -> AsyncItems[AsyncEvaluationHandle]:
        """The evaluations of locomotion clips in the project: iterable, and by path or id."""
        exchanged: AsyncItems[AsyncEvaluationHandle] = self._as_async(self._sync.evaluations)
        return exchanged

    @property
    def studies(self) -> AsyncStudies:
        """The perceptual studies of the project: iterable, and by path or id."""
        exchanged: AsyncStudies = self._as_async(self._sync.studies)
        return exchanged

    @property
    def metrics(self) -> AsyncPerceptualMetrics:
        """The stored perceptual metrics of the project: iterable, and by path or id."""
        exchanged: AsyncPerceptualMetrics = self._as_async(self._sync.metrics)
        return exchanged

    def items(self, kind: Kind) -> AsyncItems[Any]:
        """The items of the given kind in the project: iterable, and by path or id."""
        exchanged: AsyncItems[Any] = self._now(self._sync.items, kind)
        return exchanged

    async def similar(
        self,
        clip: AsyncClipHandle | str,
        frames: int | tuple[int, int],
        *,
        metric: AsyncMetric | None = None,
        **options: Unpack[SimilarKeywords],
    ) -> SimilarAnswer:
        """Find the moments of the project's clips that resemble a pose or a window of frames in a clip.

        `clip` is a handle, a path or an id; `frames` is one frame, or a half-open range of frames. `metric` is the id
        or the handle of a stored metric, or the name of a built-in metric. `options` are the other fields of
        `SimilarOptions`. The project needs an index of motions, which `ProjectHandle.index` builds.
        """
        exchanged: SimilarAnswer = await self._exchange(self._sync.similar, clip, frames, metric=metric, **options)
        return exchanged

    @property
    def collections(self) -> AsyncCollections:
        """The folders of the project."""
        exchanged: AsyncCollections = self._as_async(self._sync.collections)
        return exchanged

    async def purge(self, **conditions: Unpack[PurgeKeywords]) -> PurgeAnswer:
        """Delete deleted items for good, so that garbage collection frees their bytes. For owners of the project.

        `conditions` are the fields of `PurgeRequest`, such as `collection="raw", older_than_days=30`; with
        `preview=True`, nothing changes. Items that something still needs are not purged; the answer lists these items,
        each with the objects that need it. Raises `Conflict` if `item` names a single item that something needs.
        """
        return await self._run(self._sync.purge, **conditions)

    async def merge_skeletons(
        self,
        skeletons: Iterable[AsyncSkeletonHandle | str] = (),
        *,
        keep: AsyncSkeletonHandle | str | None = None,
        dry_run: bool = False,
    ) -> SkeletonMergeAnswer:
        """Merge skeletons of one rig into one of them, to which their clips and models move. For maintainers.

        Skeletons are handles, paths or ids; without `skeletons`, all duplicates of the project are merged. `keep` is
        the skeleton that remains. With `dry_run`, nothing changes. Raises `Invalid` for skeletons of different rigs.
        """
        exchanged: SkeletonMergeAnswer = await self._exchange(
            self._sync.merge_skeletons, skeletons, keep=keep, dry_run=dry_run
        )
        return exchanged

    async def purge_dataset(self, name: str, *, preview: bool = False) -> DatasetPurgeAnswer:
        """Delete a deleted dataset for good: versions, branches, tags and proposals. For owners of the project.

        `name` is the name or the id of the dataset. With `preview`, nothing changes, and the answer lists the objects
        that refer to the versions. Raises `Conflict` if an object refers to a version.
        """
        return await self._run(self._sync.purge_dataset, name, preview=preview)

    async def edited_rigs(self, clips: Iterable[Item]) -> tuple[ItemInput, ...]:
        """Return the skeletons of `clips` whose joint mapping may have been edited: those with several revisions.

        Deleted skeletons are left out. For a clip of a deleted skeleton, jobs use the mapping in the revision of the
        skeleton to which the clip refers.
        """
        return await self._run(self._sync.edited_rigs, clips)


@counterpart_of(Collections)
class AsyncCollections(Counterpart):
    """Folders of a project."""

    _sync: Collections

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def url(self) -> str:
        """The path of the folders, relative to the API's root."""
        return self._sync.url

    def list(
        self, *, path: str | None = None, deleted: bool = False, filters: Params | None = None
    ) -> AsyncIterator[Collection]:
        """List folders by path: all folders, or `path` and the folders below it; with `deleted`, deleted folders."""
        return self._each(self._sync.list, path=path, deleted=deleted, filters=filters)

    async def at(self, path: str, *, deleted: bool = False) -> Collection | None:
        """Return the folder with this path, or None; with `deleted`, the folder at this path that was deleted last."""
        return await self._run(self._sync.at, path, deleted=deleted)

    async def create(self, path: str) -> Collection:
        """Create a folder, with its parents if they are missing."""
        return await self._run(self._sync.create, path)

    async def move(self, collection: Collection, path: str) -> Collection:
        """Move or rename a folder with its contents; the items keep their ids and their history."""
        return await self._run(self._sync.move, collection, path)

    async def delete(self, collection: Collection) -> None:
        """Delete a folder with its contents; it can be restored."""
        await self._run(self._sync.delete, collection)

    async def restore(self, collection: Collection) -> Collection:
        """Restore a deleted folder with the contents that were deleted along with it."""
        return await self._run(self._sync.restore, collection)
