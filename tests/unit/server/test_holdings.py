"""Items and bytes of projects and users: counted exactly, limited by quotas, and subtracted after deletion."""

import os
import random
from collections.abc import Sequence
from typing import Any

import pytest
import sqlalchemy
from alembic import command
from tests.support.store_fixtures import WRITE, Lab, requiring, skeleton_tree

from marey_schemas.access import ProjectQuotaChange, QuotaChange
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.errors import ConflictProblem, ForbiddenProblem, NotFoundProblem, QuotaExceededProblem
from marey_server.store import blobs, collections, items, projects, users
from marey_server.store.database import schema
from marey_server.store.database.connections import Database
from marey_server.store.fsck import check_store
from marey_server.store.tables import document, holding, item
from marey_server.store.transaction import Quotas, Transaction

pytestmark = pytest.mark.every_database


def read_rows(database: Database, *tables: sqlalchemy.Table) -> list[Sequence[Any]]:
    with database.engine.connect() as connection:
        return [connection.execute(table.select().order_by(*table.primary_key)).all() for table in tables]


def create(tx: Transaction, project: str, name: str) -> Any:
    request = ItemCreate(name=name, parts={"hierarchy": skeleton_tree()})
    return items.create_item(tx, project, Kind.SKELETON, request)


@pytest.mark.parametrize("of", ["project", "user"])
@pytest.mark.parametrize("quota", ["items", "stored_bytes"])
def test_writers_at_the_same_time_never_exceed_a_quota_together(lab: Lab, of: str, quota: str) -> None:
    first = lab.write(create, lab.name, "first")
    (row,) = read_rows(lab.database, item)[0]
    each = 1 if quota == "items" else row.stored_bytes
    lab.database.quotas = Quotas(**{f"{of}_{quota}": 3 * each - 1 if each > 1 else 2})
    write = requiring(WRITE, create)
    futures = [lab.database.submit_write(lab.owner, write, lab.name, f"n{at}") for at in range(6)]
    errors = [error for future in futures if (error := future.exception(60)) is not None]
    assert len(errors) == 5
    for error in errors:
        assert isinstance(error, QuotaExceededProblem)
        limit = getattr(lab.database.quotas, f"{of}_{quota}")
        assert error.context == {"quota": f"{of}_{quota}", "used": 2 * each, "limit": limit}
        assert f"marey {of} quota" in error.detail
    lab.write(items.delete_item, lab.name, Kind.SKELETON, first.id, expected_rev=None)
    lab.write(create, lab.name, "again")
    with pytest.raises(QuotaExceededProblem):
        lab.write(items.restore_item, lab.name, Kind.SKELETON, first.id)


def test_administrators_change_limits_of_a_project_and_a_user(lab: Lab) -> None:
    root = lab.sign_up("root", administrator=True)
    lab.database.quotas = Quotas(project_items=2, user_items=2)
    change_project = requiring(WRITE, projects.change_quotas)
    for who in (lab.owner, lab.stranger):
        with pytest.raises((ForbiddenProblem, NotFoundProblem)):
            lab.write(change_project, lab.name, ProjectQuotaChange(items=9), who=who)
        with pytest.raises(ForbiddenProblem):
            lab.write(users.change_quotas, lab.owner.user_name, QuotaChange(items=9), who=who)
    lab.write(projects.change_quotas, lab.name, ProjectQuotaChange(items=3, stored_bytes=10**6), who=root)
    lab.write(projects.change_quotas, lab.name, ProjectQuotaChange(stored_bytes=10**7), who=root)
    shown = lab.write(users.change_quotas, lab.owner.user_name, QuotaChange(items=3), who=root)
    assert (shown.items.used, shown.items.allowed) == (0, 3)
    for name in "abc":
        lab.write(create, lab.name, name)
    with pytest.raises(QuotaExceededProblem, match="the limit is 3"):
        lab.write(create, lab.name, "d")
    shown = lab.read(projects.read_quotas, lab.name, who=lab.reader)
    assert (shown.items.used, shown.items.allowed, shown.stored_bytes.allowed) == (3, 3, 10**7)
    shown = lab.write(projects.change_quotas, lab.name, ProjectQuotaChange(items=None), who=root)
    assert (shown.items.allowed, shown.stored_bytes.allowed) == (2, 10**7)
    with pytest.raises(QuotaExceededProblem, match="the limit is 2"):
        lab.write(create, lab.name, "d")
    limited = [event.body for event in lab.events() if event.kind == "project.limited"]
    assert limited[-1]["limits"] == {"stored_bytes": 10**7}


def test_lower_limits_than_use_refuse_more_but_not_deletion(lab: Lab) -> None:
    root = lab.sign_up("root", administrator=True)
    first = lab.write(create, lab.name, "first")
    lab.write(projects.change_quotas, lab.name, ProjectQuotaChange(items=0, stored_bytes=0), who=root)
    with pytest.raises(QuotaExceededProblem, match="The project has 1 items, the limit is 0"):
        lab.write(create, lab.name, "again")
    lab.write(items.delete_item, lab.name, Kind.SKELETON, first.id, expected_rev=None)
    assert lab.read(projects.read_quotas, lab.name).items.used == 0


def change_at_random(lab: Lab, draw: random.Random, number: int) -> None:
    """Create, revise, delete or restore an item or a collection, sometimes in a write that fails."""
    who = draw.choice((lab.owner, lab.contributor))
    found = [*lab.read(items.list_items, lab.name, Kind.SKELETON).items]
    action = draw.choice(("create", "create", "fail", "revise", "delete", "restore", "folder"))
    place = draw.choice(("", "a", "a/b"))
    request = ItemCreate(name=f"n{number}", collection=place, parts={"hierarchy": skeleton_tree(draw.randint(2, 4))})
    if action == "create" or not found:
        lab.write(items.create_item, lab.name, Kind.SKELETON, request, who=who)
    elif action == "fail":
        taken = request.model_copy(update={"name": found[0].name, "collection": found[0].collection})
        with pytest.raises(ConflictProblem):
            lab.write(items.create_item, lab.name, Kind.SKELETON, taken, who=who)
    elif action == "revise":
        chosen, tree = draw.choice(found), skeleton_tree(draw.randint(2, 4))
        lab.write(items.put_part, lab.name, Kind.SKELETON, chosen.id, "hierarchy", tree, expected_rev=None, who=who)
    elif action == "folder":
        folders = [one for one in lab.read(collections.list_collections, lab.name).items if one.path]
        if folders:
            chosen = draw.choice(folders)
            lab.write(collections.delete_collection, lab.name, chosen.id, expected_rev=None)
            if draw.random() < 0.5:
                lab.write(collections.restore_collection, lab.name, chosen.id)
    else:
        chosen = draw.choice(found)
        lab.write(items.delete_item, lab.name, Kind.SKELETON, chosen.id, expected_rev=None)
        if action == "restore":
            lab.write(items.restore_item, lab.name, Kind.SKELETON, chosen.id)


def test_counters_equal_what_a_recount_of_an_old_database_gives(lab: Lab) -> None:
    draw = random.Random(19)
    for number in range(40):
        change_at_random(lab, draw, number)
    data = os.urandom(5000)
    digest = lab.write(blobs.put_blob, data)
    rig = lab.add_skeleton("with-file")
    info = {"schema": "marey/clip-info@1", "source": {"file": digest, "file_name": "a.bvh", "format": "bvh"}}
    clip = lab.add_clip(rig, info=info)
    assert list(check_store(lab.database)) == []
    before = read_rows(lab.database, holding, item, document)
    sizes = {row.id: row.stored_bytes for row in before[1]}
    assert sizes[clip.id] == sum(part.size_bytes for part in clip.parts.values()) + len(data)

    with lab.database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, "0009")
        command.upgrade(config, "head")
    zero = [row for row in before[0] if row.items or row.stored_bytes]
    assert read_rows(lab.database, holding, item, document) == [zero, *before[1:]]


def test_counters_that_are_wrong_are_found_and_repaired(lab: Lab) -> None:
    lab.add_clip(lab.add_skeleton())
    before = read_rows(lab.database, holding, item)
    with lab.database.engine.begin() as connection:
        connection.execute(holding.update().values(items=7, stored_bytes=0))
        connection.execute(item.update().values(stored_bytes=3))
    wrong = list(check_store(lab.database, repair=True))
    assert {defect.code for defect in wrong} == {"counter-wrong"}
    assert {defect.subject for defect in wrong} == {row[0] for rows in before for row in rows}
    assert read_rows(lab.database, holding, item) == before
    assert list(check_store(lab.database)) == []
