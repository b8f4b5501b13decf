"""Rotation of tokens: each token has one successor, which can be requested again; all can be revoked together."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import select
from tests.support.database_fixtures import AdjustableClock

from marey_schemas.access import NewToken, TokenCreate, TokenRotation
from marey_server import faults
from marey_server.access.principal import ANONYMOUS, SYSTEM, Principal
from marey_server.errors import (
    ApiProblem,
    ConflictProblem,
    ForbiddenProblem,
    QuotaExceededProblem,
    UnauthenticatedProblem,
)
from marey_server.store import users
from marey_server.store.credentials import tokens
from marey_server.store.credentials.rotation import rotate_token
from marey_server.store.database.connections import Database
from marey_server.store.tables import token
from marey_server.store.transaction import Quotas, Transaction

HOUR_S = 3600
FIRST, SECOND = "a" * 32, "b" * 32


@pytest.fixture
def chief(database: Database) -> Principal:
    """The administrator who creates tokens."""
    database.write(SYSTEM, users.ensure_first_administrator)
    return database.read(SYSTEM, users.administrator_principal)


def create(database: Database, who: Principal, **fields: Any) -> NewToken:
    return database.write(who, tokens.create_token, TokenCreate(name="mine", **fields))


def holder(database: Database, made: NewToken) -> Principal:
    return database.read(ANONYMOUS, tokens.resolve_token, made.secret)


def works(database: Database, *made: NewToken) -> list[bool]:
    def one(held: NewToken) -> bool:
        try:
            return holder(database, held).token_id == held.id
        except UnauthenticatedProblem:
            return False

    return [one(held) for held in made]


def rotate(database: Database, held: NewToken, rotation_id: str = FIRST, grace_s: int = HOUR_S) -> NewToken:
    request = TokenRotation(rotation_id=rotation_id, grace_s=grace_s)
    return database.write(holder(database, held), rotate_token, held.id, request)


def test_a_successor_has_the_same_rights_and_end_and_the_old_token_ends_after_the_grace(
    database: Database, chief: Principal, clock: AdjustableClock
) -> None:
    old = create(database, chief, scopes=("work!project=walk",), labels={"site": "lyon"}, expires_in_s=2 * HOUR_S)
    new = rotate(database, old)
    kept = {"name", "scopes", "labels", "expires_at", "created_by", "user", "session"}
    assert new.model_dump(include=kept) == old.model_dump(include=kept)
    assert (new.successor_of, new.id != old.id, new.secret != old.secret) == (old.id, True, True)
    assert works(database, old, new) == [True, True]
    clock.advance(HOUR_S + 1)
    assert works(database, old, new) == [False, True]
    clock.advance(HOUR_S)
    assert works(database, old, new) == [False, False]


def test_a_token_that_ends_sooner_than_the_grace_is_not_prolonged(
    database: Database, chief: Principal, clock: AdjustableClock
) -> None:
    old = create(database, chief, expires_in_s=60)
    new = rotate(database, old)
    assert new.expires_at == old.expires_at
    clock.advance(61)
    assert works(database, old, new) == [False, False]


def test_a_repeated_rotation_gets_the_same_token_and_another_one_is_refused(
    database: Database, chief: Principal, clock: AdjustableClock
) -> None:
    old = create(database, chief, expires_in_s=None)
    new = rotate(database, old)
    clock.advance(HOUR_S / 2)
    assert rotate(database, old, grace_s=7 * 86400) == new  # and a repetition prolongs nothing
    with pytest.raises(ConflictProblem, match="already rotated") as refused:
        rotate(database, old, SECOND)
    assert refused.value.error_code == "token-rotated"
    assert len(database.read(chief, tokens.list_tokens).items) == 2
    clock.advance(HOUR_S / 2 + 1)
    assert works(database, old, new) == [False, True]


@pytest.mark.parametrize("place", ["rotate.before_commit", "rotate.after_commit"])
def test_a_server_that_dies_before_it_answers_gives_the_same_successor_later(
    database: Database, chief: Principal, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    def die(name: str) -> None:
        if name == place:
            raise RuntimeError("dead")

    old = create(database, chief)
    with monkeypatch.context() as patch:
        patch.setattr(faults, "point", die)
        with pytest.raises(RuntimeError):
            rotate(database, old)
    committed = place.endswith("after_commit")
    stored = [one.id for one in database.read(chief, tokens.list_tokens).items if one.successor_of == old.id]
    assert len(stored) == committed
    new = rotate(database, old)
    assert rotate(database, old) == new
    assert stored in ([], [new.id])
    assert works(database, old, new) == [True, True]


def test_no_secret_of_a_successor_is_stored_or_follows_from_what_is_stored(
    database: Database, chief: Principal
) -> None:
    old = create(database, chief)
    new = rotate(database, old)
    stored = str(database.read(SYSTEM, lambda tx: tx.execute(select(token)).all()))
    secret = new.secret.rpartition("_")[2]
    assert secret not in stored
    assert FIRST not in stored
    other = create(database, chief)
    assert rotate(database, other).secret.rpartition("_")[2] != secret


def test_a_token_is_rotated_by_itself_alone(database: Database, chief: Principal) -> None:
    one, other = create(database, chief), create(database, chief)
    request = TokenRotation(rotation_id=FIRST)
    for who in (holder(database, other), chief, SYSTEM, Principal("attempt", job_id="j", fence=1)):
        for token_id in (one.id, "token_of_nobody"):
            with pytest.raises(ForbiddenProblem) as refused:
                database.write(who, rotate_token, token_id, request)
            assert refused.value.error_code == "another-token"
    assert works(database, one, other) == [True, True]


def test_at_most_two_tokens_of_a_chain_are_valid(database: Database, chief: Principal) -> None:
    first = create(database, chief, expires_in_s=None)
    second = rotate(database, first)
    third = rotate(database, second)
    assert third.successor_of == second.id
    assert works(database, first, second, third) == [False, True, True]


def test_a_successor_counts_once_in_the_quota_of_tokens(
    database: Database, chief: Principal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "quotas", Quotas(user_tokens=2))
    first = create(database, chief)
    caller = holder(database, first)
    new = rotate(database, first)
    create(database, holder(database, new))
    for who in (caller, holder(database, new)):
        with pytest.raises(QuotaExceededProblem, match="2 valid tokens"):
            create(database, who)
    rotate(database, new)


@pytest.mark.parametrize("leaked", ["first", "second", "third"])
def test_a_leaked_token_is_revoked_with_its_whole_chain_and_all_that_was_created(
    database: Database, chief: Principal, leaked: str
) -> None:
    beside = create(database, chief)
    chain = {"first": create(database, chief)}
    children = [create(database, holder(database, chain["first"]))]
    chain["second"] = rotate(database, chain["first"])
    children += [create(database, holder(database, chain[name])) for name in ("first", "second")]
    chain["third"] = rotate(database, chain["second"])
    children.append(rotate(database, children[0]))
    assert all(works(database, *children))
    database.write(chief, tokens.revoke_token, chain[leaked].id, with_created=True)
    assert not any(works(database, *chain.values(), *children))
    assert works(database, beside) == [True]


def test_a_thief_cannot_hide_a_successor_by_revoking_the_token_between(database: Database, chief: Principal) -> None:
    leaked = create(database, chief)
    between = rotate(database, leaked)
    hidden = rotate(database, between)
    database.write(holder(database, between), tokens.revoke_token, between.id)
    assert works(database, hidden) == [True]
    database.write(chief, tokens.revoke_token, leaked.id, with_created=True)
    assert works(database, hidden) == [False]


def test_a_rotation_is_not_repeated_after_its_successor_was_revoked(database: Database, chief: Principal) -> None:
    old = create(database, chief)
    new = rotate(database, old)
    database.write(chief, tokens.revoke_token, new.id)
    with pytest.raises(ConflictProblem) as refused:
        rotate(database, old)
    assert refused.value.error_code == "successor-revoked"


def test_rotations_at_the_same_time_make_one_successor(database: Database, chief: Principal) -> None:
    old = create(database, chief)
    caller = holder(database, old)
    start = threading.Barrier(4)

    def race(rotation_id: str) -> str:
        start.wait()
        try:
            return database.write(caller, rotate_token, old.id, TokenRotation(rotation_id=rotation_id)).secret
        except ConflictProblem as refusal:
            return refusal.error_code

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(race, [FIRST, SECOND, FIRST, SECOND]))
    assert answers[0] == answers[2]
    assert answers[1] == answers[3]
    assert sorted(answer == "token-rotated" for answer in answers) == [False, False, True, True]


def create_one(tx: Transaction, _held: NewToken) -> NewToken:
    return tokens.create_token(tx, TokenCreate(name="late"))


def rotate_one(tx: Transaction, held: NewToken) -> NewToken:
    return rotate_token(tx, held.id, TokenRotation(rotation_id=FIRST))


@pytest.mark.parametrize("late", [create_one, rotate_one])
def test_a_request_of_a_token_that_was_revoked_meanwhile_leaves_no_token(
    database: Database, chief: Principal, late: Callable[[Transaction, NewToken], NewToken]
) -> None:
    held = create(database, chief)
    caller = holder(database, held)  # authenticated before the revocation
    database.write(chief, tokens.revoke_token, held.id, with_created=True)
    with pytest.raises(ApiProblem, match="unknown, expired or revoked"):
        database.write(caller, late, held)
    assert database.read(chief, tokens.list_tokens).items == ()
