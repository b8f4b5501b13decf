"""Folders that are moved, deleted and restored while other requests write to them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from tests.support.interleaving import Abandoned, Step, interleave
from tests.support.store_fixtures import Lab, requiring, skeleton_tree

from marey_schemas.access import EVERY_MEMBER, FolderRoleChange, Role
from marey_schemas.items import CollectionChange, CollectionCreate, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.roles import RequiredRole
from marey_server.errors import ApiProblem
from marey_server.store import collections, items, projects
from marey_server.store.database.connections import Database
from marey_server.store.folder_roles import managing
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.items import ItemFilters
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

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
    """Return a function that creates a skeleton in a folder, which it creates if necessary."""
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
    """The rollback releases the lock that keeps the roles in folders as they are, so another request may set one."""
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
