"""Schema of the database: upgrades, and the check that it is current."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect

from marey_server.access.principal import SYSTEM
from marey_server.store.credentials.server_key import make_server_key
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction

_INSTALLED = Path(__file__).parents[2] / "migrations"
_CHECKOUT = Path(__file__).parents[4] / "migrations"


def upgrade_schema(url: str) -> None:
    """Create or upgrade the tables of the database at `url`, all or nothing; concurrent calls run one after another."""
    database = Database(url, readers=1)
    try:
        database.write(SYSTEM, _upgrade)
    finally:
        database.close()


def _upgrade(tx: Transaction) -> None:
    tx.lock("schema")
    config = _config()
    config.attributes["connection"] = tx.connection
    command.upgrade(config, "head")
    make_server_key(tx)


def schema_at_head(connection: Connection) -> bool:
    """Return whether the database has the schema that this version of the server needs."""
    return MigrationContext.configure(connection).get_current_heads() == _expected_heads()


def list_tables(connection: Connection) -> list[str]:
    """Return the names of all tables in the database's default schema, whichever program has created them."""
    return sorted(inspect(connection).get_table_names())


@lru_cache
def _expected_heads() -> tuple[str, ...]:
    return tuple(ScriptDirectory.from_config(_config()).get_heads())


def _config() -> Config:
    config = Config()
    config.set_main_option("script_location", str(_INSTALLED if _INSTALLED.is_dir() else _CHECKOUT).replace("%", "%%"))
    return config
