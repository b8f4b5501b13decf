"""Searches by example: one transaction reads the example, and a child process searches the files of the index."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.metrics import MetricDocument, MetricIdentity, built_in_metric, is_built_in
from marey_schemas.documents.motion_indexes import ShardClips
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.problems import FieldError
from marey_schemas.search import LONGEST_EXAMPLE_S, SimilarAnswer, SimilarMoment, SimilarRequest
from marey_schemas.wording import counted
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.child import Message, pack_tree, unpack_tree
from marey_server.motions.index_shards import MAPPED, ListedShard, ShardFiles, list_of
from marey_server.store import items
from marey_server.store.motion_indexes import FoundClip, FoundIndex
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules are loaded by children alone
    from marey_motion.perception.metric import PerceptualMetric
    from marey_motion.similarity.example import Example
    from marey_motion.similarity.searching import Hit
    from marey_motion.similarity.shard_search import SearchedShard

Tree = dict[str, Any]

SEARCH_INDEX = "marey_server.motions.similar:search_index"
"""Function that child processes run."""
THREADS = 2
CONTEXT_READ_S = 1.5
"""Seconds that are read before and after the example; the nearest second influences the features of the example."""


@dataclass(frozen=True, slots=True)
class FoundExample:
    """Example of a search: the frames `frames` of a clip, with the skeleton of the clip.

    `motion` contains these frames and some context before and after them; `first` is the index in `motion` of the first
    frame of the example.
    """

    clip: str
    revision: int
    motion: Tree
    first: int
    frames: tuple[int, int]
    hierarchy: Tree
    mapping: Tree | None


class SimilarOrder(Message):
    """Message that asks a child process to search an index."""

    request: SimilarRequest
    metric: MetricDocument
    revision: int
    motion: bytes
    first: int
    hierarchy: bytes
    mapping: bytes | None
    shards: tuple[ShardFiles, ...]
    heads: dict[str, int]


class FoundWindow(Message):
    """Window of a clip that resembles the example: half-open range of frames, times in seconds, and distance."""

    clip: str
    revision: int
    frames: tuple[int, int]
    start_s: float
    end_s: float
    distance: float
    mirrored: bool


class FoundWindows(Message):
    """Result of a search by example: the windows found, the most similar first.

    `searched_clips` is the number of clips that were searched; `behind` is the number of clips that were created or
    changed after the last update of the index, and so not searched.
    """

    windows: tuple[FoundWindow, ...]
    searched_clips: int
    behind: int


def read_example(tx: Transaction, project: str, request: SimilarRequest) -> FoundExample:
    """Return the example of a search.

    Raises `NotFoundProblem` if the clip does not exist. Raises `InvalidProblem` if the clip has fewer frames than the
    example, or if the example is too long.
    """
    part = items.read_part(tx, project, Kind.CLIP, request.clip, "motion", revision=request.revision)
    motion, (start, stop) = part.tree, request.frames
    count, rate_hz = motion["poses"].shape[0], motion["frame_rate_hz"]
    if stop > count:
        raise _invalid("/frames", f"The clip has {counted(count, 'frame')}; the example ends at frame {stop}.")
    if (stop - start) / rate_hz > LONGEST_EXAMPLE_S:
        raise _invalid("/frames", f"The example is longer than {LONGEST_EXAMPLE_S:g} s; give fewer frames.")
    margin = int(CONTEXT_READ_S * rate_hz) + 2
    first = max(0, start - margin)
    cut = items.cut_part(motion, slice(first, min(count, stop + margin)), None, encoded=True)
    skeleton = (project, Kind.SKELETON, motion["skeleton"]["item"])
    revision = motion["skeleton"]["revision"]
    hierarchy = items.read_part(tx, *skeleton, "hierarchy", revision=revision).tree
    try:
        mapping = items.read_part(tx, *skeleton, "mapping", revision=revision).tree
    except NotFoundProblem:  # an optional part: without it, the mapping is guessed
        mapping = None
    return FoundExample(request.clip, part.revision, cut, start - first, request.frames, hierarchy, mapping)


def read_metric(tx: Transaction, project: str, name: str) -> MetricDocument:
    """Return a built-in metric by its name, or a stored one by its id.

    Raises `InvalidProblem` if there is no such built-in metric, and `NotFoundProblem` if there is no such item.
    """
    if is_built_in(name):
        return built_in_metric(name)
    if "/" in name:
        raise _invalid("/metric", f"There is no built-in metric {name!r}; `marey metric ls` lists them.", "no-metric")
    return MetricDocument.model_validate(items.read_part(tx, project, Kind.METRIC, name, "metric").tree)


def search_order(
    request: SimilarRequest,
    metric: MetricDocument,
    found: FoundExample,
    index: FoundIndex,
    shards: tuple[ShardFiles, ...],
) -> SimilarOrder:
    """Return the message that asks a child process to search an index."""
    return SimilarOrder(
        request=request,
        metric=metric,
        revision=found.revision,
        motion=pack_tree(found.motion),
        first=found.first,
        hierarchy=pack_tree(found.hierarchy),
        mapping=None if found.mapping is None else pack_tree(found.mapping),
        shards=shards,
        heads=index.heads,
    )


def answer_of(
    found: FoundWindows, metric: MetricDocument, index: FoundIndex, clips: dict[str, FoundClip]
) -> SimilarAnswer:
    """Return the answer to a search; windows of clips that were changed or deleted during the search are left out."""
    moments = [
        SimilarMoment(path=clips[one.clip].path, **one.model_dump())
        for one in found.windows
        if one.clip in clips and clips[one.clip].head == one.revision
    ]
    return SimilarAnswer(
        moments=tuple(moments),
        metric=MetricIdentity.of(metric),
        index=RevisionRef(item=index.item, revision=index.revision),
        searched_clips=found.searched_clips,
        behind=found.behind,
    )


def _invalid(pointer: str, detail: str, code: str = "no-frames") -> InvalidProblem:
    return InvalidProblem(detail, code=code, errors=[FieldError(pointer=pointer, code=code, detail=detail)])


# -- in the child ------------------------------------------------------------------------------------------------------


_RANKS: LruCache[tuple[str, ...], list[Any]] = LruCache(max_entries=4)
"""Cache of a child process: the results of `_ranks`, by the paths of all lists."""


def search_index(packed: bytes) -> bytes:
    """Search an index of motions, in a child process. `packed` is a `SimilarOrder` as bytes.

    Return `FoundWindows` as bytes. Raises `InvalidProblem` if the example cannot be compared, and `NotFoundProblem` if
    files of the index are missing or damaged.
    """
    order = SimilarOrder.unpack(packed)
    with opened(order) as search:
        return _search(order, search).pack()


@dataclass(frozen=True, slots=True)
class OpenedSearch:
    """Input of a search in a child process: the shards, the list of clips of each, the example and the metric."""

    lists: list[ListedShard]
    shards: list[SearchedShard]
    example: Example
    rate_hz: float
    metric: PerceptualMetric

    def behind(self, heads: dict[str, int]) -> int:
        """Count the clips of which the index does not have the newest revision.

        `heads` maps the id of a clip to the number of its newest revision.
        """
        known = {
            clip
            for one in self.lists
            for clip in heads.keys() & one.places.keys()
            if any(one.clips.revisions[place] == heads[clip] for place in one.places[clip])
        }
        return sum(head > 0 and clip not in known for clip, head in heads.items())


@contextmanager
def opened(order: SimilarOrder) -> Iterator[OpenedSearch]:
    """Open the files of an index, and compute the features of the example.

    Raises `InvalidProblem` if the example cannot be compared, and `NotFoundProblem` if files of the index are missing
    or damaged.
    """
    from marey_motion.errors import MotionError
    from marey_motion.perception.metric import metric_of
    from marey_motion.similarity.weighing import require_searchable

    try:
        metric = metric_of(order.metric)
        require_searchable(metric)
    except MotionError as error:
        raise _invalid("/metric", f"The index cannot be searched by this metric: {error}", error.code) from error
    try:
        lists = [list_of(files) for files in order.shards]
        example, rate_hz = _example(order)
        ranks = _RANKS.get_or_make(tuple(files.clips for files in order.shards), lambda: _ranks(lists))
        parts = zip(order.shards, lists, ranks, strict=True)
        shards = [_searched(order, *one, rate_hz, example) for one in parts]
        with MAPPED.searching(order.shards):
            yield OpenedSearch(lists, shards, example, rate_hz, metric)
    except MotionError as error:
        raise _invalid("/clip", f"The example cannot be searched for: {error}", error.code) from error
    except FileNotFoundError as error:  # a search of another index needed the space
        raise NotFoundProblem(
            "The copies of the index were removed during the search; repeat the request.", code="no-index"
        ) from error


def _search(order: SimilarOrder, search: OpenedSearch) -> FoundWindows:
    from marey_motion.similarity.searching import search_windows

    request = order.request
    hits = search_windows(
        search.shards, search.example, search.metric, request.results, mirror=request.mirrored, threads=THREADS
    )
    length_s = (request.frames[1] - request.frames[0] - 1) / search.rate_hz
    return FoundWindows(
        windows=tuple(_window(hit, search.lists[hit.shard].clips, length_s) for hit in hits),
        searched_clips=sum(int((~shard.closed).sum()) for shard in search.shards),
        behind=search.behind(order.heads),
    )


def _ranks(lists: list[ListedShard]) -> list[Any]:
    """Return, for each shard, the rank of each of its clips in the order of the ids of all clips."""
    import numpy as np

    if not lists:
        return []
    sizes = np.cumsum([len(one.clips.items) for one in lists])[:-1]
    ids = np.array([item for one in lists for item in one.clips.items])
    ranks = np.empty(len(ids), np.int64)
    ranks[np.argsort(ids, kind="stable")] = np.arange(len(ids))
    return np.split(ranks, sizes)


def _example(order: SimilarOrder) -> tuple[Example, float]:
    """Compute the features of the example; also return its frame rate in Hz."""
    from marey_motion.documents import clip_from_document, skeleton_from_document, trusted_mapping
    from marey_motion.matching.body import MatchingBody
    from marey_motion.motion import Motion
    from marey_motion.similarity.example import Example, sample_offsets
    from marey_motion.similarity.features import INDEX_RATE_HZ, features_at

    skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(unpack_tree(order.hierarchy)))
    stored = None if order.mapping is None else SkeletonMapping.model_validate(unpack_tree(order.mapping))
    body = MatchingBody.from_mapping(skeleton, trusted_mapping(stored, skeleton)[0])
    clip = clip_from_document(MotionDocument.model_validate(unpack_tree(order.motion)), skeleton)
    first, end = order.request.frames
    offsets = sample_offsets((end - first - 1) / clip.frame_rate_hz)
    times = order.first + offsets * (clip.frame_rate_hz / INDEX_RATE_HZ)
    return Example(features_at(Motion.of(clip), body, clip.frame_rate_hz, times), offsets), clip.frame_rate_hz


def _searched(
    order: SimilarOrder, files: ShardFiles, listed: ListedShard, ranks: Any, rate_hz: float, example: Example
) -> SearchedShard:
    """Return a shard to search, without dropped clips, and without clips that changed since the index was updated.

    The clip of the example, or its moments near the example, are left out as well if the request asks for this.
    """
    import numpy as np

    from marey_motion.similarity.shard_search import SearchedShard

    closed = np.zeros(len(listed.clips.items), np.bool_)
    closed[list(files.dropped)] = True
    for clip in order.heads.keys() & listed.places.keys():
        for place in listed.places[clip]:
            closed[place] |= listed.clips.revisions[place] != order.heads[clip]
    windows: dict[int, tuple[int, int]] = {}
    if order.request.leave_out != "nothing":
        for own in listed.places.get(order.request.clip, ()):
            closed[own] |= order.request.leave_out == "clip"
            windows[own] = example.rows_around(order.request.frames[0], rate_hz)
    return SearchedShard(lambda: MAPPED.open(files, listed), ranks, closed, windows)


def _window(hit: Hit, clips: ShardClips, length_s: float) -> FoundWindow:
    from marey_motion.similarity.features import INDEX_RATE_HZ

    rate_hz, start_s = clips.rates_hz[hit.run], hit.row / INDEX_RATE_HZ
    first = round(start_s * rate_hz)
    end = min(first + round(length_s * rate_hz) + 1, clips.frames[hit.run])
    return FoundWindow(
        clip=clips.items[hit.run],
        revision=clips.revisions[hit.run],
        frames=(first, end),
        start_s=start_s,
        end_s=start_s + length_s,
        distance=hit.distance,
        mirrored=hit.mirrored,
    )
