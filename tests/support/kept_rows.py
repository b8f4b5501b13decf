"""Contents of databases that a test process makes once for each kind of database; later tests get copies of the rows.

Creating a project with its users takes about sixty statements, and many tests begin with the same project.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from sqlalchemy import Connection, Table

from marey_server.store.database.connections import Database
from marey_server.store.tables import metadata

T = TypeVar("T")

Rows = Mapping[str, Sequence[Any]]
"""Rows of each table: tuples on SQLite, and on Postgres the SQL that inserts each row."""

_SEQUENCES = """
SELECT quote_ident(schemaname) || '.' || quote_ident(sequencename), last_value FROM pg_sequences
WHERE schemaname = 'public' AND last_value IS NOT NULL
"""


class _Kept(NamedTuple):
    """Rows and result of a function that was called with an empty database."""

    put_back: Callable[[Any], None]
    """Function that puts the rows back, through a connection of the driver."""
    made: Any
    """The result of the function, with placeholders for the database and its clock."""


class _Placeholder:
    """Placeholder for the database, or for its clock, in a stored result."""


_DATABASE, _CLOCK = _Placeholder(), _Placeholder()
_KEPT: dict[tuple[bool, object], _Kept] = {}


def made_once(make: Callable[[Database], T], database: Database) -> T:
    """Return the result of `make`, and fill `database`, which must be empty, with the rows that `make` creates.

    The first call in a process runs `make`. Later calls for the same kind of database insert the stored rows, and
    return a copy of the stored result. So `make` may depend on nothing but the database.
    """
    key = (database.is_sqlite, make)
    if kept := _KEPT.get(key):
        with database.engine.begin() as connection:
            kept.put_back(_driver(connection))
        copied: T = copy.deepcopy(kept.made, {id(_DATABASE): database, id(_CLOCK): database.clock})
        return copied
    before = stored_rows(database)
    made = make(database)
    after = stored_rows(database)
    changed = {table: rows for table, rows in after.items() if rows != before[table]}
    emptied = [table for table in reversed(changed) if before[table]]
    writer = _sqlite_writer if database.is_sqlite else _postgres_writer
    put_back = writer(database, emptied, changed)
    _KEPT[key] = _Kept(put_back, copy.deepcopy(made, {id(database): _DATABASE, id(database.clock): _CLOCK}))
    return made


def _driver(connection: Connection) -> Any:
    return connection.connection.driver_connection


def stored_rows(database: Database) -> Rows:
    """Return all rows of all tables."""
    with database.engine.begin() as connection:
        driver = _driver(connection)
        return {
            table.name: driver.execute(f'SELECT {_selected(table, database)} FROM "{table.name}"').fetchall()
            for table in metadata.sorted_tables
        }


def _selected(table: Table, database: Database) -> str:
    if database.is_sqlite:
        return _columns(table)
    quoted = (f'quote_nullable("{column.name}"::text)' for column in table.columns)
    return f"'(' || concat_ws(', ', {', '.join(quoted)}) || ')'"


def _columns(table: Table) -> str:
    """Return the names of the columns in SQL; a migration may have changed their order in the database."""
    return ", ".join(f'"{column.name}"' for column in table.columns)


def _sqlite_writer(_: Database, emptied: Sequence[str], changed: Rows) -> Callable[[Any], None]:
    def write(driver: Any) -> None:
        driver.execute("PRAGMA defer_foreign_keys = ON")
        for name in emptied:
            driver.execute(f'DELETE FROM "{name}"')
        for name, rows in changed.items():
            table = metadata.tables[name]
            marks = ", ".join("?" * len(table.columns))
            driver.executemany(f'INSERT INTO "{name}" ({_columns(table)}) VALUES ({marks})', rows)

    return write


def _postgres_writer(database: Database, emptied: Sequence[str], changed: Rows) -> Callable[[Any], None]:
    with database.engine.begin() as connection:
        sequences = _driver(connection).execute(_SEQUENCES).fetchall()
    statements = [f'DELETE FROM "{name}"' for name in emptied]
    statements += [
        f'INSERT INTO "{name}" ({_columns(metadata.tables[name])}) VALUES {", ".join(text for (text,) in rows)}'
        for name, rows in changed.items()
        if rows
    ]
    statements += [f"SELECT setval('{name}', {value})" for name, value in sequences]
    text = ";".join(statements).encode()

    def write(driver: Any) -> None:
        driver.execute(text)  # without parameters: one round trip

    return write
