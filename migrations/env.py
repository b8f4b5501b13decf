"""Run migrations in the transaction that `store.schema` opens, or, for Alembic's commands, in a new one."""

import os

from alembic import context
from sqlalchemy import Connection

from marey_server.store.database.connections import Database
from marey_server.store.tables import metadata


def migrate(connection: Connection) -> None:
    """Migrate the database of `connection` to the revision that the command requests."""
    context.configure(connection=connection, target_metadata=metadata, render_as_batch=True, transactional_ddl=True)
    with context.begin_transaction():
        context.run_migrations()


if "connection" in context.config.attributes:
    migrate(context.config.attributes["connection"])
else:
    database = Database(os.environ.get("MAREY_DATABASE_URL", "sqlite://"))
    with database.engine.begin() as own:
        migrate(own)
    database.close()
