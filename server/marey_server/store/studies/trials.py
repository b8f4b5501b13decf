"""Trials of participants, by the clock of the server.

A trial is one row from its opening. Each request is one transaction that locks the participant first, so that repeated
and simultaneous requests run one after another, and a crash between two requests loses nothing.
"""

from __future__ import annotations

import random
from typing import Any

from sqlalchemy import Row, insert, select, update

from marey_schemas.documents.studies import StudyDocument
from marey_schemas.studies.participation import OpenTrial, TrialAnswer, TrialOutcome, TrialStep
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store.studies.designs import load_design
from marey_server.store.studies.participants import find_caller
from marey_server.store.tables import study_participant, study_trial
from marey_server.store.transaction import Transaction

GRACE_US = 2_000_000
"""Time in microseconds after the deadline of a trial in which an answer still counts; it may have been sent in time."""
MOST_TIMEOUTS = 500
"""Greatest number of trials that a participant may leave without an answer."""


def open_trial(tx: Transaction) -> TrialStep:
    """Return the open trial of the caller, or open the next trial; after the last trial, the result contains none.

    If the time of the open trial is over, the trial is recorded as timed out, and a trial with a new random set of
    motions replaces it. Raises `ConflictProblem` if too many trials timed out.
    """
    row = find_caller(tx, lock=True)
    design = load_design(tx, row.item_id, row.revision)
    last = _last(tx, row.id)
    if last is not None and last.ended_us is None:
        if tx.now_us < last.deadline_us:
            return _step(row, design, _shown(tx, last.number, last.shown, last.deadline_us))
        row = _time_out(tx, row, last)
    if row.answered == design.trials:
        return _step(row, design, None)
    if row.timeouts >= MOST_TIMEOUTS:
        raise ConflictProblem(
            f"{MOST_TIMEOUTS} trials passed without an answer, so this session is over.", code="too-many-timeouts"
        )
    return _step(row, design, _open(tx, row, design, last))


def _open(tx: Transaction, row: Row[Any], design: StudyDocument, last: Row[Any] | None) -> OpenTrial:
    after_timeout = last is not None and last.chosen is None
    number = 1 if last is None else last.number + 1
    shown = _random_set(design, row.number, number) if after_timeout else row.plan[row.answered]
    deadline_us = tx.now_us + round(design.seconds * 1_000_000)
    opened = {
        "participant_id": row.id, "number": number, "shown": shown, "answered_before": row.answered,
        "timeouts_before": last.timeouts_before + 1 if last is not None and after_timeout else 0,
        "started_us": tx.now_us, "deadline_us": deadline_us,
    }  # fmt: skip
    tx.execute(insert(study_trial).values(**opened))
    return _shown(tx, number, shown, deadline_us)


def _random_set(design: StudyDocument, participant: int, number: int) -> list[int]:
    """Return the indices of the motions of a trial that replaces a timed-out trial.

    The same arguments always give the same motions.
    """
    draw = random.Random(f"{design.seed} {participant} {number}")  # noqa: S311 - no secret
    return draw.sample(range(len(design.motions)), design.shown)


def answer_trial(tx: Transaction, number: int, answer: TrialAnswer) -> TrialOutcome:
    """Record the answer to a trial, and return what is recorded.

    Only the first answer counts; later ones get the recorded outcome. If the time is over, the trial is recorded as
    timed out. Raises `NotFoundProblem` if the caller was not shown such a trial.
    """
    row = find_caller(tx, lock=True)
    design = load_design(tx, row.item_id, row.revision)
    which = (study_trial.c.participant_id == row.id, study_trial.c.number == number)
    trial = tx.execute(select(study_trial).where(*which)).first()
    if trial is None:
        raise NotFoundProblem(f"No trial {number} was shown to you.", code="no-trial")
    chosen = trial.chosen
    if trial.ended_us is None and tx.now_us > trial.deadline_us + GRACE_US:
        row = _time_out(tx, row, trial)
    elif trial.ended_us is None:
        chosen = sorted(answer.chosen)
        ended = {"ended_us": tx.now_us, "chosen": chosen, "client_fps": answer.client_fps}
        tx.execute(update(study_trial).where(*which).values(**ended))
        row = _count(tx, row.id, answered=row.answered + 1)
    return TrialOutcome(
        number=number, outcome="timed_out" if chosen is None else "answered", chosen=chosen, answered=row.answered,
        remaining=design.trials - row.answered, finished=row.answered == design.trials,
    )  # fmt: skip


def _time_out(tx: Transaction, row: Row[Any], trial: Row[Any]) -> Row[Any]:
    """Record that a participant did not answer a trial in time; return the participant's changed row."""
    which = (study_trial.c.participant_id == row.id, study_trial.c.number == trial.number)
    tx.execute(update(study_trial).where(*which).values(ended_us=tx.now_us))
    return _count(tx, row.id, timeouts=row.timeouts + 1)


def _count(tx: Transaction, participant_id: str, **values: int) -> Row[Any]:
    changed = update(study_participant).where(study_participant.c.id == participant_id).values(**values)
    return tx.execute(changed.returning(study_participant)).one()


def _last(tx: Transaction, participant_id: str) -> Row[Any] | None:
    of_participant = select(study_trial).where(study_trial.c.participant_id == participant_id)
    return tx.execute(of_participant.order_by(study_trial.c.number.desc()).limit(1)).first()


def _shown(tx: Transaction, number: int, shown: list[int], deadline_us: int) -> OpenTrial:
    return OpenTrial(number=number, clips=tuple(shown), seconds_left=(deadline_us - tx.now_us) / 1e6)


def _step(row: Row[Any], design: StudyDocument, trial: OpenTrial | None) -> TrialStep:
    remaining = design.trials - row.answered
    return TrialStep(finished=remaining == 0, answered=row.answered, remaining=remaining, trial=trial)
