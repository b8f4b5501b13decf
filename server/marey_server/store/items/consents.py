"""Consent of performers: finds clips whose consent has ended, and records permissions to export such clips.

The take record of a clip (the facts about its recording) contains the last day of the consent. The take record of the
newest revision applies to every revision of the clip, because a consent concerns the recording. An aligned clip has no
take record of its own; the take record of its source clip applies.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

from sqlalchemy import Select, and_, bindparam, case, select

from marey_schemas.access import Role
from marey_schemas.consents import CONSENT_EXPIRED, CONSENT_REMEDY, ConsentOverride
from marey_schemas.kinds import Kind
from marey_schemas.wording import counted
from marey_server.errors import ConflictProblem
from marey_server.store import projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.items.reading import find_item
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import collection, item, revision
from marey_server.store.transaction import Transaction, in_lists

MOST_NAMED = 10
"""Greatest number of clips that an error or an event names; both also contain the number of all clips."""


class EndedConsent(NamedTuple):
    """Item for which the consent of the performer has ended."""

    item: str
    path: str
    """Path of the clip whose take record states the consent: the item itself, or the clip that it was made from."""
    until: str
    """Last day of the consent."""


def find_ended_consents(tx: Transaction, item_ids: Iterable[str]) -> dict[str, EndedConsent]:
    """Return, by id, the items whose consent has ended, that is, whose last day of consent is before today (UTC)."""
    wanted = sorted(set(item_ids))
    found: dict[str, EndedConsent] = {}
    for some in in_lists(wanted):
        rows = tx.execute(_ENDED_AMONG, {"today": _today(tx), "ids": some})
        found.update((row.id, _shown(row)) for row in rows)
    return found


def find_ended_with(tx: Transaction, project_id: str, contents: Sequence[str]) -> list[EndedConsent]:
    """Return those items of a project that have a revision with a wanted content, and whose consent has ended.

    `contents` are the content digests of the wanted revisions.
    """
    holders = select(revision.c.item_id).where(revision.c.content.in_(contents))
    wanted = _ENDED.where(item.c.project_id == project_id, item.c.id.in_(holders)).order_by(item.c.id)
    rows = tx.execute(wanted, {"today": _today(tx)})
    return [_shown(row) for row in rows]


def _today(tx: Transaction) -> str:
    return datetime_of(tx.now_us).date().isoformat()


def _ended() -> Select[*tuple[Any, ...]]:
    recorded, place = item.alias("recorded"), collection.alias("place")
    holder = case((item.c.kind == Kind.PROCESSED.value, item.c.summary["clip"].as_string()), else_=item.c.id)
    until = recorded.c.summary["consent_until"].as_string()
    same_project = recorded.c.project_id == item.c.project_id  # a document may name any clip as its source
    return (
        select(item.c.id, place.c.path.label("folder"), recorded.c.name, until.label("until"))
        .join(recorded, and_(recorded.c.id == holder, same_project))
        .join(place, place.c.id == recorded.c.collection_id)
        .where(
            item.c.kind.in_((Kind.CLIP.value, Kind.PROCESSED.value)),
            recorded.c.kind == Kind.CLIP.value,
            until < bindparam("today"),
        )
    )


_ENDED = _ended()
# Constructed once: constructing it took most of the time of a claim of jobs that export clips.
_ENDED_AMONG = _ENDED.where(item.c.id.in_(bindparam("ids", expanding=True)))


def _shown(row: Any) -> EndedConsent:
    return EndedConsent(row.id, f"{row.folder}/{row.name}".lstrip("/"), row.until)


# -- refusing and allowing ---------------------------------------------------------------------------------------------


def require_consent(ended: Collection[EndedConsent]) -> None:
    """Raise `ConflictProblem` if `ended` is not empty: the consent for these clips has ended.

    The text of the error names the first clip and the number of the others, and says how their export can be allowed.
    The context of the error names the first `MOST_NAMED` clips.
    """
    if not ended:
        return
    first = next(iter(ended))
    what = f"The consent for the clip {first.path!r} ended; its last day was {first.until}"
    if len(ended) > 1:
        what += f". The consent for {counted(len(ended) - 1, 'other clip')} ended, too"
    raise ConflictProblem(
        f"{what}. {CONSENT_REMEDY}",
        code=CONSENT_EXPIRED,
        context=_named(ended),
        unnamed=f"The consent for {counted(len(ended), 'clip')} ended. {CONSENT_REMEDY}",
    )


def permit_export(tx: Transaction, project: str, kind: Kind, item_id: str, override: ConsentOverride) -> bool:
    """Record that the caller allows the export of an item, if the consent for the item has ended.

    Returns whether the consent has ended. Raises `NotFoundProblem` if the item does not exist. Raises
    `ForbiddenProblem` unless the caller is a maintainer or an owner and has the scope `write`.
    """
    project_row = projects.require(tx, project, at_least=Role.MAINTAINER)
    projects.require_scope(tx, project, "write")
    hold_off_purges(tx, project_row.id)  # because the record names clips
    find_item(tx, project_row, kind, item_id)
    ended = find_ended_consents(tx, [item_id])
    if ended:
        record_override(tx, project_row.id, item_id, override, list(ended.values()))
    return bool(ended)


def record_override(
    tx: Transaction, project_id: str, subject: str, override: ConsentOverride, ended: Collection[EndedConsent]
) -> None:
    """Record in the audit log that the caller allows the export of the clips in `ended`.

    `subject` is the id of the job that exports the clips, or of the dataset or item that is exported.
    """
    names = [one.path.rpartition("/")[2] for one in ended] or [subject]  # a job may not know its clips yet
    details = {"reason": override.consent_reason, **_named(ended)}
    tx.audit("consent.overridden", subject, about=names[0], project_id=project_id, **details)


def _named(ended: Collection[EndedConsent]) -> dict[str, Any]:
    clips = [{"item": one.item, "path": one.path, "consent_until": one.until} for one in list(ended)[:MOST_NAMED]]
    return {"clips": clips, "count": len(ended)}
