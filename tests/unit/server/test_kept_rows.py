"""Stored rows of test projects: the inserted rows equal the original ones, and sequences continue after them."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.database_fixtures import AdjustableClock, copied_sqlite
from tests.support.kept_rows import made_once, stored_rows
from tests.support.store_fixtures import Lab

from marey_server.store.database.connections import Database

pytestmark = pytest.mark.every_database


@pytest.fixture
def emptied(request: pytest.FixtureRequest, database: Database, tmp_path: Path) -> Callable[[], Database]:
    """Function that returns an empty database of the kind of `database`, which may be the same one, emptied."""

    def empty() -> Database:
        if database.is_sqlite:
            folder = tmp_path / "other"
            folder.mkdir()
            url = copied_sqlite(request.getfixturevalue("sqlite_template"), folder)
        else:
            request.getfixturevalue("shared_postgres").empty()
            url = database.url.render_as_string(hide_password=False)
        other = Database(url, clock=AdjustableClock())
        request.addfinalizer(other.close)
        return other

    return empty


def test_rows_that_are_put_back_are_those_that_were_made(database: Database, emptied: Callable[[], Database]) -> None:
    def make(empty: Database) -> Lab:
        lab = Lab(empty, "quoted")
        lab.add_clip(
            lab.add_skeleton("it's a \\ rig; DELETE"), "Übung 100%", tags=("a (b)",), info={"action": '"x" (y)'}
        )
        return lab

    first = made_once(make, database)
    made, numbered = sorted_rows(database), [one.seq for one in first.events()]
    other = emptied()
    again = made_once(make, other)
    assert again.database is other
    assert again.owner == first.owner
    assert sorted_rows(other) == made
    assert len(made["item"]) == 2
    assert [one.seq for one in again.events()] == numbered
    again.add_skeleton("next")
    assert min({one.seq for one in again.events()} - set(numbered)) > max(numbered)


def sorted_rows(database: Database) -> dict[str, list[str]]:
    """Return all rows of all tables, each as a text, in the order of the texts. Postgres returns them in any order."""
    return {name: sorted(map(repr, rows)) for name, rows in stored_rows(database).items()}
