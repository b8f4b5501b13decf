"""The tables in the code equal those that migrations create, on both databases."""

from collections.abc import Sized
from pathlib import Path

import pytest
import sqlalchemy
import sqlalchemy.event
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, quoted_name, text
from tests.support.committing_desk import CommittingDesk
from tests.support.queue_desk import Desk, document
from tests.support.store_fixtures import Lab

from marey_schemas.datasets.commits import PutEntry
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.store import datasets, fsck, items
from marey_server.store.database import schema
from marey_server.store.database.connections import Database
from marey_server.store.datasets.committing import insert_commit
from marey_server.store.items.drafts import Draft
from marey_server.store.tables import metadata
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord

pytestmark = pytest.mark.every_database

AT = "2026-01-01T00:00:00.000000Z"


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
        assert migrated == names(connection)


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


def test_an_upgrade_keeps_commits_with_their_parents_and_events(gaits: CommittingDesk, database_url: str) -> None:
    database = gaits.desk.database
    draft = Draft("d", Kind.CHARACTER, "walk", {"character": document(content=1, name="walk")}, "raw")
    walk = gaits.desk.publish(draft)[0].item
    for number in range(4):
        gaits.change(PutEntry(path=f"walk {number}", item=walk))
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name="v1", kind=RefKind.TAG, at="main~1"))

    def insert_merge(tx: Transaction) -> None:
        row = tx.execute(sqlalchemy.select(metadata.tables["dataset"])).one()
        head = gaits.commit()
        record = CommitRecord(head.tree, (head.digest, gaits.commit("main~3").digest), "ann", "merge", AT)
        insert_commit(tx, row.id, record, entries=4, write_id="w1")
        values = {"digest": record.digest}
        tx.execute(sqlalchemy.update(metadata.tables["dataset_ref"]).where(text("name = 'main'")).values(values))

    database.write(SYSTEM, insert_merge)

    def events_of(tx: Transaction) -> object:
        return tx.execute(sqlalchemy.select(metadata.tables["event"]).order_by(text("seq"))).all()

    before, events_before = gaits.log(), database.read(SYSTEM, events_of)
    assert [len(one.parents) for one in before] == [2, 1, 1, 1, 0]
    with database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0028")
        count = sqlalchemy.text("SELECT count(*) FROM commit_parent")
        assert connection.execute(count).scalar() == 5
    schema.upgrade_schema(database_url)
    assert (gaits.log(), database.read(SYSTEM, events_of)) == (before, events_before)
    assert list(fsck.check_store(database)) == []
    gaits.change(PutEntry(path="run", item=walk))
    assert len(gaits.log()) == 6


def test_a_number_whose_event_was_deleted_by_hand_is_not_given_again_after_the_upgrade(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/old.db"
    schema.upgrade_schema(url)
    database = Database(url)
    event = metadata.tables["event"]
    values = {"at_us": 1, "kind": "old", "subject": "s", "body": {}}
    with database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0028")
        connection.execute(sqlalchemy.insert(event), [values | {"seq": seq} for seq in (1, 2, 9)])
        connection.execute(sqlalchemy.delete(event).where(event.c.seq == 9))
        command.upgrade(config, "head")
        connection.execute(sqlalchemy.insert(event), values)
        assert connection.execute(sqlalchemy.select(event.c.seq).order_by(event.c.seq)).scalars().all() == [1, 9, 10]
    database.close()


def test_migrated_tables_of_sqlite_have_rowids_where_those_of_the_code_have_them(tmp_path: Path) -> None:
    def found(connection: Connection) -> dict[str, int]:
        rows = connection.exec_driver_sql("SELECT name, wr FROM pragma_table_list WHERE schema = 'main'")
        return {name: without_rowid for name, without_rowid in rows if "alembic" not in name}

    schema.upgrade_schema(f"sqlite:///{tmp_path}/migrated.db")
    migrated, made = (Database(f"sqlite:///{tmp_path}/{name}.db") for name in ("migrated", "made"))
    with migrated.engine.connect() as of_migrations, made.engine.connect() as of_code:
        metadata.create_all(of_code)
        expected = found(of_code)
        assert sum(expected.values()) == 1
        assert found(of_migrations).keys() - expected.keys() <= {"sqlite_sequence"}
        assert {name: found(of_migrations)[name] for name in expected} == expected
    migrated.close()
    made.close()


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
