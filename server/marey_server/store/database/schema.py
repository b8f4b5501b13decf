"""Schema of the database: upgrades, and the check that this version of the server can serve it.

Each migration has a phase, in its variable `phase`:

* `before`: the migration only adds to the schema. It runs before servers of the new version start, while servers of
  the earlier version run.
* `after`: the migration removes parts of the schema that only earlier versions use. It runs when no server of an
  earlier version runs any more; servers of the new version can run without it.
* `stopped` (the default): the migration changes parts of the schema that servers use. No server of an earlier version
  may run at that time.

The database records its last migration of a phase other than `before`. A server of an earlier version that knows this
migration can serve the database, although it does not know the newest migrations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, cast

import sqlalchemy
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect

from marey_server.access.principal import SYSTEM
from marey_server.store.credentials.server_key import make_server_key
from marey_server.store.database.connections import Database
from marey_server.store.database.opening import DatabaseUnusable
from marey_server.store.tables import server_state
from marey_server.store.transaction import Transaction

_INSTALLED = Path(__file__).parents[2] / "migrations"
_CHECKOUT = Path(__file__).parents[4] / "migrations"

SERVED_FROM = "schema_served_from"
"""Key in `server_state` of the database's last migration of a phase other than `before`."""

Phase = Literal["before", "stopped", "after"]


@dataclass(frozen=True)
class SchemaUpgrade:
    """Result of an upgrade of the schema: applied migrations, and those that wait for the phase `after`."""

    applied: tuple[str, ...]
    waiting: tuple[str, ...]
    additive: bool
    """Whether servers of the earlier version can continue to use the database."""
    known: bool = True
    """Whether this version knows the schema; if false, a newer version has only added to it."""
    created: bool = False
    """Whether the database was new, so that no server of an earlier version has used it."""


def upgrade_schema(url: str, *, while_serving: bool = False, finish: bool = False) -> SchemaUpgrade:
    """Create or upgrade the tables of the database at `url`, all or nothing; concurrent calls run one after another.

    Migrations of the phase `after` run in three cases only: with `finish`, in a new database, and on SQLite, where only
    one server uses the database. With `while_serving`, raises `DatabaseUnusable` if servers of the earlier version
    could not continue to use the database.
    """
    database = Database(url, readers=1)
    try:
        return database.write(SYSTEM, _upgrade, while_serving, finish, database.is_sqlite)
    finally:
        database.close()


def _upgrade(tx: Transaction, while_serving: bool, finish: bool, one_server: bool) -> SchemaUpgrade:
    tx.lock("schema")
    current, steps = _current(tx.connection), _steps()
    if current is not None and current not in steps and _is_served(tx.connection):
        return SchemaUpgrade((), (), additive=True, known=False)
    last = _head() if finish or one_server or current is None else _last_needed()
    pending = [name for name in steps if current is None or current < name]
    applied = [name for name in pending if name <= last]
    if finish and while_serving:
        raise DatabaseUnusable(
            "--finish cannot be combined with --while-serving, because no server of an earlier version may run then; "
            "first run `marey db upgrade --while-serving`, replace all servers, then run `marey db upgrade --finish`"
        )
    additive = current is None or all(steps[name] == "before" for name in applied)
    if while_serving and not additive:
        raise DatabaseUnusable(
            "this version changes tables that running servers use; stop all servers, and then start the new version"
        )
    if applied or current not in steps:  # alembic reports a schema that this version does not know
        config = _config()
        config.attributes["connection"] = tx.connection
        command.upgrade(config, last)
    _record_served(tx, max(current or "", last))
    make_server_key(tx)
    waiting = tuple(name for name in pending if name > last)
    return SchemaUpgrade(tuple(applied), waiting, additive, created=current is None)


def schema_fits(connection: Connection) -> bool:
    """Return whether this version of the server can serve the database with its present schema."""
    current = _current(connection)
    if current in _steps():
        return current >= _last_needed()
    return current is not None and _is_served(connection)


def _record_served(tx: Transaction, current: str) -> None:
    changing = [name for name, phase in _steps().items() if name <= current and phase != "before"]
    key = server_state.c.key == SERVED_FROM
    tx.execute(sqlalchemy.delete(server_state).where(key))
    tx.execute(sqlalchemy.insert(server_state).values(key=SERVED_FROM, value=max(changing)))


def _is_served(connection: Connection) -> bool:
    """Return whether a newer version, whose schema this version does not know, has only added to the schema."""
    if not sqlalchemy.inspect(connection).has_table(server_state.name):
        return False
    recorded = sqlalchemy.select(server_state.c.value).where(server_state.c.key == SERVED_FROM)
    served_from = connection.execute(recorded).scalar_one_or_none()
    return served_from is not None and served_from in _steps()


def _current(connection: Connection) -> str | None:
    heads = MigrationContext.configure(connection).get_current_heads()
    return heads[0] if heads else None


def list_tables(connection: Connection) -> list[str]:
    """Return the names of all tables in the database's default schema, whichever program has created them."""
    return sorted(inspect(connection).get_table_names())


@lru_cache
def _steps() -> dict[str, Phase]:
    """Return the phases of all migrations that this version knows, in the order in which they run."""
    scripts = reversed(list(ScriptDirectory.from_config(_config()).walk_revisions()))
    return {one.revision: cast(Phase, getattr(one.module, "phase", "stopped")) for one in scripts}


def _head() -> str:
    return list(_steps())[-1]


def _last_needed() -> str:
    """Return the last migration of a phase other than `after`; this version needs the migrations up to it."""
    return [name for name, phase in _steps().items() if phase != "after"][-1]


def _config() -> Config:
    config = Config()
    config.set_main_option("script_location", str(_INSTALLED if _INSTALLED.is_dir() else _CHECKOUT).replace("%", "%%"))
    return config
