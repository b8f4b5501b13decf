"""Random calls by callers of every kind, compared with a model of their rights.

Defects that tests plant must be found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import ColumnElement, true
from tests.support.rest_server import Server, running
from tests.support.tiers import is_soak
from tests.support.who_may_invite import InvitingProgram

from marey_schemas.access import Role
from marey_server.access import roles, scopes
from marey_server.store import blobs, projects
from marey_server.store.credentials import tokens
from marey_server.store.database.clock import DAY_US
from marey_server.store.database.connections import Database
from marey_server.store.invitations import accepting

pytestmark = pytest.mark.timeout(7200)

SEED = 20261123
CALLS = 20_000 if is_soak() else 1_000
CALLS_TO_FIND_A_HOLE = 2_000
AS_SEEN = projects._as_seen


@pytest.fixture
def server(database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A running server, on SQLite and on Postgres; tokens of ended attempts do not expire while the calls are made.

    On a busy machine, the calls take longer than the usual quarter of an hour.
    """
    monkeypatch.setattr(tokens, "REPLAY_GRACE_US", DAY_US)
    with running(database, tmp_path, lease_ttl_s=3600.0, login_tries_per_minute=10**6) as one:
        yield one


def test_every_caller_does_and_knows_what_the_model_says(server: Server) -> None:
    program = InvitingProgram(server, SEED)
    program.run(CALLS)
    assert program.differences == []


def _bounds_of_tokens_are_forgotten(held: Any, need: str, _project: str | None = None) -> bool:
    return scopes.reaches_somewhere(held, need)


def _everybody_holds_all_bytes(_tx: Any, digests: Any, **_since: Any) -> set[str]:
    return set(digests)


def _every_role_is_enough(_role: Any, _required: Any) -> bool:
    return True


def _every_invitation_is_open(_tx: Any) -> ColumnElement[bool]:
    return true()


def _everybody_is_an_administrator(_principal: Any) -> bool:
    return True


def _every_project_has_guests(principal: Any, row: Any) -> Any:
    return AS_SEEN(principal, row) or projects._row(row, Role.READER, None, guest=True)


HOLES: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "every member may do everything": (roles, "includes", _every_role_is_enough),
    "a token reaches beyond its project": (scopes, "allows", _bounds_of_tokens_are_forgotten),
    "a digest is enough to have the bytes": (blobs, "_held", _everybody_holds_all_bytes),
    "everybody is an administrator": (roles, "is_administrator", _everybody_is_an_administrator),
    "an invitation that is used up still works": (accepting, "is_open", _every_invitation_is_open),
    "private projects have guests": (projects, "_as_seen", _every_project_has_guests),
}


@pytest.mark.soak
@pytest.mark.parametrize("hole", HOLES)
def test_a_planted_hole_is_found(server: Server, monkeypatch: pytest.MonkeyPatch, hole: str) -> None:
    monkeypatch.setattr(*HOLES[hole])
    program = InvitingProgram(server, SEED)
    program.run(CALLS_TO_FIND_A_HOLE)
    assert program.differences
