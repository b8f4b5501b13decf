"""Files and tables that a server creates before it serves for the first time."""

import socket
import stat
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from tests.support.rest_server import running

from marey_schemas.access import UserChange, UserCreate
from marey_server.access.principal import SYSTEM
from marey_server.errors import NotFoundProblem, UnauthenticatedProblem, UnavailableProblem
from marey_server.launchers.worker_tokens import make_worker_token
from marey_server.process.administrators import give_token, make_first_administrator
from marey_server.process.settings import Settings
from marey_server.store import leader, users
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database


def test_the_first_administrator_is_made_once_and_the_token_works(database: Database, tmp_path: Path) -> None:
    file = tmp_path / "admin.token"
    database.write(SYSTEM, make_first_administrator, file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    secret = file.read_text().strip()
    assert database.read(SYSTEM, tokens.resolve_token, secret).administrator
    database.write(SYSTEM, make_first_administrator, file)
    assert file.read_text().strip() == secret


def test_a_lost_token_of_an_administrator_is_replaced_by_who_owns_the_machine(
    database: Database, tmp_path: Path
) -> None:
    file = tmp_path / "admin.token"
    database.write(SYSTEM, make_first_administrator, file)
    lost = file.read_text().strip()
    file.unlink()
    database.write(SYSTEM, partial(give_token, name="again"), None, file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.read_text().strip() != lost
    assert database.read(SYSTEM, tokens.resolve_token, file.read_text().strip()).administrator


def test_a_token_is_given_to_administrators_alone_and_a_refusal_leaves_the_file(
    database: Database, tmp_path: Path
) -> None:
    file = tmp_path / "admin.token"
    database.write(SYSTEM, make_first_administrator, file)
    held = file.read_text()
    admin = database.read(SYSTEM, users.administrator_principal)
    database.write(admin, users.create_user, UserCreate(name="guest"))
    for name in ("guest", "nobody"):
        with pytest.raises(NotFoundProblem):
            database.write(SYSTEM, partial(give_token, name="again"), name, file)
    assert file.read_text() == held
    assert not file.with_suffix(".partial").exists()


def test_local_workers_get_a_token_though_the_first_administrator_is_disabled(
    database: Database, tmp_path: Path
) -> None:
    database.write(SYSTEM, make_first_administrator, tmp_path / "admin.token")
    admin = database.read(SYSTEM, users.administrator_principal)
    database.write(admin, users.create_user, UserCreate(name="ops", administrator=True))
    ops = database.read(SYSTEM, users.administrator_principal, "ops")
    database.write(ops, partial(users.change_user, expected_rev=None), "admin", UserChange(disabled=True))
    assert database.read(SYSTEM, tokens.resolve_token, make_worker_token(database, Settings(), 8460)).user_name == "ops"


def test_a_server_that_starts_again_replaces_its_workers_token_and_no_other_servers(database: Database) -> None:
    database.write(SYSTEM, users.ensure_first_administrator)
    first = make_worker_token(database, Settings(), 8460)
    beside = make_worker_token(database, Settings(), 8461)
    again = make_worker_token(database, Settings(), 8460)
    for secret in (beside, again):
        holder = database.read(SYSTEM, tokens.resolve_token, secret)
        assert (holder.scopes, holder.labels) == (("work",), {})
    with pytest.raises(UnauthenticatedProblem):
        database.read(SYSTEM, tokens.resolve_token, first)


def test_a_port_that_is_taken_is_told_with_what_to_do(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        serve = [sys.executable, "-m", "marey_client.cli", "serve", "--data", str(tmp_path), "--workers", "0"]
        done = subprocess.run([*serve, "--port", str(port)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert f"port {port}: Address already in use; choose another address with --host" in done.stderr.splitlines()[-1]


def test_a_server_whose_database_is_away_stops_all_the_same(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def without_database(*_: object) -> None:
        raise UnavailableProblem("The database does not answer.")

    with running(database, tmp_path):
        monkeypatch.setattr(leader, "give_up_lead", without_database)
    assert "housekeeping can pass to another process only in 30 s: The database does not answer." in caplog.text
