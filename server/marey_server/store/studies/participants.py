"""Participants of studies: their links and tokens, their consent, their progress, and their withdrawal.

A participant is one row. It exists from the creation of the link, and it remains after a withdrawal, so that nobody can
use the link again. A withdrawal deletes the consent and the trials of the participant. The database contains only
hashes of codes and tokens.
"""

from __future__ import annotations

from typing import Any, Literal

from sqlalchemy import Row, Select, delete, select, update

from marey_schemas.documents.studies import StudyDocument
from marey_schemas.studies.participation import (
    NewParticipation,
    Participation,
    ParticipationCreate,
    StudyWelcome,
)
from marey_server.access.principal import Principal
from marey_server.access.secret_tokens import (
    derive_participant_token,
    hash_secret,
    issue_prefix,
    secret_matches,
    split_participant_token,
    split_study_link,
)
from marey_server.errors import GoneProblem, NotFoundProblem, UnauthenticatedProblem
from marey_server.store.credentials import sign_ins
from marey_server.store.credentials.sign_ins import SignInTry
from marey_server.store.studies.designs import load_design
from marey_server.store.tables import item, project, study_participant, study_trial
from marey_server.store.transaction import Transaction

_NO_HASH = hash_secret("")  # of no code, because secrets are not empty


def _rows() -> Select[*tuple[Any, ...]]:
    """Return a query for participants, each with the name and the project of the study, and `study_exists`."""
    alive = item.c.deleted_us.is_(None) & project.c.deleted_us.is_(None)
    return (
        select(study_participant, item.c.name, item.c.project_id, alive.label("study_exists"))
        .join(item, item.c.id == study_participant.c.item_id)
        .join(project, project.c.id == item.c.project_id)
    )


def resolve_participant(tx: Transaction, text: str) -> Principal | None:
    """Return the principal of a participant's token; None if the text is no such token, or if it is not valid."""
    prefix, secret = split_participant_token(text) or ("", "")
    row = tx.execute(_rows().where(study_participant.c.token_prefix == prefix)).first()
    if not secret_matches(secret, _NO_HASH if row is None else row.token_hash) or row is None:
        return None
    return Principal("participant", project_id=row.project_id, participant_id=row.id)


# -- links ------------------------------------------------------------------------------------------------------------


def link_invalid() -> NotFoundProblem:
    """Return the error for a link that is not valid; its text does not show why."""
    return NotFoundProblem(
        "This link is not valid: it is unknown or incomplete, it was used in another browser, it has expired, or the "
        "study has ended. Check that you copied the whole link, or ask for a new one.",
        code="study-link-invalid",
    )


def try_of(code: str, address: str, per_minute: int) -> SignInTry:
    """Return the sign-in try for the code of a link; the caller must count the try before checking the code."""
    prefix, _ = split_study_link(code) or ("", "")
    return SignInTry(f"study {prefix}", address, per_minute)


def _find_link(tx: Transaction, code: str) -> Row[Any]:
    """Lock and return the row of the participant who has a link and may have begun the study already.

    Raises `NotFoundProblem` if the link is wrong or has expired before it was used, if the participant has withdrawn,
    or if the study was deleted.
    """
    prefix, secret = split_study_link(code) or ("", "")
    locked = _rows().where(study_participant.c.link_prefix == prefix).with_for_update(of=study_participant)
    row = tx.execute(locked).first()
    if not secret_matches(secret, _NO_HASH if row is None else row.link_hash) or row is None:
        raise link_invalid()
    unused = row.token_hash is None
    if not row.study_exists or row.withdrawn_us is not None or (unused and row.expires_us <= tx.now_us):
        raise link_invalid()
    return row


def welcome(tx: Transaction, code: str, attempt: SignInTry) -> StudyWelcome:
    """Return what a person with a link sees before consenting. Raises `NotFoundProblem` if the link is not valid.

    `attempt` is the try that the caller has counted (`try_of`); if the link is valid, it does not count any more.
    """
    row = _find_link(tx, code)
    sign_ins.uncount(tx, attempt)
    design = load_design(tx, row.item_id, row.revision)
    return StudyWelcome(
        title=design.title, consent_text=design.consent_text, clips=len(design.motions), trials=design.trials,
        shown=design.shown, seconds=design.seconds,
    )  # fmt: skip


def begin(tx: Transaction, request: ParticipationCreate, attempt: SignInTry) -> NewParticipation:
    """Record the consent of a participant, and return the participant's token.

    A repeated request with the same key gets the same token. `attempt` is the try that the caller has counted
    (`try_of`); if the request succeeds, it does not count any more. Raises `NotFoundProblem` if the link is not valid,
    or if it was used with another key.
    """
    code, key = request.code.get_secret_value(), request.key.get_secret_value()
    row = _find_link(tx, code)
    _, secret = split_study_link(code) or ("", "")
    issued = derive_participant_token(secret, key, row.token_prefix or issue_prefix())
    if row.token_hash is None:
        begun = {"token_prefix": issued.prefix, "token_hash": issued.secret_hash, "started_us": tx.now_us}
        tx.execute(update(study_participant).where(study_participant.c.id == row.id).values(**begun))
    elif issued.secret_hash != row.token_hash:
        raise link_invalid()
    sign_ins.uncount(tx, attempt)
    return NewParticipation(token=issued.text, participation=_shown(row, load_design(tx, row.item_id, row.revision)))


# -- the participant of a request -------------------------------------------------------------------------------------


def find_caller(tx: Transaction, *, lock: bool = False) -> Row[Any]:
    """Return the participant who sends the request; with `lock`, no other request changes this row meanwhile.

    Raises `GoneProblem` if the participant has withdrawn, or if the study was deleted.
    """
    row = _caller(tx, lock=lock)
    if row.withdrawn_us is not None:
        raise GoneProblem("This participation has ended, and its answers were deleted.", code="participation-withdrawn")
    if not row.study_exists:
        raise GoneProblem("The study was deleted.", code="study-gone")
    return row


def _caller(tx: Transaction, *, lock: bool) -> Row[Any]:
    statement = _rows().where(study_participant.c.id == tx.principal.participant_id)
    row = tx.execute(statement.with_for_update(of=study_participant) if lock else statement).first()
    if row is None:  # it was purged meanwhile
        raise UnauthenticatedProblem("The token is unknown, expired or revoked.", code="bad-token")
    return row


def read_participation(tx: Transaction) -> Participation:
    """Return the progress of the participant who sends the request."""
    row = find_caller(tx)
    return _shown(row, load_design(tx, row.item_id, row.revision))


def _shown(row: Row[Any], design: StudyDocument) -> Participation:
    remaining = design.trials - row.answered
    return Participation(
        title=design.title, clips=len(design.motions), trials=design.trials, answered=row.answered,
        remaining=remaining, shown=design.shown, seconds=design.seconds, finished=remaining == 0,
    )  # fmt: skip


# -- withdrawal -------------------------------------------------------------------------------------------------------


def withdraw_caller(tx: Transaction) -> None:
    """Delete consent and trials of the participant who sends the request; a repetition changes nothing."""
    row = _caller(tx, lock=True)
    if row.withdrawn_us is None:
        withdraw(tx, row, by="participant")


def withdraw(tx: Transaction, row: Row[Any], *, by: Literal["participant", "conductor"]) -> None:
    """Delete the consent and the trials of a participant, whose row the caller has locked."""
    forget_trials(tx, study_participant.c.id == row.id)
    ended = {"withdrawn_us": tx.now_us, "started_us": None, "answered": 0, "timeouts": 0}
    tx.execute(update(study_participant).where(study_participant.c.id == row.id).values(**ended))
    tx.audit("study.withdrawn", row.item_id, about=row.name, project_id=row.project_id, by=by)


def forget_trials(tx: Transaction, which: Any) -> None:
    """Delete the trials of the participants who meet a condition."""
    chosen = select(study_participant.c.id).where(which)
    tx.execute(delete(study_trial).where(study_trial.c.participant_id.in_(chosen)))


def forget_studies(tx: Transaction, item_ids: list[str]) -> None:
    """Delete all participants of studies that are purged, with their trials."""
    which = study_participant.c.item_id.in_(item_ids)
    forget_trials(tx, which)
    tx.execute(delete(study_participant).where(which))
