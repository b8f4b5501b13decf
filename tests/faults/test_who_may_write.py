"""Roles in folders: random calls compared with a model, and concurrent changes of roles.

Planted defects must be found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from sqlalchemy import select
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import WRITE, Lab, declared, requiring, skeleton_tree
from tests.support.tiers import is_soak
from tests.support.who_may_write import WritingProgram

from marey_schemas.access import EVERY_MEMBER, FolderRoleChange, MemberChange, Role
from marey_schemas.items import CollectionCreate, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access import folder_rights
from marey_server.access.folder_rights import FolderRights
from marey_server.errors import ForbiddenProblem, NotFoundProblem
from marey_server.store import collections, items, members, projects
from marey_server.store.database.connections import Database
from marey_server.store.folder_roles import managing, rights
from marey_server.store.items import changing
from marey_server.store.tables import item
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.timeout(1200)

SEED = 20261126
CALLS = 20_000 if is_soak() else 300
CALLS_TO_FIND_A_HOLE = 1_500
BY_STATE = rights._by_state


@pytest.mark.every_database
def test_every_member_writes_where_the_model_says(lab: Lab) -> None:
    program = WritingProgram(lab, SEED)
    program.run(CALLS)
    assert program.differences == []
    assert min(program.allowed, program.refused) > CALLS / 10


def _the_role_of_the_project_counts(self: FolderRights, _path: str, _deleted_us: int | None = None) -> Role:
    return self.role


def _only_the_folder_itself_counts(path: str) -> list[str]:
    return [path]


def _subfolders_are_forgotten(self: FolderRights, path: str, needed: Role) -> None:
    self.require(path, needed)


def _roles_of_all_members_are_forgotten(rows: Any) -> Mapping[Any, Any]:
    return BY_STATE([row for row in rows if row.user_id != EVERY_MEMBER])


def _the_target_is_forgotten(tx: Transaction, project_row: Any) -> Any:
    class Careless(FolderRights):
        def require(self, path: str, needed: Role, deleted_us: int | None = None) -> None:
            """Replace the check of roles by one that allows everything."""

    return Careless(project_row.name, Role.OWNER)


def _nobody_is_raised(*_args: Any) -> bool:
    return False


HOLES: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "roles in folders do not count": (FolderRights, "role_in", _the_role_of_the_project_counts),
    "roles do not hold below their folder": (folder_rights, "with_ancestors", _only_the_folder_itself_counts),
    "a move takes protected subfolders along": (FolderRights, "require_below", _subfolders_are_forgotten),
    "a role for all members has no effect": (rights, "_by_state", _roles_of_all_members_are_forgotten),
    "items are changed without a check": (changing, "rights_of_caller", _the_target_is_forgotten),
    "a folder is created and moved without a check": (collections, "rights_of_caller", _the_target_is_forgotten),
    "readers are never admitted": (projects, "_has_role_in_a_folder", _nobody_is_raised),
}


@pytest.mark.soak
@pytest.mark.parametrize("hole", HOLES)
def test_a_planted_hole_is_found(lab: Lab, monkeypatch: pytest.MonkeyPatch, hole: str) -> None:
    monkeypatch.setattr(*HOLES[hole])
    program = WritingProgram(lab, SEED)
    program.run(CALLS_TO_FIND_A_HOLE)
    assert program.differences


# -- races ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again as another server process would open it."""
    return open_database()


def put_role(folder: str, role: str, user: str = EVERY_MEMBER) -> Callable[[Transaction], object]:
    """Return a function that sets the role of a member, or of all members, in a folder."""
    change = FolderRoleChange.model_validate({"role": role})
    return lambda tx: managing.put_folder_role(tx, "lab", folder, user, change)


def end_role(how: str, user: str) -> Callable[[Transaction], object]:
    """Return a function that removes a member, or makes the member a reader."""
    if how == "removed":
        return lambda tx: members.remove_member(tx, "lab", user, expected_rev=None)
    return lambda tx: members.put_member(tx, "lab", user, MemberChange(role=Role.READER))


def create_item(tx: Transaction) -> object:
    request = ItemCreate(name="rig", collection="delivered/monday", parts={"hierarchy": skeleton_tree()})
    return requiring(WRITE, items.create_item)(tx, "lab", Kind.SKELETON, request)


def count_items(tx: Transaction) -> int:
    return len(tx.execute(select(item.c.id)).all())


@pytest.mark.every_database
@pytest.mark.parametrize("first", ["the item", "the role"])
def test_an_item_is_created_before_its_folder_is_protected_or_not_at_all(lab: Lab, other: Database, first: str) -> None:
    folder = lab.write(collections.create_collection, "lab", CollectionCreate(path="delivered")).id
    seen: list[int] = []

    def protect(tx: Transaction) -> None:
        put_role(folder, "reader")(tx)
        seen.append(count_items(tx))

    steps = [Step(lab.database, lab.contributor, create_item), Step(other, lab.owner, protect)]
    made, _ = interleave(*steps) if first == "the item" else reversed(interleave(*reversed(steps)))
    after = lab.read(count_items)
    assert isinstance(made, ForbiddenProblem) == (first == "the role")
    assert seen == [after]


@pytest.mark.every_database
@pytest.mark.parametrize("first", ["the item", "the role"])
def test_a_reader_writes_only_before_the_role_in_the_folder_is_withdrawn(lab: Lab, other: Database, first: str) -> None:
    folder = lab.write(collections.create_collection, "lab", CollectionCreate(path="delivered")).id
    reader = str(lab.reader.user_name)
    lab.database.write(lab.owner, put_role(folder, "contributor", reader))

    def withdraw(tx: Transaction) -> None:
        managing.remove_folder_role(tx, "lab", folder, reader, expected_rev=None)

    def create(tx: Transaction) -> object:
        tx.required_role = declared("POST", "/projects/{project}/{kind}")
        request = ItemCreate(name="rig", collection="delivered", parts={"hierarchy": skeleton_tree()})
        return items.create_item(tx, "lab", Kind.SKELETON, request)

    steps = [Step(lab.database, lab.reader, create), Step(other, lab.owner, withdraw)]
    made, _ = interleave(*steps) if first == "the item" else reversed(interleave(*reversed(steps)))
    assert isinstance(made, ForbiddenProblem) == (first == "the role")


@pytest.mark.every_database
@pytest.mark.parametrize("how", ["removed", "a reader"])
def test_a_member_whose_role_ends_before_the_rights_are_read_writes_nothing(
    lab: Lab, other: Database, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """The role ends after the request has found the member in the project, and before the request reads the rights.

    On SQLite, nobody else can write during the request, so the role ends before the request.
    """
    lab.write(collections.create_collection, "lab", CollectionCreate(path="delivered"))
    user = str(lab.contributor.user_name)
    if lab.database.is_sqlite:  # on which no other request can write meanwhile
        lab.database.write(lab.owner, end_role(how, user))

    def late_rights(tx: Transaction, project_row: Any) -> FolderRights:
        if tx.is_postgres:
            other.write(lab.owner, end_role(how, user))
        return rights.rights_of_caller(tx, project_row)

    monkeypatch.setattr(changing, "rights_of_caller", late_rights)
    with pytest.raises((ForbiddenProblem, NotFoundProblem)):
        lab.database.write(lab.contributor, create_item)
    assert lab.read(count_items) == 0


@pytest.mark.every_database
@pytest.mark.parametrize("how", ["removed", "a reader"])
def test_the_role_of_a_member_ends_after_the_writes_that_have_read_it(lab: Lab, other: Database, how: str) -> None:
    seen: list[int] = []

    def end(tx: Transaction) -> None:
        end_role(how, str(lab.contributor.user_name))(tx)
        seen.append(count_items(tx))

    made, _ = interleave(Step(lab.database, lab.contributor, create_item), Step(other, lab.owner, end))
    assert not isinstance(made, Exception)
    assert seen == [1]
