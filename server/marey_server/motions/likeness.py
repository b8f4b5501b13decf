"""Conditions `like(...)` of queries, which select clips with a moment like an example.

One transaction reads the examples of a query; child processes then search the index of motions.
"""

from __future__ import annotations

from dataclasses import dataclass

from marey_schemas.documents.metrics import MetricDocument, is_built_in
from marey_schemas.kinds import Kind
from marey_schemas.options.perception import DEFAULT_METRIC
from marey_schemas.queries.grammar import MOST_ALIKE, Likeness, likenesses_of
from marey_schemas.search import SimilarRequest
from marey_schemas.wording import counted
from marey_server.errors import BadRequestProblem, ConflictProblem, InvalidProblem
from marey_server.motions.child import Message
from marey_server.motions.index_shards import ShardFiles
from marey_server.motions.similar import (
    THREADS,
    FoundExample,
    SimilarOrder,
    opened,
    read_example,
    read_metric,
    search_order,
)
from marey_server.store import items
from marey_server.store.items import ItemFilters
from marey_server.store.items.listing import read_query
from marey_server.store.motion_indexes import FoundIndex
from marey_server.store.transaction import Transaction

SEARCH_CLIPS = "marey_server.motions.likeness:search_clips"
"""Function that child processes run."""


@dataclass(frozen=True, slots=True)
class FoundLikeness:
    """Condition `like(...)` of a query, with its example, its metric, and the search request that stands for it."""

    condition: Likeness
    request: SimilarRequest
    example: FoundExample
    metric: MetricDocument


class LikenessOrder(SimilarOrder):
    """Message that asks a child process for the clips whose distance from the example is below or above a limit."""

    distance: float
    below: bool


class AlikeClips(Message):
    """Answer to a `LikenessOrder`: ids of the clips found, and number of changed clips that the index does not have."""

    clips: tuple[str, ...]
    behind: int


def may_compare_motion(query: str | None) -> bool:
    """Return whether a query could contain a condition `like(...)`; this is a quick check of its text."""
    return query is not None and "like" in query.lower()


def nothing_alike(query: str) -> dict[str, frozenset[str]]:
    """Return an empty set of clips for each condition `like(...)` of a query, for items that are not clips.

    Raises `BadRequestProblem` for a query that cannot be read.
    """
    return {one.source: frozenset() for one in likenesses_of(read_query(query))}


def read_likenesses(tx: Transaction, project: str, query: str) -> tuple[FoundLikeness, ...]:
    """Read the examples and metrics of all different conditions `like(...)` of a query.

    Raises `BadRequestProblem` for a query that cannot be read, or if an example or a metric does not exist.
    """
    conditions = {one.source: one for one in likenesses_of(read_query(query))}
    return tuple(_read(tx, project, one) for one in conditions.values())


def _read(tx: Transaction, project: str, condition: Likeness) -> FoundLikeness:
    path, frames = condition.moment
    clip = _find(tx, project, Kind.CLIP, path, condition)
    name = condition.metric or DEFAULT_METRIC
    if not is_built_in(name):
        name = _find(tx, project, Kind.METRIC, name, condition)
    request = SimilarRequest(clip=clip, frames=frames, metric=name, leave_out="nothing")
    try:
        return FoundLikeness(condition, request, read_example(tx, project, request), read_metric(tx, project, name))
    except InvalidProblem as problem:
        raise _bad(condition, problem.detail) from problem


def _find(tx: Transaction, project: str, kind: Kind, path: str, condition: Likeness) -> str:
    """Return the id of the item at a path.

    Raises `BadRequestProblem`, with the column of the condition, if there is none.
    """
    found = items.list_items(tx, project, kind, ItemFilters(path=path, name=path.rpartition("/")[2]), limit=1).items
    if not found:
        raise _bad(condition, f"There is no {kind.value} {path!r} in this project.")
    return str(found[0].id)


def _bad(condition: Likeness, detail: str) -> BadRequestProblem:
    column = condition.column
    return BadRequestProblem(f"query, column {column}: {detail}", code="bad-query", context={"column": column})


def likeness_order(found: FoundLikeness, index: FoundIndex, shards: tuple[ShardFiles, ...]) -> bytes:
    """Return the packed message that asks a child process for the clips that meet a condition."""
    order = search_order(found.request, found.metric, found.example, index, shards)
    return LikenessOrder(**dict(order), distance=found.condition.distance, below=found.condition.below).pack()


def clips_of(project: str, condition: Likeness, found: AlikeClips) -> frozenset[str]:
    """Return the ids of the clips that meet a condition.

    Raises `ConflictProblem` if the index does not have all clips, and `BadRequestProblem` if too many clips meet the
    condition.
    """
    if found.behind:
        raise ConflictProblem(
            f"{counted(found.behind, 'clip')} changed or were created since the index of motions was updated, so "
            f"{condition.source} cannot be decided for them; update the index with `marey index {project}`.",
            code="index-outdated",
        )
    if len(found.clips) > MOST_ALIKE:
        raise _bad(condition, f"More than {MOST_ALIKE:,} clips meet {condition.source}; give a smaller distance.")
    # Somebody may have written the index by hand, and databases refuse some characters.
    return frozenset(one for one in found.clips if one.isascii() and one.isprintable())


# -- in the child ------------------------------------------------------------------------------------------------------


def search_clips(packed: bytes) -> bytes:
    """Search the clips that meet a condition, in a child process. `packed` is a `LikenessOrder` as bytes.

    Return `AlikeClips` as bytes. Raises `InvalidProblem` if the example cannot be compared, and `NotFoundProblem` if
    files of the index are missing or damaged.
    """
    from marey_motion.similarity import searching

    order = LikenessOrder.unpack(packed)
    with opened(order) as search:
        found = searching.search_clips(
            search.shards,
            search.example,
            search.metric,
            order.distance,
            MOST_ALIKE + 1,
            below=order.below,
            threads=THREADS,
        )
        clips = tuple(search.lists[shard].clips.items[run] for shard, run in found)
        return AlikeClips(clips=clips, behind=search.behind(order.heads)).pack()
