"""Commands that maintain a database (backup, restore, check), and the choice of a server's event loop."""

import asyncio
import sqlite3
import stat
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from marey_server import commands
from marey_server.app import open_database
from marey_server.errors import StorageFullProblem, UnavailableProblem
from marey_server.process.settings import Settings
from marey_server.store.database.opening import DatabaseUnusable, opening
from marey_server.store.database.schema import SERVED_FROM
from marey_server.store.transaction import Transaction


def upgrade_in(folder: Path) -> None:
    commands.upgrade(data=folder)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data folder with the database of a server that was stopped."""
    folder = tmp_path / "data"
    open_database(Settings(data=folder)).close()
    return folder


def users_in(file: Path) -> list[str]:
    with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
        return [name for (name,) in database.execute("SELECT name FROM user")]


def test_a_backup_holds_what_was_written_before_it_though_the_database_is_in_use(data: Path, tmp_path: Path) -> None:
    with closing(sqlite3.connect(data / "marey.db")) as server:
        server.execute("UPDATE user SET name = 'renamed'")
        server.commit()
        server.execute("UPDATE user SET name = 'not yet'")
        commands.backup(target=tmp_path / "copy.db", data=data)
        server.rollback()
    assert users_in(tmp_path / "copy.db") == ["renamed"]
    assert (tmp_path / "copy.db").stat().st_mode & 0o777 == 0o600


def test_a_backup_is_put_in_the_place_of_a_lost_database_and_checked(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    commands.backup(target=tmp_path / "copy.db", data=data)
    commands.restore(source=tmp_path / "copy.db", data=tmp_path / "elsewhere")
    assert users_in(tmp_path / "elsewhere" / "marey.db") == ["admin"]
    commands.fsck(data=tmp_path / "elsewhere")
    assert capsys.readouterr().out.endswith("\nchecked 1 user\n")


def test_a_backup_never_writes_over_a_file(data: Path, tmp_path: Path) -> None:
    (tmp_path / "copy.db").write_text("precious")
    with pytest.raises(commands.CommandFailed, match="exists"):
        commands.backup(target=tmp_path / "copy.db", data=data)
    assert (tmp_path / "copy.db").read_text() == "precious"


def test_a_backup_into_a_folder_that_does_not_exist_names_the_file_that_was_given(data: Path, tmp_path: Path) -> None:
    target = tmp_path / "missing" / "copy.db"
    with pytest.raises(commands.CommandFailed, match=f"^{target}: there is no folder {target.parent}; create it"):
        commands.backup(target=target, data=data)


@pytest.mark.parametrize("left", ["marey.db", "marey.db-wal", "marey.db-shm"])
def test_nothing_is_restored_over_or_beside_what_a_server_left(data: Path, tmp_path: Path, left: str) -> None:
    commands.backup(target=tmp_path / "copy.db", data=data)
    target = tmp_path / "target"
    target.mkdir()
    (target / left).write_text("left by a crash")
    with pytest.raises(commands.CommandFailed, match=left):
        commands.restore(source=tmp_path / "copy.db", data=target)
    assert [path.name for path in target.iterdir()] == [left]


def test_a_purge_deletes_what_is_old_and_makes_the_file_smaller(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = data / "marey.db"
    with closing(sqlite3.connect(file)) as server:
        server.execute("CREATE TABLE ballast AS SELECT zeroblob(4000000) AS bytes")
        server.execute("DROP TABLE ballast")
        server.execute("UPDATE event SET at_us = 1")
        for kind in ("old", "newest"):
            server.execute("INSERT INTO event (at_us, kind, subject, body) VALUES (2, ?, 'x', '{}')", [kind])
        server.commit()
    before = file.stat().st_size
    commands.purge(data=data)
    said = capsys.readouterr().out
    assert "deleted 1 events" in said
    assert "deleted 0 audit entries" in said
    assert f"it took {before:,}" in said
    assert before - file.stat().st_size > 3_000_000
    commands.fsck(data=data)


def test_a_purge_beside_a_running_server_deletes_and_says_why_the_file_stays(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(open_database(Settings(data=data))), pytest.raises(commands.CommandFailed, match="stop the server"):
        commands.purge(data=data)
    assert "deleted 0 events" in capsys.readouterr().out


def test_a_new_administrators_token_is_written_for_who_lost_theirs(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lost = (data / "admin.token").read_text()
    (data / "admin.token").unlink()
    commands.admin_token(data=data)
    assert (data / "admin.token").read_text() not in (lost, "")
    said = capsys.readouterr().out
    assert "marey token revoke" in said
    assert (data / "admin.token").read_text().strip() not in said


@pytest.mark.parametrize(("user", "folder", "why"), [("nobody", "data", "--user"), (None, "elsewhere", "--data")])
def test_a_token_that_cannot_be_made_is_refused_in_a_sentence(
    data: Path, tmp_path: Path, user: str | None, folder: str, why: str
) -> None:
    with pytest.raises(commands.CommandFailed, match=why):
        commands.admin_token(user=user, data=tmp_path / folder)


def start(**settings: Any) -> None:
    """Create or open the database, as `serve` does first."""
    open_database(Settings(**settings)).close()


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("nonsense", "is not the URL of a supported database"),
        ("mysql://u:sekret@h/x", "is not the URL of a supported database"),
        ("postgresql://u:sekret@127.0.0.1:1/x", r"postgresql://u:\*\*\*@127.0.0.1:1/x does not answer: .*refused"),
    ],
)
@pytest.mark.parametrize("command", [start, commands.upgrade, commands.fsck])
def test_a_database_that_cannot_be_opened_is_told_in_a_sentence_without_its_password(
    tmp_path: Path, command: Callable[..., Any], url: str, told: str
) -> None:
    with pytest.raises((commands.CommandFailed, DatabaseUnusable), match=told) as failed:
        command(data=tmp_path, database_url=url)
    assert "sekret" not in str(failed.value)
    assert len(str(failed.value).splitlines()) == 1


def test_an_upgrade_of_a_new_database_says_that_it_was_created(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistyped data folder is seen, because the database of the right folder existed before."""
    commands.upgrade(data=tmp_path / "typo")
    created = f"there were no tables; they were created in {tmp_path / 'typo' / 'marey.db'}\n"
    assert capsys.readouterr().out == created
    commands.upgrade(data=tmp_path / "typo")
    assert capsys.readouterr().out == "the database's schema is up to date\n"


def test_an_sqlite_file_on_a_broken_disk_has_no_server_to_start(tmp_path: Path) -> None:
    with pytest.raises(DatabaseUnusable) as failed, opening(f"sqlite:///{tmp_path}/marey.db"):
        raise UnavailableProblem("x") from OSError("disk I/O error")
    assert str(failed.value) == (
        f"the database {tmp_path}/marey.db cannot be used: disk I/O error; check that its folder exists, that you may "
        "write there, that the disk works and has free space, and that no other program has locked the file"
    )


@pytest.mark.parametrize("command", [start, commands.upgrade])
def test_a_file_that_is_no_database_is_told_and_left_as_it_is(tmp_path: Path, command: Callable[..., Any]) -> None:
    (tmp_path / "marey.db").write_bytes(b"not a database " * 1000)
    with pytest.raises((commands.CommandFailed, DatabaseUnusable), match="file is not a database"):
        command(data=tmp_path)
    assert (tmp_path / "marey.db").read_bytes() == b"not a database " * 1000


@pytest.mark.parametrize("command", [start, commands.upgrade])
def test_a_disk_without_room_for_the_tables_is_told(
    tmp_path: Path, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_tx: Transaction) -> None:
        raise StorageFullProblem("The disk has no space left.")

    monkeypatch.setattr("marey_server.store.database.schema.make_server_key", full)
    with pytest.raises((commands.CommandFailed, DatabaseUnusable), match="for writing: The disk has no space"):
        command(data=tmp_path)


@pytest.mark.parametrize("command", [start, commands.upgrade])
def test_tables_of_a_newer_version_are_told_and_left_as_they_are(data: Path, command: Callable[..., Any]) -> None:
    with closing(sqlite3.connect(data / "marey.db")) as database, database:
        database.execute("UPDATE alembic_version SET version_num = '9999'")
        database.execute("UPDATE server_state SET value = '9999' WHERE key = ?", [SERVED_FROM])
    with pytest.raises(
        (commands.CommandFailed, DatabaseUnusable), match="belong to another, perhaps newer, version of Marey"
    ):
        command(data=data)
    with closing(sqlite3.connect(data / "marey.db")) as database:
        assert database.execute("SELECT version_num FROM alembic_version").fetchall() == [("9999",)]


def test_serve_tells_what_is_wrong_with_its_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def unusable(_settings: Settings) -> None:
        raise DatabaseUnusable("the database is a teapot")

    monkeypatch.setattr("marey_server.app.serve", unusable)
    with pytest.raises(commands.CommandFailed, match="is a teapot"):
        commands.serve(data=tmp_path)


def test_the_server_runs_on_uvloop_where_that_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = object()
    monkeypatch.setitem(sys.modules, "uvloop", SimpleNamespace(new_event_loop=lambda: loop))

    assert commands._new_event_loop() is loop


def test_the_server_runs_on_asyncio_where_uvloop_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)

    loop = commands._new_event_loop()

    assert isinstance(loop, asyncio.SelectorEventLoop)
    loop.close()


def modes_in(folder: Path) -> dict[str, int]:
    return {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}


@pytest.mark.parametrize("start", [lambda folder: open_database(Settings(data=folder)).close(), upgrade_in])
@pytest.mark.parametrize("through_link", [False, True])
def test_other_users_may_not_look_into_a_data_folder_whatever_its_rights_were(
    start: Callable[[Path], None], tmp_path: Path, *, through_link: bool
) -> None:
    folder, link = tmp_path / "data", tmp_path / "link"
    folder.mkdir()
    folder.chmod(0o755)
    link.symlink_to(folder)
    (folder / "marey.toml").write_text("")
    (folder / "marey.toml").chmod(0o644)
    start(link if through_link else folder)
    with closing(sqlite3.connect(folder / "marey.db")) as server:
        server.execute("PRAGMA journal_mode=WAL")
        server.execute("UPDATE user SET name = name")
        modes = modes_in(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {"marey.db", "marey.db-wal", "marey.db-shm", "marey.toml"} <= modes.keys()
    assert set(modes.values()) == {0o600}


def test_a_folder_with_files_of_others_stays_open_and_they_keep_their_rights(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "checkout"
    folder.mkdir()
    (folder / "run.sh").write_text("")
    (folder / "run.sh").chmod(0o755)
    folder.chmod(0o2775)
    open_database(Settings(data=folder)).close()
    modes = modes_in(folder)
    assert (modes.pop("run.sh"), stat.S_IMODE(folder.stat().st_mode)) == (0o755, 0o2775)
    assert set(modes.values()) == {0o600}
    assert "contains other files" in caplog.text


def test_a_database_outside_the_data_folder_is_closed_to_others(tmp_path: Path) -> None:
    file = tmp_path / "elsewhere.db"
    file.touch()
    file.chmod(0o644)
    open_database(Settings(data=tmp_path / "data", database_url=f"sqlite:///{file}")).close()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
