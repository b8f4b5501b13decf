"""Events, in the order in which their transactions were committed.

SQLite has one writer, so that `event.seq`, given at the insertion, already follows the order of commits. On Postgres
transactions overlap, so events get their numbers after the commit, in `number_events`. A transaction that numbers
events holds a lock until its own commit, sees only committed events, and continues after the last number. So no event
gets a lower number than one that was already listed. Writers do not wait for each other, and the order depends on
nothing but the tables.

The feed is the list of events that clients and webhooks follow. Old events are deleted, except entries of the audit
log, which are kept longer. The feed begins after the last deleted event, so it does not contain the audit entries
before it. Clients thus never receive audit entries of a period whose other events were deleted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import takewhile
from typing import Any, NamedTuple

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    LargeBinary,
    Row,
    Select,
    Text,
    and_,
    cast,
    delete,
    exists,
    func,
    insert,
    or_,
    select,
    text,
    update,
)
from sqlalchemy.dialects.postgresql import ARRAY, array

from marey_schemas.items import Event
from marey_schemas.sizes import MIB
from marey_server.access.roles import require_administrator
from marey_server.errors import GoneProblem
from marey_server.store import projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.jobs.claiming.turns import claim_order
from marey_server.store.jobs.fencing import QUEUED
from marey_server.store.tables import event, job, project, queue_share, server_state
from marey_server.store.transaction import Transaction, in_lists
from marey_server.store.wakeups import events_topic, job_topic, work_topic

MAX_EVENTS = 1000
PAGE_BYTES = 4 * MIB
"""Greatest total size in bytes of the event bodies in a page; an event with a larger body has a page of its own."""
NUMBERED_AT_ONCE = 10_000
"""Greatest number of events that get their numbers in one transaction."""

CHANNEL = "marey_events"
"""Channel of Postgres (LISTEN and NOTIFY) on which servers announce to each other that events got numbers."""

LAST_NUMBER = "last_event_number"
"""Key of the number of the last numbered event, in the table `server_state`."""
_LAST_DELETED = "last_deleted_event"
DELETED_AT_ONCE = 1000
"""Greatest number of events that are deleted in one transaction."""
_UNNUMBERED = event.c.number.is_(None)


class EventPage(NamedTuple):
    """Page of events; `complete` says that no further events existed when the page was read."""

    items: list[Event]
    complete: bool


def list_events(
    tx: Transaction, project_name: str | None = None, *, after: int = 0, limit: int = 100, subject: str | None = None
) -> EventPage:
    """List the events after the one numbered `after`: of a project, or, for administrators, of the whole server.

    With `subject`, only events of that object are listed. A page has at most `limit` events and `PAGE_BYTES`, but at
    least one event if there is any. On Postgres, call `number_events` first. Raises `GoneProblem` if events after
    `after` were deleted, unless `after` is 0, which means the oldest stored event.
    """
    require_kept(tx, after)
    conditions = [follows(tx, start_of_feed(tx, after))]
    if project_name is None:
        require_administrator(tx.principal)
    else:
        conditions.append(event.c.project_id == projects.require(tx, project_name).id)
    if subject is not None:
        conditions.append(event.c.subject == subject)
    most = min(limit, MAX_EVENTS)
    placed = _placed(tx, conditions, most + 1).subquery()
    statement = (
        select(*_COLUMNS, number_of(tx).label("number"), project.c.name.label("project"), placed.c.found)
        .select_from(event.join(placed, placed.c.seq == event.c.seq))
        .outerjoin(project, project.c.id == event.c.project_id)
        .where(or_(placed.c.until_bytes <= PAGE_BYTES, placed.c.until_bytes == placed.c.size_bytes))
    )
    rows = tx.execute(statement.order_by(number_of(tx))).all()
    shown = rows[:most]  # one row more was read, to see whether further events exist
    return EventPage([_shown(row) for row in shown], not rows or len(shown) == rows[0].found)


def _placed(tx: Transaction, conditions: Sequence[ColumnElement[bool]], most: int) -> Select[*tuple[Any, ...]]:
    """Return a query for the first `most` events that meet the conditions, without the bodies of the events.

    The column `until_bytes` is the running total of the sizes of the bodies in bytes, including the row's own. With it,
    callers select the bodies that fit into a page. The column `found` is the number of rows.
    """
    text_size = func.octet_length(cast(event.c.body, Text))
    size_bytes = text_size if tx.is_postgres else func.length(cast(event.c.body, LargeBinary))
    number = number_of(tx)
    first = select(event.c.seq, number.label("number"), size_bytes.label("size_bytes")).where(*conditions)
    sized = first.order_by(number).limit(most).subquery()
    until_bytes = func.sum(sized.c.size_bytes).over(order_by=sized.c.number)
    return select(sized.c.seq, sized.c.size_bytes, until_bytes.label("until_bytes"), func.count().over().label("found"))


def require_kept(tx: Transaction, after: int) -> None:
    """Raise `GoneProblem` if an event after the one numbered `after` was deleted; 0 always passes."""
    last = _last_deleted(tx)
    if 0 < after < last:
        raise GoneProblem(
            f"Events up to number {last} were deleted because they are old; read the resources that you "
            f"follow again, then continue with after={last}.",
            code="events-deleted",
            context={"after": last},
        )


def _last_deleted(tx: Transaction) -> int:
    """Return the number of the last event that was deleted from the feed, 0 if there is none."""
    return int(tx.execute(select(server_state.c.value).where(server_state.c.key == _LAST_DELETED)).scalar() or 0)


def start_of_feed(tx: Transaction, after: int) -> int:
    """Return the number after which a client that has the events up to `after` continues to read.

    This is `after`, or the number of the last deleted event if that is greater.
    """
    return max(after, _last_deleted(tx))


# -- deletion of old events --------------------------------------------------------------------------------------------


def find_last_old(tx: Transaction, age_us: int) -> int | None:
    """Return the number up to which `delete_until` may delete the events of the feed; None if no event is old enough.

    All events of the feed up to this number are older than `age_us` (microseconds). They are at most `DELETED_AT_ONCE`,
    and the newest event is never among them.
    """
    number = number_of(tx)
    oldest = select(number.label("number"), event.c.at_us).where(follows(tx, _last_deleted(tx)))
    return _last_of_old(tx, oldest.where(number < newest_number(tx)).order_by(number), age_us)


def _last_of_old(tx: Transaction, oldest: Select[*tuple[Any, ...]], age_us: int) -> int | None:
    rows = tx.execute(oldest.limit(DELETED_AT_ONCE)).all()
    old = list(takewhile(lambda row: row.at_us < tx.now_us - age_us, rows))
    return int(old[-1].number) if old else None


def delete_until(tx: Transaction, last: int) -> int:
    """Delete events up to the one numbered `last`, but keep audit entries; return the number of deleted events.

    The feed then begins after `last`.
    """
    of_feed = follows(tx, _last_deleted(tx)), number_of(tx) <= last
    deleted = tx.execute(delete(event).where(*of_feed, event.c.about.is_(None))).rowcount
    is_mark = server_state.c.key == _LAST_DELETED
    if tx.execute(update(server_state).where(is_mark).values(value=last)).rowcount == 0:
        tx.execute(insert(server_state).values(key=_LAST_DELETED, value=last))
    return deleted


def delete_old_audit_entries(tx: Transaction, age_us: int) -> int:
    """Delete some audit entries that are older than `age_us` and no longer in the feed; return how many."""
    number = number_of(tx)
    left_feed = follows(tx, 0), number <= _last_deleted(tx)
    last = _last_of_old(tx, select(number.label("number"), event.c.at_us).where(*left_feed).order_by(number), age_us)
    return 0 if last is None else tx.execute(delete(event).where(*left_feed, number <= last)).rowcount


_COLUMNS = (event.c.at_us, event.c.kind, event.c.subject, event.c.actor, event.c.body)


def number_of(tx: Transaction) -> ColumnElement[int]:
    """Return the column of the table `event` with the numbers of events: `number` on Postgres, `seq` on SQLite."""
    return event.c.number if tx.is_postgres else event.c.seq


def follows(tx: Transaction, after: int) -> ColumnElement[bool]:
    """Return the SQL condition for events with a number greater than `after`."""
    if tx.is_postgres:
        return event.c.number > after
    return and_(_UNNUMBERED, event.c.seq > after)  # the first condition makes the index of the feed usable


def _shown(row: Row[Any]) -> Event:
    return Event(
        seq=row.number, at=datetime_of(row.at_us), project=row.project, kind=row.kind, subject=row.subject,
        actor=row.actor, body=row.body,
    )  # fmt: skip


# -- numbers on Postgres -----------------------------------------------------------------------------------------------


def number_events(tx: Transaction) -> int:
    """Give numbers to the oldest committed events without a number; return how many events got one (0 on SQLite).

    Other transactions that number events wait until this one has committed.
    """
    if not tx.is_postgres or not tx.execute(select(exists().where(_UNNUMBERED))).scalar():
        return 0
    of_counter = server_state.c.key == LAST_NUMBER
    last = int(tx.execute(select(server_state.c.value).where(of_counter).with_for_update()).scalar_one())
    oldest = (
        select(event.c.seq, func.row_number().over(order_by=event.c.seq).label("place"))
        .where(_UNNUMBERED)
        .order_by(event.c.seq)
        .limit(NUMBERED_AT_ONCE)
        .subquery()
    )
    numbered = tx.execute(
        update(event).where(event.c.seq == oldest.c.seq).values(number=cast(last + oldest.c.place, BigInteger))
    ).rowcount
    tx.execute(update(server_state).where(of_counter).values(value=last + numbered))
    tx.execute(text(f"NOTIFY {CHANNEL}"))
    return numbered


# -- what a server announces -------------------------------------------------------------------------------------------


class News(NamedTuple):
    """Topics of the waiting requests that new events wake, and the number of the last event that was read."""

    topics: frozenset[str]
    last: int
    complete: bool
    """Whether all events were read; if false, at least `MAX_EVENTS` were found, and more may follow."""


def newest_number(tx: Transaction) -> int:
    """Return the number of the newest event in the feed, 0 if there is none."""
    return int(tx.execute(select(func.max(number_of(tx)))).scalar() or 0)


def read_news(tx: Transaction, after: int) -> News:
    """Read the events after the one numbered `after`; return the topics of the requests that these events wake."""
    number = number_of(tx)
    rows = tx.execute(
        select(number.label("number"), event.c.project_id, event.c.subject)
        .add_columns(job.c.kind, job.c.state, job.c.run_at_us, job.c.finished_us, job.c.concurrency_key)
        .select_from(event.outerjoin(job, job.c.id == event.c.subject))
        .where(follows(tx, after))
        .order_by(number)
        .limit(MAX_EVENTS)
    ).all()
    topics = {events_topic(row.project_id) for row in rows if row.project_id is not None}
    topics |= {job_topic(row.subject) for row in rows if row.finished_us is not None}
    topics |= {work_topic(row.kind) for row in rows if row.state == "queued" and row.run_at_us <= tx.now_us}
    keys = {(row.project_id, row.concurrency_key) for row in rows if row.finished_us and row.concurrency_key}
    topics |= {work_topic(kind) for kind in _waiting_for_key(tx, keys)}
    left = {row.project_id for row in rows if row.state not in (None, "running")}
    topics |= {work_topic(kind) for kind in _waiting_for_place(tx, left)}
    return News(frozenset(topics), rows[-1].number if rows else after, len(rows) < MAX_EVENTS)


def _waiting_for_key(tx: Transaction, keys: Iterable[tuple[str, str]]) -> set[str]:
    """Return the kinds of the queued jobs that have one of the given pairs of project id and concurrency key."""
    return {
        kind
        for project_id, key in keys
        for kind in tx.execute(
            select(job.c.kind)
            .where(job.c.state == QUEUED, job.c.project_id == project_id, job.c.concurrency_key == key)
            .distinct()
        ).scalars()
    }


_MOST_READ = 100
"""Greatest number of a project's queued jobs that are examined to find which workers to wake."""


def _waiting_for_place(tx: Transaction, projects: Collection[str]) -> set[str]:
    """Return the kinds of the first queued jobs of those projects that have a limit on running jobs.

    After another job of such a project has stopped running, one of these jobs may start.
    """
    limited = select(queue_share.c.project_id).where(queue_share.c.most_running.is_not(None))
    found: set[str] = set()
    for some in in_lists(projects):
        for project_id in tx.execute(limited.where(queue_share.c.project_id.in_(some))).scalars().all():
            first = select(job.c.kind).where(job.c.project_id == project_id, job.c.state == QUEUED)
            first = first.order_by(*claim_order(job)).limit(_MOST_READ)
            found |= set(tx.execute(first).scalars())
    return found


def kinds_due(tx: Transaction, since_us: int) -> tuple[set[str], int]:
    """Return the kinds of the queued jobs whose wait ended after `since_us`, and the present time in microseconds."""
    due = (job.c.state == QUEUED, job.c.run_at_us > since_us, job.c.run_at_us <= tx.now_us)
    return set(tx.execute(select(job.c.kind).where(*due).distinct()).scalars()), tx.now_us


# -- names of purged items ---------------------------------------------------------------------------------------------


def forget_names(tx: Transaction, ids: Sequence[str], *members: str) -> None:
    """Remove the JSON members `members`, which contain names, from the bodies of events about items or folders.

    The audit log shows the id in place of the name.
    """
    body: ColumnElement[Any] = func.json_remove(event.c.body, *(f"$.{name}" for name in members))
    if tx.is_postgres:
        body = event.c.body.op("-", return_type=event.c.body.type)(cast(array(members), ARRAY(Text)))
    for some in in_lists(ids):
        about = event.c.subject.in_(some)
        tx.execute(update(event).where(about).values(body=body))
        tx.execute(update(event).where(about, event.c.about.is_not(None)).values(about=event.c.subject))


def forget_clips(tx: Transaction, project_id: str, items: frozenset[str]) -> None:
    """Remove the paths of items from the project's records of exports without consent.

    The audit log names a record after its first clip. If this clip is among `items`, its id replaces the name.
    """
    recorded = event.c.about.is_not(None), event.c.project_id == project_id, event.c.kind == "consent.overridden"
    for row in tx.execute(select(event.c.seq, event.c.body).where(*recorded)).all():
        if all(one["item"] not in items for one in row.body["clips"]):
            continue
        clips = [{**one, "path": ""} if one["item"] in items else one for one in row.body["clips"]]
        values: dict[str, Any] = {"body": {**row.body, "clips": clips}}
        if clips[0]["item"] in items:
            values["about"] = clips[0]["item"]
        tx.execute(update(event).where(event.c.seq == row.seq).values(**values))
