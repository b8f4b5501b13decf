"""The tables in the code equal those that migrations create, on both databases."""

from collections.abc import Sized
from pathlib import Path

import pytest
import sqlalchemy
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, quoted_name
from tests.support.queue_desk import Desk
from tests.support.store_fixtures import Lab

from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.store import fsck, items
from marey_server.store.database import schema
from marey_server.store.database.connections import Database
from marey_server.store.tables import metadata
from marey_server.store.transaction import Transaction


@pytest.mark.filterwarnings("ignore:.*expression-based index")
def test_migrations_make_exactly_the_tables_of_the_code(database: Database) -> None:
    over_expressions = {
        index.name
        for table in metadata.tables.values()
        for index in table.indexes
        if len(index.columns) < len(index.expressions)
    }  # Alembic cannot compare these; the next test does

    def comparable(_thing: object, name: quoted_name, kind: str, _reflected: bool, _other: object) -> bool:
        return kind != "index" or name not in over_expressions

    with database.engine.connect() as connection:
        context = MigrationContext.configure(
            connection, opts={"compare_server_default": True, "include_object": comparable}
        )
        assert compare_metadata(context, metadata) == []


@pytest.mark.filterwarnings("ignore:.*expression-based index")
def test_migrated_constraints_have_the_names_of_the_code(database: Database) -> None:
    def names(connection: Connection) -> set[str]:
        seen = sqlalchemy.inspect(connection)
        lists = (seen.get_multi_foreign_keys, seen.get_multi_unique_constraints, seen.get_multi_check_constraints)
        found = [one for get in lists for constraints in get().values() for one in constraints]
        keys = seen.get_multi_pk_constraint().values()
        return {one["name"] for one in (*found, *keys) if one is not None and one["name"] is not None}

    with database.engine.connect() as connection:  # and no commit, as in the next test
        connection.exec_driver_sql("DROP TABLE alembic_version")
        migrated = names(connection)
        metadata.drop_all(connection)
        metadata.create_all(connection)
        unread = {"fk_dataset_commit_job_id_job"} if database.is_sqlite else set()  # by SQLAlchemy, as SQLite stores it
        assert migrated == names(connection) - unread


def test_indexes_over_expressions_are_migrated_too(database: Database) -> None:
    def indexes(connection: Connection) -> dict[str, str]:
        catalogue = (
            "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
            if connection.dialect.name == "sqlite"
            else "SELECT indexname, indexdef FROM pg_indexes WHERE schemaname = 'public'"
        )
        return {
            name: " ".join(sql.split()) for name, sql in connection.exec_driver_sql(catalogue) if "alembic" not in name
        }

    with database.engine.connect() as connection:  # and no commit: on Postgres other tests use the same database
        migrated = indexes(connection)
        connection.exec_driver_sql("DROP TABLE alembic_version")
        metadata.drop_all(connection)
        metadata.create_all(connection)
        assert indexes(connection) == migrated


def test_a_database_is_at_head_only_after_the_upgrade(database: Database, tmp_path: Path) -> None:
    with database.engine.connect() as connection:
        assert schema.schema_fits(connection)
    empty = Database(f"sqlite:///{tmp_path}/empty.db")
    with empty.engine.connect() as connection:
        assert not schema.schema_fits(connection)
    empty.close()


def test_upgrading_again_keeps_everything(database: Database, database_url: str) -> None:
    keys = sqlalchemy.select(metadata.tables["server_state"]).where(
        metadata.tables["server_state"].c.key.in_(["mine", "cursor_key"])
    )
    with database.engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO server_state (key, value) VALUES ('mine', '1')")
        before = connection.execute(keys).all()
    schema.upgrade_schema(database_url)
    with database.engine.connect() as connection:
        assert len(before) == 2
        assert connection.execute(keys).all() == before


def test_an_upgrade_copies_take_records_to_the_summaries_of_clips(lab: Lab, database_url: str) -> None:
    info = {
        "schema": "marey/clip-info@1",
        "subject": "02",
        "licence": "CC0",
        "checks": [{"code": "gap", "message": ""}],
    }
    rig = lab.add_skeleton()
    clips = [lab.add_clip(rig, f"take {number}", info=info, seed=number) for number in range(5)]
    plain = lab.add_clip(rig, "plain")
    table = metadata.tables["item"]
    with lab.database.engine.begin() as connection:
        for clip in clips:
            earlier = {name: value for name, value in clip.summary.items() if name not in ("subject", "licence")}
            connection.execute(sqlalchemy.update(table).where(table.c.id == clip.id).values(summary=earlier))
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0015")
    schema.upgrade_schema(database_url)
    for clip in (*clips, plain):
        assert lab.read(items.read_item, "lab", Kind.CLIP, clip.id).summary == clip.summary
    assert clips[0].summary["subject"] == "02"
    assert "subject" not in plain.summary


def test_an_upgrade_records_the_references_of_stored_documents(lab: Lab, database_url: str) -> None:
    rig = lab.add_skeleton()
    clips = [lab.add_clip(rig, f"take {number}", seed=number) for number in range(3)]
    with lab.database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0020")
    schema.upgrade_schema(database_url)
    assert list(fsck.check_store(lab.database)) == []
    table = metadata.tables["document_item"]
    rows = lab.read(lambda tx: tx.execute(sqlalchemy.select(table)).all())
    assert {row.document_digest for row in rows} == {clip.parts["motion"].document for clip in clips}
    assert {row.item_id for row in rows} == {rig.id}


def test_an_upgrade_records_the_items_that_jobs_name(desk: Desk, database_url: str) -> None:
    things = desk.things(3)
    parent = desk.submit("square", inputs={"things": tuple({"item": one} for one in things)}, into="out")
    desk.submit("errand")
    lease = desk.claim()
    desk.stage(lease, "half")
    desk.complete(lease)

    def recorded(tx: Transaction) -> set[tuple[str, str]]:
        rows = tx.execute(sqlalchemy.select(metadata.tables["job_item"]))
        return {(row.job_id, row.item_id) for row in rows}

    before = desk.database.read(SYSTEM, recorded)
    made = desk.outputs(parent)[0].item
    assert {item for _, item in before} == {*things, made}
    assert (lease.job, made) in before
    with desk.database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0022")
    schema.upgrade_schema(database_url)
    assert desk.database.read(SYSTEM, recorded) == before


def test_an_upgrade_records_many_items_of_jobs_in_portions(desk: Desk, database_url: str) -> None:
    named = [{"item": f"study_{number:026}"} for number in range(2500)]
    for number in range(12):
        desk.submit("errand", message=str(number))
    job, job_item = metadata.tables["job"], metadata.tables["job_item"]
    with desk.database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0022")
        connection.execute(sqlalchemy.update(job).values(inputs={"things": named}))
    portions: list[int] = []

    def note(_c: object, _cursor: object, statement: str, parameters: Sized, *_: object) -> None:
        if statement.startswith("INSERT INTO job_item"):
            portions.append(len(parameters))

    sqlalchemy.event.listen(sqlalchemy.Engine, "before_cursor_execute", note)
    try:
        schema.upgrade_schema(database_url)
    finally:
        sqlalchemy.event.remove(sqlalchemy.Engine, "before_cursor_execute", note)
    assert max(portions) <= 1000
    counted = sqlalchemy.select(sqlalchemy.func.count()).select_from(job_item)
    assert desk.database.read(SYSTEM, lambda tx: tx.execute(counted).scalar_one()) == 12 * len(named)


def test_an_upgrade_that_fails_leaves_the_database_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_tx: Transaction) -> None:
        raise RuntimeError("power cut")

    monkeypatch.setattr(schema, "make_server_key", fail)
    with pytest.raises(RuntimeError):
        schema.upgrade_schema(f"sqlite:///{tmp_path}/half.db")
    database = Database(f"sqlite:///{tmp_path}/half.db")
    with database.engine.connect() as connection:
        assert sqlalchemy.inspect(connection).get_table_names() == []
    database.close()
