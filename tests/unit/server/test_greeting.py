"""Output of a server at its start."""

from contextlib import closing
from pathlib import Path

import pytest

from marey_server.access.principal import SYSTEM
from marey_server.app import greeting, next_command
from marey_server.process.settings import Settings
from marey_server.store import users
from marey_server.store.database.connections import Database

USUAL = "http://127.0.0.1:8460"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, which contains a data folder at the default place, with a token."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "marey-data").mkdir()
    (tmp_path / "marey-data" / "admin.token").write_text("marey_very_secret")
    return tmp_path


@pytest.fixture
def database_with_administrator(database: Database) -> Database:
    database.write(SYSTEM, users.ensure_first_administrator)
    return database


def test_where_the_defaults_lead_here_the_next_command_is_short(folder: Path) -> None:
    assert next_command(Settings(), USUAL) == " in this folder: marey project create lab"
    assert next_command(Settings(host="0.0.0.0"), "http://0.0.0.0:8460") == next_command(Settings(), USUAL)


def test_elsewhere_it_names_the_server_and_the_token_file(folder: Path) -> None:
    told = next_command(Settings(), "http://127.0.0.1:9000")
    file = folder / "marey-data" / "admin.token"
    assert told == f": marey --server http://127.0.0.1:9000 --token-file {file} project create lab"


def test_without_a_token_the_next_thing_is_to_log_in(folder: Path) -> None:
    assert next_command(Settings(data=Path("other")), USUAL) == f": marey login --server {USUAL}"


def test_the_administrator_the_data_and_the_place_of_the_token_are_told_and_no_secret(
    folder: Path, database_with_administrator: Database
) -> None:
    told = "\n".join(greeting(Settings(), USUAL, database_with_administrator))
    for part in (
        f"listening on {USUAL}",
        f"data: {folder / 'marey-data'}",
        f"database: {database_with_administrator.shown}",
        "administrator: admin;",
        str(folder / "marey-data" / "admin.token"),
    ):
        assert part in told
    assert "secret" not in told
    (folder / "marey-data" / "admin.token").unlink()
    assert "marey db admin-token" in "\n".join(greeting(Settings(), USUAL, database_with_administrator))


def test_where_a_database_is_is_told_without_its_passwords() -> None:
    with closing(Database("postgresql://marey:geheim@db.internal/marey?sslpassword=geheim")) as database:
        assert database.shown == "postgresql+psycopg://marey:***@db.internal/marey"
