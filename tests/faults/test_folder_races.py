"""Folders that are moved, deleted and restored while other requests write to them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillRunning
from typing import Any

import pytest
from tests.support.interleaving import HEAD_START_S, Abandoned, Step, interleave
from tests.support.patience import PATIENCE_S
from tests.support.store_fixtures import WRITE, Lab, declared, requiring, skeleton_tree

from marey_schemas.access import EVERY_MEMBER, FolderRoleChange, Role
from marey_schemas.datasets.checkouts import CheckoutRequest
from marey_schemas.datasets.commits import CommitCreate
from marey_schemas.datasets.naming import DatasetCreate
from marey_schemas.items import CollectionChange, CollectionCreate, ItemChange, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.folder_rights import FolderRights
from marey_server.access.roles import RequiredRole
from marey_server.errors import ApiProblem, ForbiddenProblem
from marey_server.store import collections, datasets, items, projects
from marey_server.store.database.connections import Database
from marey_server.store.datasets import checkout
from marey_server.store.folder_roles import managing
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.items import ItemFilters, changing
from marey_server.store.projects import ProjectRow
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

CREATE_ITEM = declared("POST", "/projects/{project}/{kind}")
MAINTAIN = RequiredRole(Role.MAINTAINER, "write")

Folders = dict[str, str]


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again as another server process would open it."""
    return open_database()


def make(lab: Lab, *paths: str) -> Folders:
    """Create folders, and return their ids by path."""
    made = [lab.write(collections.create_collection, lab.name, CollectionCreate(path=path)) for path in paths]
    return {one.path: one.id for one in made}


def living(lab: Lab) -> list[str]:
    """Return the paths of all folders that are not deleted."""
    return [one.path for one in lab.read(collections.list_collections, lab.name).items]


def places(lab: Lab) -> list[str]:
    """Return the paths of all skeletons that are not deleted."""
    found = lab.read(items.list_items, lab.name, Kind.SKELETON, ItemFilters()).items
    return sorted(f"{one.collection}/{one.name}" for one in found)


def require_whole_trees(lab: Lab) -> None:
    """Check that every folder and every item is in a folder that exists."""
    paths = {"", *living(lab)}
    assert [path for path in paths if path.rpartition("/")[0] not in paths] == []
    assert [place for place in places(lab) if place.rpartition("/")[0] not in paths] == []


def puts(path: str) -> Callable[[Transaction], object]:
    """Return a function that creates a skeleton at a path, and also its folder if this does not exist."""
    request = ItemCreate(name="rig", collection=path, parts={"hierarchy": skeleton_tree()})
    return lambda tx: items.create_item(tx, "lab", Kind.SKELETON, request)


@pytest.mark.parametrize("below", ["old/x/y/z", "old/x", "old"])
@pytest.mark.parametrize("first", ["put", "delete"])
def test_what_is_put_into_a_folder_while_it_is_deleted_goes_with_it_or_stands_in_a_new_one(
    lab: Lab, other: Database, below: str, first: str
) -> None:
    folders = make(lab, "old", "old/x")

    def delete(tx: Transaction) -> None:
        collections.delete_collection(tx, "lab", folders["old"], expected_rev=None)

    steps = [Step(lab.database, lab.owner, puts(below)), Step(other, lab.owner, delete)]
    for outcome in interleave(*(steps if first == "put" else reversed(steps))):
        assert not isinstance(outcome, ApiProblem), outcome
    require_whole_trees(lab)
    if first == "put":
        assert living(lab) == []
        assert places(lab) == []


@pytest.mark.parametrize("below", ["old/x/y/z", "old/x", "old"])
@pytest.mark.parametrize("first", ["put", "move"])
def test_what_is_put_into_a_folder_while_it_moves_goes_along_or_stands_in_a_new_one(
    lab: Lab, other: Database, below: str, first: str
) -> None:
    folders = make(lab, "old", "old/x")

    def move(tx: Transaction) -> None:
        collections.move_collection(tx, "lab", folders["old"], CollectionChange(path="new"), expected_rev=None)

    steps = [Step(lab.database, lab.owner, puts(below)), Step(other, lab.owner, move)]
    for outcome in interleave(*(steps if first == "put" else reversed(steps))):
        assert not isinstance(outcome, ApiProblem), outcome
    require_whole_trees(lab)
    if first == "put":
        assert places(lab) == [f"{below.replace('old', 'new')}/rig"]


def test_rights_that_were_read_before_a_rollback_to_a_savepoint_are_read_again(lab: Lab, other: Database) -> None:
    """The rollback releases the lock on the roles in folders, so another request may then set a role."""
    protected = make(lab, "a")["a"]
    change = FolderRoleChange.model_validate({"role": "reader"})
    put = requiring(RequiredRole(Role.OWNER, "write"), managing.put_folder_role)

    def protect() -> None:
        other.write(lab.owner, put, "lab", protected, EVERY_MEMBER, change)

    def role_after_rollback(tx: Transaction) -> Role:
        row = projects.require(tx, "lab")
        with contextlib.suppress(Abandoned), tx.connection.begin_nested():
            assert rights_of_caller(tx, row).role_in("a") is (Role.CONTRIBUTOR if tx.is_postgres else Role.READER)
            raise Abandoned
        if tx.is_postgres:
            protect()
        return rights_of_caller(tx, row).role_in("a")

    if lab.database.is_sqlite:  # on which no other request can write meanwhile
        protect()
    assert lab.write(role_after_rollback, who=lab.contributor) is Role.READER


def allow(lab: Lab, folder: str, who: str, role: str) -> None:
    """Set the role of a user, or of all members, in a folder."""
    change = FolderRoleChange.model_validate({"role": role})
    lab.write(managing.put_folder_role, lab.name, folder, who, change, required=RequiredRole(Role.OWNER, "write"))


def change_folder(kind: str, folder: str) -> Callable[[Transaction], object]:
    """Return a function that moves a folder to `b/x`, or deletes or restores it."""
    if kind == "move":
        change = CollectionChange(path="b/x")
        return lambda tx: collections.move_collection(tx, "lab", folder, change, expected_rev=None)
    if kind == "delete":
        return lambda tx: collections.delete_collection(tx, "lab", folder, expected_rev=None)
    return lambda tx: collections.restore_collection(tx, "lab", folder)


@pytest.mark.parametrize("kind", ["move", "delete", "restore"])
def test_a_member_creates_an_item_with_the_role_in_the_folder_that_gets_it(
    lab: Lab, other: Database, kind: str
) -> None:
    """While a member creates an item at the folder's path, an owner moves, deletes or restores the folder."""
    folders = make(lab, "a", "b", "a/x")
    member = lab.contributor
    if kind == "delete":
        allow(lab, folders["a"], EVERY_MEMBER, "reader")
        allow(lab, folders["a/x"], str(member.user_name), "contributor")
    else:
        allow(lab, folders["a/x"], EVERY_MEMBER, "reader")
    if kind == "restore":
        lab.write(change_folder("delete", folders["a/x"]), required=MAINTAIN)
    put = requiring(CREATE_ITEM, puts("b/x" if kind == "move" else "a/x"))
    changed, refused = interleave(
        Step(lab.database, lab.owner, change_folder(kind, folders["a/x"])), Step(other, member, put)
    )
    assert not isinstance(changed, ApiProblem)
    assert isinstance(refused, ForbiddenProblem)
    assert places(lab) == []


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("act", ["put_part", "tag", "restore", "check_out"])
def test_an_item_of_a_protected_folder_is_not_changed_while_the_folder_moves(
    lab: Lab, other: Database, monkeypatch: pytest.MonkeyPatch, act: str, when: str
) -> None:
    """The folder begins to move just before or just after the member's rights are read."""
    folders = make(lab, "a", "b", "a/x")
    rig = lab.write(puts("a/x"))
    which = ("lab", Kind.SKELETON, rig.id)
    if act == "restore":
        lab.write(items.delete_item, *which, expected_rev=None, required=MAINTAIN)
    if act == "check_out":
        lab.write(datasets.create_dataset, "lab", DatasetCreate(name="d", collection="a/x"))
        prepared = lab.read(datasets.prepare_commit, "lab", "d", CommitCreate(message="m"), required=WRITE)
        lab.write(datasets.record_commit, "lab", "d", prepared)
    allow(lab, folders["a/x"], EVERY_MEMBER, "reader")
    calls: dict[str, tuple[Any, ...]] = {
        "put_part": (items.put_part, *which, "hierarchy", skeleton_tree(bone_m=0.7)),
        "tag": (items.change_item, *which, ItemChange(tags=("t",))),
        "restore": (items.restore_item, *which),
        "check_out": (datasets.check_out, "lab", "d", CheckoutRequest(version="main", discard=True)),
    }
    function, *args = calls[act]
    state = {} if act == "check_out" else {"expected_rev": None}
    module = checkout if act == "check_out" else changing
    moving: list[Future[Any]] = []

    def move_meanwhile(pool: ThreadPoolExecutor) -> None:
        if not moving:
            moving.append(pool.submit(other.write, lab.owner, change_folder("move", folders["a/x"])))
            with contextlib.suppress(StillRunning):
                moving[0].exception(HEAD_START_S)

    with ThreadPoolExecutor(1) as pool:

        def slow_rights(tx: Transaction, project_row: ProjectRow) -> FolderRights:
            if when == "before":
                move_meanwhile(pool)
            found = rights_of_caller(tx, project_row)
            if when == "after":
                move_meanwhile(pool)
            return found

        monkeypatch.setattr(module, "rights_of_caller", slow_rights)
        with pytest.raises(ForbiddenProblem):
            lab.write(function, *args, who=lab.maintainer, required=WRITE, **state)
        moving[0].result(PATIENCE_S)
    assert "b/x" in living(lab)
