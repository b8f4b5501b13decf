"""Tokens of pools: they stay in use over restarts of the server, and are bound to the labels of the pool."""

import stat
from pathlib import Path

import pytest
from tests.support.present import present

from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import UnauthenticatedProblem
from marey_server.launchers.worker_tokens import keep_pool_token
from marey_server.process.settings import Settings
from marey_server.store import users
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database

LABELS = {"gpu": "a100"}


@pytest.fixture
def file(database: Database, tmp_path: Path) -> Path:
    database.write(SYSTEM, users.ensure_first_administrator)
    return tmp_path / "worker-tokens" / "gpu"


def keep(database: Database, file: Path, labels: dict[str, str] = LABELS, *, port: int = 8460) -> str:
    return keep_pool_token(database, Settings(port=0), port, "gpu", labels, file)


def holder(database: Database, token: str) -> Principal:
    return database.read(SYSTEM, tokens.resolve_token, token)


def test_a_token_can_only_claim_jobs_and_is_in_a_private_file(database: Database, file: Path) -> None:
    token = keep(database, file)
    assert (holder(database, token).scopes, holder(database, token).labels) == (("work",), LABELS)
    assert file.read_text().strip() == token
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700


def test_the_next_server_keeps_the_token(database: Database, file: Path) -> None:
    assert keep(database, file) == keep(database, file)


def test_servers_at_other_ports_with_other_folders_keep_their_tokens(database: Database, file: Path) -> None:
    first = keep(database, file)
    second = keep(database, file.parent.parent / "other" / "gpu", port=8461)
    assert holder(database, first).token_id != holder(database, second).token_id


def test_other_labels_or_an_unusable_file_lead_to_a_new_token(database: Database, file: Path) -> None:
    first = keep(database, file)
    second = keep(database, file, {"gpu": "h100"})
    assert holder(database, second).labels == {"gpu": "h100"}
    with pytest.raises(UnauthenticatedProblem):
        holder(database, first)
    for content in (b"", b"\xff", b"marey_invented_token"):
        file.write_bytes(content)
        again = keep(database, file)
        assert file.read_text().strip() == again
        holder(database, again)


def test_a_revoked_token_is_replaced(database: Database, file: Path) -> None:
    first = keep(database, file)
    admin = database.read(SYSTEM, users.administrator_principal)
    database.write(admin, tokens.revoke_token, present(holder(database, first).token_id))
    assert keep(database, file) != first
