"""Concurrent steps of sign-ins with an identity provider, on two servers: a person is signed in once, or not at all."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import Lab

from marey_schemas.access import NewToken
from marey_schemas.sign_ins import BrowserSignInCode, BrowserSignInCreate
from marey_server.access.id_tokens import Person
from marey_server.access.principal import ANONYMOUS, SYSTEM
from marey_server.access.secret_tokens import hash_secret
from marey_server.errors import ConflictProblem, ForbiddenProblem, NotFoundProblem, UnauthenticatedProblem
from marey_server.store.credentials import browser_sign_ins, identities, tokens
from marey_server.store.credentials.sign_ins import SignInTry
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

ADA = Person("https://login.lab.example", "sub-ada", "ada")
VERIFIER = "v" * 43


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again as another server process would open it."""
    return open_database()


def begin(database: Database) -> str:
    """Begin a sign-in, and let a browser come back from the provider; return its id."""
    request = BrowserSignInCreate(challenge=hash_secret(VERIFIER))
    made = database.write(ANONYMOUS, browser_sign_ins.begin, request, "10.0.0.1", 60, 3600)
    database.write(ANONYMOUS, browser_sign_ins.open_in_browser, made, f"cookie of {made}", f"state of {made}")
    database.write(ANONYMOUS, browser_sign_ins.use_state, f"state of {made}", f"cookie of {made}")
    return made


def confirms(sign_in: str, *, creates_users: bool = False) -> Callable[..., str]:
    return lambda tx: browser_sign_ins.confirm(tx, sign_in, "code", ADA, creates_users=creates_users)


def test_nobody_is_let_in_by_a_link_that_ends_during_the_sign_in(lab: Lab, other: Database) -> None:
    name = lab.owner.require_user_name()
    linked = lab.database.write(SYSTEM, identities.link_identity, name, ADA.issuer, ADA.subject)
    unlink = partial(identities.unlink_identity, name=name, identity_id=linked.id)
    confirm = confirms(begin(lab.database))
    _, refused = interleave(Step(lab.database, SYSTEM, unlink), Step(other, ANONYMOUS, confirm))
    assert isinstance(refused, ForbiddenProblem | NotFoundProblem), refused


def test_a_link_that_ends_after_the_sign_in_ends_the_token(lab: Lab, other: Database) -> None:
    name = lab.owner.require_user_name()
    linked = lab.database.write(SYSTEM, identities.link_identity, name, ADA.issuer, ADA.subject)
    sign_in = begin(lab.database)
    lab.database.write(ANONYMOUS, confirms(sign_in))
    request = BrowserSignInCode.model_validate({"code": "code", "verifier": VERIFIER})
    attempt = SignInTry(f"sign-in {sign_in}", "10.0.0.1", 60)

    def redeem(tx: Transaction) -> NewToken:
        return browser_sign_ins.redeem(tx, sign_in, request, attempt)

    unlink = partial(identities.unlink_identity, name=name, identity_id=linked.id)
    made, _ = interleave(Step(lab.database, ANONYMOUS, redeem), Step(other, SYSTEM, unlink))
    with pytest.raises(UnauthenticatedProblem):
        lab.database.read(SYSTEM, tokens.resolve_token, made.secret)


def test_a_person_who_signs_in_twice_at_once_becomes_one_user(lab: Lab, other: Database) -> None:
    first, second = (confirms(begin(lab.database), creates_users=True) for _ in range(2))
    name, refused = interleave(Step(lab.database, ANONYMOUS, first), Step(other, ANONYMOUS, second))
    assert name == "ada"
    assert isinstance(refused, ConflictProblem) or refused == "ada"
    assert lab.database.write(ANONYMOUS, confirms(begin(lab.database))) == "ada"
