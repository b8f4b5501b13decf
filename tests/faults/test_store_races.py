"""Two concurrent writes in one project: changes of members, results with the same name, and callers who lose access."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import ALL_RIGHTS, Lab, skeleton_tree

from marey_schemas.access import MemberChange, Role
from marey_schemas.kinds import Kind
from marey_server.errors import ForbiddenProblem, NotFoundProblem
from marey_server.store import items, members, projects
from marey_server.store.database.connections import Database
from marey_server.store.items import Draft
from marey_server.store.items.publishing import publish
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

Act = Callable[[Transaction], object]


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again as another server process would open it."""
    return open_database()


def puts(name: str | None, role: Role) -> Act:
    return lambda tx: members.put_member(tx, "lab", str(name), MemberChange(role=role))


def removes(name: str | None) -> Act:
    return lambda tx: members.remove_member(tx, "lab", str(name), expected_rev=None)


@pytest.mark.parametrize("ousted_by", ["removal", "demotion"])
@pytest.mark.parametrize("wants", ["to add a friend", "to be owner again", "to remove the other"])
def test_an_owner_who_is_being_ousted_changes_no_member_any_more(
    lab: Lab, other: Database, ousted_by: str, wants: str
) -> None:
    stays, goes = lab.owner, lab.maintainer
    lab.write(puts(goes.user_name, Role.OWNER))
    ousting = removes(goes.user_name) if ousted_by == "removal" else puts(goes.user_name, Role.READER)
    wish = {
        "to add a friend": puts(lab.stranger.user_name, Role.OWNER),
        "to be owner again": puts(goes.user_name, Role.OWNER),
        "to remove the other": removes(stays.user_name),
    }[wants]
    _, refused = interleave(Step(lab.database, stays, ousting), Step(other, goes, wish))
    assert isinstance(refused, NotFoundProblem | ForbiddenProblem)
    found = {one.user: one.role for one in lab.read(members.list_members, "lab").items}
    assert {name for name, role in found.items() if role is Role.OWNER} == {stays.user_name}
    assert lab.stranger.user_name not in found


@pytest.mark.parametrize("commit", [True, False])
def test_two_results_of_one_name_become_two_revisions_and_neither_is_lost(
    lab: Lab, other: Database, commit: bool
) -> None:
    item = lab.add_skeleton("rig")

    def publishes(bone_m: float) -> Act:
        draft = Draft("rig", Kind.SKELETON, "rig", {"hierarchy": skeleton_tree(bone_m=bone_m)})
        return lambda tx: publish(
            tx, projects.require(tx, "lab"), [draft], author_id=tx.principal.user_id, rights=ALL_RIGHTS
        )

    interleave(Step(lab.database, lab.owner, publishes(1)), Step(other, lab.owner, publishes(2)), commit=commit)
    written = [
        lab.read(items.read_part, "lab", Kind.SKELETON, item.id, "hierarchy", revision=number, arrays="none").tree
        for number in range(1, lab.read(items.read_item, "lab", Kind.SKELETON, item.id).revision + 1)
    ]
    assert [tree["joints"][1]["offset"][1] for tree in written] == ([0.5, 1, 2] if commit else [0.5, 2])
