"""Write-ahead log of SQLite, which a thread copies while writes continue."""

import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import sqlalchemy

from marey_server.access.principal import SYSTEM
from marey_server.store.database import engines, write_ahead_log
from marey_server.store.database.connections import Database
from marey_server.store.database.write_ahead_log import WriteAheadLog
from marey_server.store.tables import server_state
from marey_server.store.transaction import Transaction

PATIENCE_S = 60.0
SHORT_BYTES = 2**18
ROW_BYTES = 2**17


@pytest.fixture(autouse=True)
def _short_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in (("SHORT", SHORT_BYTES), ("LITTLE", SHORT_BYTES), ("LONG", 2**20), ("TOO_LONG", 2**22)):
        monkeypatch.setattr(write_ahead_log, f"{name}_BYTES", size)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "some.db"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now_s=1000.0)
    monkeypatch.setattr(write_ahead_log, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    return clock


@pytest.fixture
def log(file: Path) -> Iterator[WriteAheadLog]:
    log = WriteAheadLog(file)
    yield log
    log.close()


@pytest.fixture
def page_bytes() -> int:
    return write_ahead_log.PAGE_BYTES


@pytest.fixture
def writing(file: Path, page_bytes: int) -> Iterator[sqlite3.Connection]:
    with closing(connect(file, page_bytes)) as connection:
        connection.execute("CREATE TABLE some (data BLOB)")
        yield connection


def connect(file: Path, page_bytes: int = write_ahead_log.PAGE_BYTES) -> sqlite3.Connection:
    connection = sqlite3.connect(file, isolation_level=None)
    limit = f"journal_size_limit = {SHORT_BYTES}"
    for pragma in (f"page_size = {page_bytes}", "journal_mode = WAL", limit, "wal_autocheckpoint = 0"):
        connection.execute(f"PRAGMA {pragma}")
    return connection


def write(log: WriteAheadLog, connection: sqlite3.Connection, size_bytes: int = ROW_BYTES) -> int:
    """Commit a row; return the length of the log in bytes."""
    connection.execute("INSERT INTO some VALUES (zeroblob(?))", (size_bytes,))
    log.after_commit(connection)
    return Path(f"{connection.execute('PRAGMA database_list').fetchone()[2]}-wal").stat().st_size


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


@pytest.mark.parametrize("page_bytes", [write_ahead_log.PAGE_BYTES, 16_384], ids=["new", "earlier"])
def test_a_log_that_was_copied_is_restarted_by_a_later_write(log: WriteAheadLog, writing: sqlite3.Connection) -> None:
    while write(log, writing) <= 4 * SHORT_BYTES:
        pass
    wait_until(lambda: write(log, writing, 1) <= SHORT_BYTES)


def test_writes_do_not_wait_while_the_log_is_copied(
    log: WriteAheadLog, writing: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_copy = threading.Event()
    copy_once = log._copy_once
    monkeypatch.setattr(log, "_copy_once", lambda: may_copy.wait(PATIENCE_S) and copy_once())
    while write(log, writing) <= 2**20:
        assert not log.is_long
    write(log, writing)
    assert log.is_long
    may_copy.set()
    wait_until(lambda: not log.is_long)
    wait_until(lambda: write(log, writing, 1) <= SHORT_BYTES)


def test_a_reader_delays_the_restart_but_no_write_waits_for_it_again_and_again(
    log: WriteAheadLog, file: Path, writing: sqlite3.Connection, clock: SimpleNamespace
) -> None:
    writing.execute("INSERT INTO some VALUES (zeroblob(?))", (3 * SHORT_BYTES,))
    with closing(connect(file)) as reading:
        reading.execute("BEGIN")
        reading.execute("SELECT count(*) FROM some").fetchall()  # from the log, as long as it is not copied
        log.after_commit(writing)
        wait_until(lambda: not log._copying)
        length = write(log, writing, 1)  # tries to restart the log
        tries: list[str] = []
        writing.set_trace_callback(tries.append)
        assert write(log, writing, 1) > length
        assert not [statement for statement in tries if "RESTART" in statement]
        clock.now_s += write_ahead_log.PAUSES * write_ahead_log.PATIENCE_MS / 1000
        write(log, writing, 1)
        assert [statement for statement in tries if "RESTART" in statement]
    clock.now_s += PATIENCE_S
    write(log, writing, 1)
    assert write(log, writing, 1) <= SHORT_BYTES
    assert writing.execute("PRAGMA busy_timeout").fetchone() == (5000,)


def test_a_log_that_cannot_be_copied_is_reported_once_and_harms_no_write(
    log: WriteAheadLog, writing: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(write_ahead_log, "sqlite3", SimpleNamespace(connect=fail, Error=sqlite3.Error))
    write(log, writing, 2 * SHORT_BYTES)
    wait_until(lambda: not log._copying)
    write(log, writing)
    wait_until(lambda: not log._copying)
    assert [record.message for record in caplog.records if "disk I/O error" in record.message] == [
        f"the log of the database {log._file} cannot be copied, and grows: disk I/O error"
    ]
    monkeypatch.undo()
    wait_until(lambda: write(log, writing, 1) > 0 and not log._failing)


def add_rows(tx: Transaction, start: int) -> None:
    rows = [{"key": f"k{start + number}", "value": "x" * 300_000} for number in range(4)]
    tx.execute(tx.insert_or_ignore(server_state), rows)


def count_rows(tx: Transaction) -> int:
    return tx.execute(sqlalchemy.select(sqlalchemy.func.count()).select_from(server_state)).scalar_one()


def test_the_log_of_a_server_stays_short_under_steady_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "SHORT_BYTES", SHORT_BYTES)
    database = Database(f"sqlite:///{tmp_path / 'marey.db'}")
    stop = threading.Event()

    def keep_reading() -> None:
        while not stop.is_set():
            database.read(SYSTEM, count_rows)

    with database.engine.begin() as connection:
        server_state.create(connection)
    readers = [threading.Thread(target=keep_reading) for _ in range(2)]
    for reader in readers:
        reader.start()
    try:
        log, numbers = tmp_path / "marey.db-wal", iter(range(0, 10**6, 4))
        while log.stat().st_size <= 2**20:
            database.write(SYSTEM, add_rows, next(numbers))
        last = next(numbers)

        def is_short_after_a_write() -> bool:
            database.write(SYSTEM, add_rows, last)  # adds rows only the first time
            return log.stat().st_size <= SHORT_BYTES

        wait_until(is_short_after_a_write)
    finally:
        stop.set()
        for reader in readers:
            reader.join(PATIENCE_S)
        database.close()
    assert not log.exists()
