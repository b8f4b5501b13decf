"""Judgements of a study's participants under pseudonyms, for those who carry it out and for the analysis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, select

from marey_schemas.access import Role
from marey_schemas.items import Page
from marey_schemas.kinds import Kind
from marey_schemas.studies.conducting import JudgedTrial, JudgingParticipant
from marey_server.access.roles import at_least
from marey_server.errors import ForbiddenProblem, NotFoundProblem
from marey_server.store import listing
from marey_server.store.jobs import reach
from marey_server.store.jobs.fencing import require_attempt
from marey_server.store.studies.conducting import pseudonym
from marey_server.store.studies.designs import load_design, require_study
from marey_server.store.tables import item, job, member, study_participant, study_trial, user
from marey_server.store.transaction import Transaction


def list_judgements(
    tx: Transaction, project: str, kind: Kind, item_id: str, *, revision: int, cursor: str | None, limit: int
) -> Page:
    """Return a page of participants who have begun a revision of a study, each with all ended trials, without dates.

    Raises `NotFoundProblem` if there is no such study, and `ForbiddenProblem` if the caller's role is too low.
    """
    _, row = require_study(tx, project, kind, item_id)
    return _page(tx, row.id, revision, cursor, limit)


def list_for_attempt(
    tx: Transaction, job_id: str, fence: int, item_id: str, *, revision: int, cursor: str | None, limit: int
) -> Page:
    """Return the same page as `list_judgements`, to an attempt of a job.

    Raises `NotFoundProblem` unless the revision of the study is an input of the job, and `ForbiddenProblem` unless the
    author of the job is a maintainer of the project.
    """
    require_attempt(tx.principal, job_id, fence)
    is_study = select(item.c.id).where(item.c.id == item_id, item.c.kind == Kind.STUDY)
    if (item_id, revision) not in reach.pinned_places(tx) or tx.execute(is_study).first() is None:
        raise NotFoundProblem("The study, at this revision, is not an input of the job.", code="no-item")
    _require_maintainer(tx, job_id)
    return _page(tx, item_id, revision, cursor, limit)


@dataclass(frozen=True, slots=True)
class CollectedAnswers:
    """Answers to the trials of one revision of a study; they contain nothing else about the participants."""

    revision: int
    motion_count: int
    answers: list[tuple[int, list[int], tuple[int, int]]]
    """For each trial: the number of the participant, from 0; the indices of the shown motions; the two chosen places.

    A place is an index into the list of the shown motions.
    """


def collect_answers(tx: Transaction, project: str, kind: Kind, item_id: str, *, revision: int) -> CollectedAnswers:
    """Return all answered trials of a revision of a study.

    Raises `NotFoundProblem` if there is no such revision, and `ForbiddenProblem` if the caller's role is too low.
    """
    _, row = require_study(tx, project, kind, item_id)
    design = load_design(tx, row.id, revision)
    answered = (
        select(study_participant.c.number, study_trial.c.shown, study_trial.c.chosen)
        .join(study_trial, study_trial.c.participant_id == study_participant.c.id)
        .where(study_participant.c.item_id == row.id, study_participant.c.revision == revision)
        .where(study_participant.c.answered > 0, study_trial.c.ended_us.is_not(None))
        .order_by(study_participant.c.number, study_trial.c.number)
    )
    rows = [one for one in tx.execute(answered) if one.chosen is not None]
    places = {number: place for place, number in enumerate(dict.fromkeys(one.number for one in rows))}
    answers = [(places[one.number], list(one.shown), (one.chosen[0], one.chosen[1])) for one in rows]
    return CollectedAnswers(revision, len(design.motions), answers)


def _page(tx: Transaction, item_id: str, revision: int, cursor: str | None, limit: int) -> Page:
    seed = load_design(tx, item_id, revision).seed
    order = listing.parse_order("number", {"number": study_participant.c.number, "id": study_participant.c.id})
    began = (study_participant.c.withdrawn_us.is_(None), study_participant.c.token_hash.is_not(None))
    of_revision = (study_participant.c.item_id == item_id, study_participant.c.revision == revision)
    statement = select(study_participant).where(*of_revision, *began)
    rows, following = listing.read_page(tx, statement, order, ["judgements", item_id, revision], cursor, limit)
    trials: dict[str, list[JudgedTrial]] = {one.id: [] for one in rows}
    ended = select(study_trial).where(
        study_trial.c.participant_id.in_(list(trials)), study_trial.c.ended_us.is_not(None)
    )
    for trial in tx.execute(ended.order_by(study_trial.c.participant_id, study_trial.c.number)):
        trials[trial.participant_id].append(_shown(trial, seed))
    people = (
        JudgingParticipant(
            participant=pseudonym(one.number), finished=one.answered == len(one.plan), trials=tuple(trials[one.id])
        )
        for one in rows
    )
    return Page(items=tuple(people), next_cursor=following)


def _shown(trial: Row[Any], seed: int) -> JudgedTrial:
    answered = trial.chosen is not None
    return JudgedTrial(
        index=trial.answered_before, number=trial.number, shown=tuple(trial.shown),
        chosen=tuple(trial.chosen) if answered else None,
        latency_s=(trial.ended_us - trial.started_us) / 1e6 if answered else None,
        timeouts_before=trial.timeouts_before, seed=seed, client_fps=trial.client_fps,
    )  # fmt: skip


def _require_maintainer(tx: Transaction, job_id: str) -> None:
    """Raise `ForbiddenProblem` unless the author of a job is a maintainer of its project now."""
    role = (
        select(user.c.administrator, member.c.role)
        .select_from(job)
        .join(user, user.c.id == job.c.author_id)
        .outerjoin(member, (member.c.user_id == user.c.id) & (member.c.project_id == job.c.project_id))
        .where(job.c.id == job_id)
    )
    author = tx.execute(role).one_or_none()
    if author is None or not (author.administrator or author.role in at_least(Role.MAINTAINER)):
        raise ForbiddenProblem(
            "Only maintainers of the project may analyse a study: the analysis reads what participants answered.",
            code="insufficient-role",
        )
