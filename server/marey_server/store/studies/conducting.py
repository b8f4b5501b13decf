"""Links of a study, its participants, and its progress, for those who carry it out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Row, and_, case, func, insert, select

from marey_schemas.documents.studies import StudyDocument
from marey_schemas.items import Page
from marey_schemas.kinds import Kind
from marey_schemas.studies.conducting import (
    NewStudyLink,
    NewStudyLinks,
    ParticipantState,
    StudyLinksCreate,
    StudyParticipant,
    StudyProgress,
)
from marey_server.access.secret_tokens import issue_study_link
from marey_server.errors import ConflictProblem, NotFoundProblem, QuotaExceededProblem
from marey_server.store import listing
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.items.consents import find_ended_consents, require_consent
from marey_server.store.studies.designs import load_design, require_study
from marey_server.store.studies.participants import withdraw
from marey_server.store.tables import item, study_participant
from marey_server.store.transaction import Transaction

Plan = list[list[int]]
"""Trials of a participant: for each trial, the indices of its motions in the design of the study."""


@dataclass(frozen=True, slots=True)
class PlannedDraw:
    """Values from which trials for new participants are drawn: the design, and the trials of earlier participants."""

    revision: int
    design: StudyDocument
    earlier: list[Plan]


def pseudonym(number: int) -> str:
    """Return the pseudonym of a participant."""
    return f"p{number}"


def plan_links(tx: Transaction, project: str, kind: Kind, item_id: str, request: StudyLinksCreate) -> PlannedDraw:
    """Return the values from which trials for new links are drawn; the draw itself runs outside of transactions.

    Raises `NotFoundProblem` if there is no such study, `QuotaExceededProblem` if the project has too many participants,
    and `ConflictProblem` if the consent for a motion has ended.
    """
    project_row, row = require_study(tx, project, kind, item_id)
    _require_room(tx, project_row.id, request.count)
    design = load_design(tx, row.id, row.head)
    _require_consent(tx, design)
    plans = select(study_participant.c.plan).where(*_of_revision(row.id, row.head))
    earlier = list(tx.execute(plans.order_by(study_participant.c.number)).scalars())
    return PlannedDraw(row.head, design, earlier)


def create_links(
    tx: Transaction,
    project: str,
    kind: Kind,
    item_id: str,
    request: StudyLinksCreate,
    planned: PlannedDraw,
    plans: Sequence[Plan],
) -> NewStudyLinks:
    """Create one link for each drawn plan; the codes of the links are stored only as hashes.

    Raises `ConflictProblem` if the study or its participants have changed since the draw was planned.
    """
    project_row, row = require_study(tx, project, kind, item_id)
    tx.lock(f"study participants {project_row.id}")
    _require_room(tx, project_row.id, request.count)
    _require_consent(tx, planned.design)
    count = select(func.count()).select_from(study_participant).where(*_of_revision(row.id, planned.revision))
    first = int(tx.execute(count).scalar_one()) + 1
    if row.head != planned.revision or first != len(planned.earlier) + 1:
        raise ConflictProblem(
            "Somebody changed this study or created links for it at the same time; repeat the request.",
            code="study-changed",
        )
    expires_us = tx.now_us + request.expires_in_s * 1_000_000
    links = []
    for number, plan in enumerate(plans, first):
        issued = issue_study_link()
        values = {
            "id": new_id("participant"), "item_id": row.id, "revision": planned.revision, "number": number,
            "link_prefix": issued.prefix, "link_hash": issued.secret_hash, "plan": plan,
            "created_us": tx.now_us, "expires_us": expires_us,
        }  # fmt: skip
        tx.execute(insert(study_participant).values(**values))
        links.append(NewStudyLink(participant=pseudonym(number), code=issued.text))
    tx.audit("study.invited", row.id, about=row.name, project_id=project_row.id, count=len(links))
    return NewStudyLinks(revision=planned.revision, expires_at=datetime_of(expires_us), links=tuple(links))


def _require_consent(tx: Transaction, design: StudyDocument) -> None:
    """Raise `ConflictProblem` if the consent of a performer has ended, because participants would see the motion."""
    ended = find_ended_consents(tx, (one.revision.item for one in design.motions))
    require_consent(list(ended.values()))


def _of_revision(item_id: str, revision: int) -> tuple[ColumnElement[bool], ...]:
    return study_participant.c.item_id == item_id, study_participant.c.revision == revision


def _require_room(tx: Transaction, project_id: str, more: int) -> None:
    limit = tx.quotas.project_participants
    joined = study_participant.join(item, item.c.id == study_participant.c.item_id)
    counted = select(func.count()).select_from(joined).where(item.c.project_id == project_id)
    used = int(tx.execute(counted).scalar_one())
    if used + more > limit:
        raise QuotaExceededProblem(
            f"The studies of the project have {used:,} participants, the limit is {limit:,}, and this needs {more:,} "
            "more. Purge a study that is not needed, or ask the operator to raise the setting `project_participants`.",
            context={"quota": "project_participants", "used": used, "limit": limit},
        )


# -- participants -----------------------------------------------------------------------------------------------------


def list_participants(
    tx: Transaction, project: str, kind: Kind, item_id: str, *, cursor: str | None, limit: int
) -> Page:
    """Return a page of the participants of a study under their pseudonyms, in the order of their links."""
    _, row = require_study(tx, project, kind, item_id)
    order = listing.parse_order("number", {"number": study_participant.c.number, "id": study_participant.c.id})
    statement = select(study_participant).where(study_participant.c.item_id == row.id)
    rows, following = listing.read_page(tx, statement, order, ["participants", row.id], cursor, limit)
    return Page(items=tuple(_shown(one) for one in rows), next_cursor=following)


def _shown(row: Row[Any]) -> StudyParticipant:
    unused = row.token_hash is None and row.withdrawn_us is None
    return StudyParticipant(
        id=row.id, participant=pseudonym(row.number), revision=row.revision, state=_state(row),
        answered=row.answered, timeouts=row.timeouts,
        expires_at=datetime_of(row.expires_us) if unused else None,
    )  # fmt: skip


def _state(row: Row[Any]) -> ParticipantState:
    if row.withdrawn_us is not None:
        return "withdrawn"
    if row.token_hash is None:
        return "invited"
    return "finished" if row.answered == len(row.plan) else "started"


def withdraw_participant(tx: Transaction, project: str, kind: Kind, item_id: str, participant: str) -> None:
    """Delete consent and trials of a participant, named by id, who then counts as withdrawn; the link ends.

    Raises `NotFoundProblem` if the study has no such participant. A repetition changes nothing.
    """
    project_row, row = require_study(tx, project, kind, item_id)
    named = select(study_participant, item.c.name, item.c.project_id).join(
        item, and_(item.c.id == study_participant.c.item_id, item.c.project_id == project_row.id)
    )
    which = study_participant.c.id == participant, study_participant.c.item_id == row.id
    found = tx.execute(named.where(*which).with_for_update(of=study_participant)).first()
    if found is None:
        raise NotFoundProblem(
            f"The study has no participant {participant!r}; the list of participants shows their ids.",
            code="no-participant",
        )
    if found.withdrawn_us is None:
        withdraw(tx, found, by="conductor")


def read_progress(tx: Transaction, project: str, kind: Kind, item_id: str) -> StudyProgress:
    """Return the numbers of participants and trials of a study by state, without data of single participants."""
    _, row = require_study(tx, project, kind, item_id)
    t = study_participant.c
    alive, begun = t.withdrawn_us.is_(None), t.token_hash.is_not(None)
    counted = {
        "invited": and_(alive, ~begun, t.expires_us > tx.now_us),
        "started": and_(alive, begun),
        "withdrawn": t.withdrawn_us.is_not(None),
    }
    sums = [func.coalesce(func.sum(case((which, 1), else_=0)), 0).label(name) for name, which in counted.items()]
    sums += [func.coalesce(func.sum(t[name]), 0).label(name) for name in ("answered", "timeouts")]
    found = tx.execute(select(*sums).where(t.item_id == row.id)).one()
    finished = _count_finished(tx, row.id)
    return StudyProgress(
        invited=found.invited, started=found.started, finished=finished, withdrawn=found.withdrawn,
        answered=found.answered, timeouts=found.timeouts,
    )  # fmt: skip


def _count_finished(tx: Transaction, item_id: str) -> int:
    """Return the number of participants who have answered all trials of the revision that they see."""
    t = study_participant.c
    numbers = select(t.revision, t.answered, func.count().label("people")).where(
        t.item_id == item_id, t.withdrawn_us.is_(None), t.answered > 0
    )
    rows = tx.execute(numbers.group_by(t.revision, t.answered)).all()
    trials = {revision: load_design(tx, item_id, revision).trials for revision in {row.revision for row in rows}}
    return sum(row.people for row in rows if row.answered == trials[row.revision])
