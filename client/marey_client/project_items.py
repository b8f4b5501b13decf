"""Items of a project by kind, the folders of a project, and purges."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Unpack

from marey_client.arguments import checked, checks_arguments
from marey_client.blobs import Blobs
from marey_client.errors import NotFound
from marey_client.handles.annotations import AnnotationHandle
from marey_client.handles.clips import ClipHandle
from marey_client.handles.edits import EditHandle, Edits
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.handles.metrics import Metric, MetricHandle, PerceptualMetrics
from marey_client.handles.models import ModelHandle
from marey_client.handles.processed import ProcessedHandle
from marey_client.handles.purges import purge_items
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.handles.studies import Studies, StudyHandle
from marey_client.imports import Imports
from marey_client.items import ItemHandle, Items
from marey_client.jobs import Jobs
from marey_client.keywords.asking import PurgeKeywords, SimilarKeywords
from marey_client.paging import pages
from marey_client.transport import Params, Transport, as_json, read_model, sends_nothing
from marey_schemas.documents.skeleton_merges import SkeletonMergeAnswer, SkeletonMergeRequest
from marey_schemas.items import Collection, CollectionChange, CollectionCreate, Item
from marey_schemas.kinds import Kind
from marey_schemas.purges import DatasetPurgeAnswer, DatasetPurgeRequest, PurgeAnswer, PurgeRequest
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.search import SimilarAnswer, SimilarRequest


@checks_arguments
class ProjectItems:
    """Items of a project, given by name; requests are sent only by its methods."""

    transport: Transport
    name: str
    """Name of the project."""

    def __init__(self, transport: Transport, name: str) -> None:
        self.transport = transport
        self.name = name

    @cached_property
    def imports(self) -> Imports:
        """Imports of files into the project."""
        return Imports(self.transport, self.name, Blobs(self.transport), Jobs(self.transport))

    @cached_property
    def clips(self) -> Items[ClipHandle]:
        """The clips of the project: iterable, and by path or id, as in `clips["raw/walk"]`."""
        return Items(self.transport, self.name, Kind.CLIP, ClipHandle)

    @cached_property
    def skeletons(self) -> Items[SkeletonHandle]:
        """The skeletons of the project: iterable, and by path or id."""
        return Items(self.transport, self.name, Kind.SKELETON, SkeletonHandle)

    @cached_property
    def annotations(self) -> Items[AnnotationHandle]:
        """The annotations of clips in the project: iterable, and by path or id."""
        return Items(self.transport, self.name, Kind.ANNOTATION, AnnotationHandle)

    @cached_property
    def processed(self) -> Items[ProcessedHandle]:
        """The processed data of the project: clips aligned to a reference, with their time functions (time warps)."""
        return Items(self.transport, self.name, Kind.PROCESSED, ProcessedHandle)

    @cached_property
    def edits(self) -> Edits:
        """The edits (saved lists of commands) of the project: iterable, and by path or id."""
        return Edits(self.transport, self.name, Kind.EDIT, EditHandle)

    @cached_property
    def models(self) -> Items[ModelHandle]:
        """The generative models of the project: iterable, and by path or id."""
        return Items(self.transport, self.name, Kind.MODEL, ModelHandle)

    @cached_property
    def evaluations(self) -> Items[EvaluationHandle]:
        """The evaluations of locomotion clips in the project: iterable, and by path or id."""
        return Items(self.transport, self.name, Kind.EVALUATION, EvaluationHandle)

    @cached_property
    def studies(self) -> Studies:
        """The perceptual studies of the project: iterable, and by path or id."""
        return Studies(self.transport, self.name, Kind.STUDY, StudyHandle)

    @cached_property
    def metrics(self) -> PerceptualMetrics:
        """The stored perceptual metrics of the project: iterable, and by path or id."""
        return PerceptualMetrics(self.transport, self.name, Kind.METRIC, MetricHandle)

    @sends_nothing
    def items(self, kind: Kind) -> Items[Any]:
        """The items of the given kind in the project: iterable, and by path or id."""
        known: tuple[Items[Any], ...] = (
            self.clips, self.skeletons, self.annotations, self.processed, self.edits, self.models, self.evaluations,
            self.studies, self.metrics,
        )  # fmt: skip
        return next((one for one in known if one.kind is kind), Items(self.transport, self.name, kind, ItemHandle))

    def similar(
        self,
        clip: ClipHandle | str,
        frames: int | tuple[int, int],
        *,
        metric: Metric | None = None,
        **options: Unpack[SimilarKeywords],
    ) -> SimilarAnswer:
        """Find the moments of the project's clips that resemble a pose or a window of frames in a clip.

        `clip` is a handle, a path or an id; `frames` is one frame, or a half-open range of frames. `metric` is the id
        or the handle of a stored metric, or the name of a built-in metric. `options` are the other fields of
        `SimilarOptions`. The project needs an index of motions, which `ProjectHandle.index` builds.
        """
        clip = self.clips[clip] if isinstance(clip, str) else clip
        first, end = (frames, frames + 1) if isinstance(frames, int) else frames
        named = {} if metric is None else {"metric": metric if isinstance(metric, str) else metric.id}
        request = checked(
            SimilarRequest,
            {"clip": clip.id, "revision": clip.item.revision, "frames": (first, end), **named, **options},
        )
        return self.transport.post(SimilarAnswer, f"/projects/{self.name}/similar", request)

    @cached_property
    def collections(self) -> Collections:
        """The folders of the project."""
        return Collections(self.transport, self.name)

    def purge(self, **conditions: Unpack[PurgeKeywords]) -> PurgeAnswer:
        """Delete deleted items for good, so that garbage collection frees their bytes. For owners of the project.

        `conditions` are the fields of `PurgeRequest`, such as `collection="raw", older_than_days=30`; with
        `preview=True`, nothing changes. Items that something still needs are not purged; the answer lists these items,
        each with the objects that need it. Raises `Conflict` if `item` names a single item that something needs.
        """
        return purge_items(self.transport, self.name, checked(PurgeRequest, conditions))

    def merge_skeletons(
        self,
        skeletons: Iterable[SkeletonHandle | str] = (),
        *,
        keep: SkeletonHandle | str | None = None,
        dry_run: bool = False,
    ) -> SkeletonMergeAnswer:
        """Merge skeletons of one rig into one of them, to which their clips and models move. For maintainers.

        Skeletons are handles, paths or ids; without `skeletons`, all duplicates of the project are merged. `keep` is
        the skeleton that remains. With `dry_run`, nothing changes. Raises `Invalid` for skeletons of different rigs.
        """
        request = checked(
            SkeletonMergeRequest,
            skeletons=tuple(map(self._skeleton_id, skeletons)),
            kept=None if keep is None else self._skeleton_id(keep),
            dry_run=dry_run,
        )
        return self.transport.post(SkeletonMergeAnswer, f"/projects/{self.name}/skeleton-merges", request)

    def _skeleton_id(self, skeleton: SkeletonHandle | str) -> str:
        return (self.skeletons[skeleton] if isinstance(skeleton, str) else skeleton).id

    def purge_dataset(self, name: str, *, preview: bool = False) -> DatasetPurgeAnswer:
        """Delete a deleted dataset for good: versions, branches, tags and proposals. For owners of the project.

        `name` is the name or the id of the dataset. With `preview`, nothing changes, and the answer lists the objects
        that refer to the versions. Raises `Conflict` if an object refers to a version.
        """
        request = checked(DatasetPurgeRequest, dataset=name, preview=preview)
        return self.transport.post(DatasetPurgeAnswer, f"/projects/{self.name}/dataset-purges", request)

    def edited_rigs(self, clips: Iterable[Item]) -> tuple[ItemInput, ...]:
        """Return the skeletons of `clips` whose joint mapping may have been edited: those with several revisions.

        Deleted skeletons are left out. For a clip of a deleted skeleton, jobs use the mapping in the revision of the
        skeleton to which the clip refers.
        """
        edited = []
        for used in sorted({str(clip.summary["skeleton"]) for clip in clips}):
            with suppress(NotFound):
                if self.skeletons.get(used).item.revision > 1:
                    edited.append(ItemInput(item=used))
        return tuple(edited)


@checks_arguments
@dataclass(frozen=True)
class Collections:
    """Folders of a project."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path of the folders, relative to the API's root."""
        return f"/projects/{self.project}/collections"

    def list(
        self, *, path: str | None = None, deleted: bool = False, filters: Params | None = None
    ) -> Iterator[Collection]:
        """List folders by path: all folders, or `path` and the folders below it; with `deleted`, deleted folders."""
        params = {"path": path or None, "deleted": "true" if deleted else None, **(filters or {})}
        return pages(self.transport, Collection, self.url, params)

    def at(self, path: str, *, deleted: bool = False) -> Collection | None:
        """Return the folder with this path, or None; with `deleted`, the folder at this path that was deleted last."""
        found = [one for one in self.list(path=path, deleted=deleted) if one.path == path]
        return max(found, key=lambda one: one.deleted_at or one.created_at, default=None)

    def create(self, path: str) -> Collection:
        """Create a folder, with its parents if they are missing."""
        return self.transport.post(Collection, self.url, checked(CollectionCreate, path=path))

    def move(self, collection: Collection, path: str) -> Collection:
        """Move or rename a folder with its contents; the items keep their ids and their history."""
        state = {"If-Match": f'"{collection.rev}.json"'}
        body = as_json(checked(CollectionChange, path=path))
        return read_model(
            Collection, self.transport.send("PATCH", f"{self.url}/{collection.id}", content=body, headers=state)
        )

    def delete(self, collection: Collection) -> None:
        """Delete a folder with its contents; it can be restored."""
        state = {"If-Match": f'"{collection.rev}.json"'}
        self.transport.send("DELETE", f"{self.url}/{collection.id}", headers=state)

    def restore(self, collection: Collection) -> Collection:
        """Restore a deleted folder with the contents that were deleted along with it."""
        return self.transport.post(Collection, f"{self.url}/{collection.id}/restore")
