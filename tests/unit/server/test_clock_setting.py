"""Clock of an SQLite database: refused if implausible; a command sets the clock back with all stored times."""

import re
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import insert, select, update

from marey_server import commands
from marey_server.access.principal import SYSTEM
from marey_server.app import connect_database, open_database
from marey_server.process.settings import Settings
from marey_server.store.clock_setting import MOVED, PAST, RECOMPUTED, WAITING
from marey_server.store.database.connections import Database
from marey_server.store.database.opening import DatabaseUnusable
from marey_server.store.tables import leader, metadata, token, user
from marey_server.store.transaction import Transaction

DAY_US = 86400 * 1_000_000
YEAR_NS = 366 * DAY_US * 1000
Jump = Callable[[int], None]


@pytest.fixture
def jump(monkeypatch: pytest.MonkeyPatch) -> Jump:
    """Function that makes the clock of the machine show a later time."""
    real = time.time_ns

    def set_ahead(by_ns: int) -> None:
        monkeypatch.setattr(time, "time_ns", lambda: real() + by_ns)

    return set_ahead


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    chosen = Settings(data=tmp_path / "data")
    open_database(chosen).close()
    return chosen


def now(database: Database) -> int:
    return database.write(SYSTEM, lambda tx: tx.now_us)


def make_token(tx: Transaction, name: str, lives_us: int) -> None:
    owner = tx.execute(select(user.c.id)).scalars().first()
    row = {
        "id": f"token_{name}", "user_id": owner, "name": name, "prefix": name, "secret_hash": name, "scopes": [],
        "created_us": tx.now_us, "expires_us": tx.now_us + lives_us,
    }  # fmt: skip
    tx.execute(insert(token).values(row))


def lives_of_tokens(database: Database) -> dict[str, tuple[int, int]]:
    """Return, by name, when each token was created and for how long it is valid."""
    rows = database.read(SYSTEM, lambda tx: tx.execute(select(token)).all())
    return {row.name: (row.created_us, row.expires_us - row.created_us) for row in rows if row.expires_us}


def test_every_column_of_a_time_has_a_rule() -> None:
    columns = [column for table in metadata.sorted_tables for column in table.columns if column.name.endswith("_us")]
    assert [str(one) for one in columns if one.name not in PAST | WAITING and one not in {*MOVED, RECOMPUTED}] == []


def test_a_start_with_a_clock_far_ahead_is_refused_and_changes_nothing(settings: Settings, jump: Jump) -> None:
    jump(10 * YEAR_NS)
    with pytest.raises(DatabaseUnusable, match=r"says 2\d{3}-.*`marey db clock --set`"):
        open_database(settings)
    jump(0)
    with closing(open_database(settings)) as database:
        assert abs(now(database) - time.time_ns() // 1000) < 60_000_000


def test_a_server_that_was_off_for_months_starts(settings: Settings, jump: Jump) -> None:
    jump(YEAR_NS // 2)
    with closing(open_database(settings)) as database:
        assert now(database) >= time.time_ns() // 1000 - 60_000_000


def test_a_clock_far_ahead_is_taken_once_it_is_confirmed(settings: Settings, jump: Jump) -> None:
    jump(10 * YEAR_NS)
    commands.clock(set_now=True, data=settings.data)
    with closing(open_database(settings)) as database:
        assert now(database) >= time.time_ns() // 1000 - 60_000_000


def test_what_was_written_in_a_wrong_future_is_set_back(
    settings: Settings, jump: Jump, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(open_database(settings)) as database:
        database.write(SYSTEM, make_token, "before", 30 * DAY_US)
    jump(YEAR_NS // 2)
    with closing(open_database(settings)) as database:
        database.write(SYSTEM, make_token, "wrong", 90 * DAY_US)
        lease = {"name": "house", "holder": "nobody", "fence": 1, "expires_us": now(database) + DAY_US}
        database.write(SYSTEM, lambda tx: tx.execute(insert(leader).values(lease)))
    jump(0)
    with closing(open_database(settings)) as database:  # goes on in the future
        assert now(database) > time.time_ns() // 1000 + 100 * DAY_US
    commands.clock(set_now=True, data=settings.data)
    assert re.search(r"[1-9]\d* later times were set back", capsys.readouterr().out)
    with closing(connect_database(settings)) as database:
        here = now(database)
        assert abs(here - time.time_ns() // 1000) < 60_000_000
        made = lives_of_tokens(database)
        assert {name: lives_us for name, (_, lives_us) in made.items()} == {
            "before": 30 * DAY_US, "wrong": 90 * DAY_US,
        }  # fmt: skip
        assert max(made_us for made_us, _ in made.values()) <= here
        assert database.read(SYSTEM, lambda tx: tx.execute(select(leader.c.expires_us)).scalar_one()) <= here


def test_the_clock_is_shown_without_a_change(settings: Settings, capsys: pytest.CaptureFixture[str]) -> None:
    commands.clock(data=settings.data)
    assert re.search(r"last used at 2\d{3}-.*; this machine says 2\d{3}-", capsys.readouterr().out)


def test_the_clock_of_a_running_server_is_left_alone(settings: Settings) -> None:
    with closing(open_database(settings)) as database:
        database.write(SYSTEM, lambda tx: tx.execute(update(user).values(name="somebody")))
        with pytest.raises(commands.CommandFailed, match="stop the server first"):
            commands.clock(set_now=True, data=settings.data)
