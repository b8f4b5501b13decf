"""Choice of the index by which a list finds the items that a query selects.

An index helps if few items have the wanted value, and costs time if most items have it. Databases estimate which is the
case: Postgres from statistics that may be old, SQLite without statistics. So this module counts the items that each
condition of a query selects, up to a limit. To do so, the database reads at most one more index entry than the limit,
which takes less than a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Select, func, null, select

from marey_schemas.kinds import Kind
from marey_schemas.queries.fields import FACET_PREFIX
from marey_schemas.queries.grammar import Condition, Likeness, Query, operands_of
from marey_server.store.items.querying import (
    COMPARISONS,
    Comparison,
    clips_like,
    facet_meets,
    frames_in_range,
    is_like,
    stored_text,
)
from marey_server.store.tables import INDEXED_CHARACTERS, INDEXED_FACTS, MemberStart, item, item_facet, item_tag
from marey_server.store.transaction import Transaction

MOST_ITEMS = 1000
"""Greatest number of items that `Narrowing.few` may select."""

Candidates = Callable[[Condition, str, Kind], Select[*tuple[Any, ...]]]
"""Function that returns an SQL query, supported by an index, for the items that may meet a condition.

The query has two columns: the id of an item and the time of its creation. Its rows are either in the order of creation,
the newest first, or in no order; in the second case, all times are null. It may also find items that do not meet the
condition, and items of other projects.
"""


class Narrowing(NamedTuple):
    """Condition that all items selected by a query meet, and for which the database has an index.

    At most one of the two fields is set. If no index helps, both are None.
    """

    few: ColumnElement[bool] | None = None
    """Condition that at most `MOST_ITEMS` items meet."""
    ordered: ColumnElement[bool] | None = None
    """Condition that a member of the summary has a certain value, which more than `MOST_ITEMS` items have.

    An index finds these items in the order of their creation, so a list in this order reads no other items.
    """


def narrow(tx: Transaction, project_id: str, kind: Kind, query: Query) -> Narrowing:
    """Return the condition by which the fewest items have to be read for a query.

    Each operand of the outermost `and` is a candidate if an index finds its items, or if it is a condition `like(...)`,
    whose clips are known. If one of them has at most `MOST_ITEMS` items, the one with the fewest items is returned as
    `few`. Otherwise, only operands that compare a member of the summary with a single value are considered. Of these,
    the rarest is returned as `ordered`: the one whose newest `MOST_ITEMS` items reach furthest back in time.
    """
    fewest, few = MOST_ITEMS + 1, None
    oldest_us, ordered = None, None
    for likeness in operands_of(query):
        if isinstance(likeness, Likeness) and len(clips := clips_like(likeness)) < fewest:
            fewest, few = len(clips), is_like(likeness)
    for condition, candidates in _indexed(query):
        found = candidates(condition, project_id, kind)
        newest = found.limit(MOST_ITEMS + 1).subquery()
        counting = select(func.count().label("number"), func.min(newest.c.created_us).label("since_us"))
        counted = tx.execute(counting.select_from(newest)).one()
        if counted.number < fewest:
            fewest, few = (
                counted.number,
                item.c.id.in_(found.order_by(None).with_only_columns(found.selected_columns[0])),
            )
        elif counted.since_us is not None and (oldest_us is None or counted.since_us < oldest_us):
            oldest_us, ordered = counted.since_us, _start(condition)
    return Narrowing(few) if few is not None else Narrowing(ordered=ordered)


def _indexed(query: Query) -> Iterator[tuple[Condition, Candidates]]:
    """Yield the operands of the outermost `and` whose items an index finds, each with the function for this index."""
    for part in operands_of(query):
        if not isinstance(part, Condition):
            continue
        if part.field.startswith(FACET_PREFIX):
            yield part, _with_facet
        elif part.operator == "=" and part.field in CANDIDATES:
            yield part, CANDIDATES[part.field]
        elif part.field in RANGES and part.operator != "has":
            yield part, _in_range


def _start(condition: Condition) -> ColumnElement[bool]:
    """Return the SQL condition that a member of the summary begins like one of the values of a condition.

    The first `INDEXED_CHARACTERS` characters are compared, because the index contains no more.
    """
    start = MemberStart(item.c.summary, condition.field)
    wanted = [stored_text(one)[:INDEXED_CHARACTERS] for one in condition.values]
    return start == wanted[0] if len(wanted) == 1 else start.in_(wanted)


def _with_fact(condition: Condition, project_id: str, kind: Kind) -> Select[*tuple[Any, ...]]:
    """Return a query for the items whose summary may have one of the values of the condition (see `Candidates`).

    For a single value, the newest items come first, in the order of the index. For several values, the query has no
    order, because SQLite would otherwise read all items in the order of creation.
    """
    present = (item.c.project_id == project_id, item.c.kind == kind.value, item.c.deleted_us.is_(None))
    if len(condition.values) > 1:
        return select(item.c.id, null().label("created_us")).where(*present, _start(condition))
    return select(item.c.id, item.c.created_us).where(*present, _start(condition)).order_by(item.c.created_us.desc())


def _with_tag(condition: Condition, _: str, __: Kind) -> Select[*tuple[Any, ...]]:
    wanted = item_tag.c.tag.in_([str(one) for one in condition.values])
    return select(item_tag.c.item_id, null().label("created_us")).where(wanted)


def _with_facet(condition: Condition, _: str, __: Kind) -> Select[*tuple[Any, ...]]:
    return select(item_facet.c.item_id, null().label("created_us")).where(facet_meets(condition))


def _in_range(condition: Condition, project_id: str, kind: Kind) -> Select[*tuple[Any, ...]]:
    """Return a query, without an order, for the items whose number or time is in the range of the condition.

    The query also finds deleted items, because the index that it uses does not contain the time of the deletion.
    """
    present = (item.c.project_id == project_id, item.c.kind == kind.value)
    in_range = RANGES[condition.field](condition, project_id)
    return select(item.c.id, null().label("created_us")).where(*present, in_range)


RANGES: dict[str, Comparison] = {
    "frames": frames_in_range, "created": COMPARISONS["created"], "updated": COMPARISONS["updated"],
}  # fmt: skip
"""Functions that convert conditions to SQL, for those fields with numbers or times for which there is an index."""
CANDIDATES: dict[str, Candidates] = {**dict.fromkeys(INDEXED_FACTS, _with_fact), "tag": _with_tag}
"""Functions that return the query for the items that may meet a condition `=`, by the name of the field."""
