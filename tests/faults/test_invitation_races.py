"""Concurrent uses of invitations: one person gets the last use, or nobody if the inviter loses the right to invite."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import func, select
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import Lab, declared

from marey_schemas.access import MemberChange, Role
from marey_schemas.invitations import (
    AcceptedInvitation,
    AccountInvitationCreate,
    InvitationCreate,
    NewInvitation,
    SignedUp,
    SignUp,
)
from marey_server.access.principal import ANONYMOUS, SYSTEM, Principal
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import members, projects, users
from marey_server.store.database.connections import Database
from marey_server.store.invitations import accepting, issuing
from marey_server.store.tables import member, user
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

Act = Callable[[Transaction], object]
OWN = declared("POST", "/projects/{project}/invitations")
CROWD = 6


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again as another server process would open it."""
    return open_database()


def invite(lab: Lab, role: Role = Role.CONTRIBUTOR, *, uses: int = 1, who: Principal | None = None) -> NewInvitation:
    request = InvitationCreate(role=role, uses=uses)
    made: NewInvitation = lab.write(issuing.create_invitation, "lab", request, who=who, required=OWN)
    return made


def invite_person(lab: Lab, chief: Principal) -> NewInvitation:
    """Invite a person to create an account, without a project; so transactions can lock only the invitation."""
    request = AccountInvitationCreate()
    made: NewInvitation = lab.write(issuing.create_account_invitation, request, who=chief, required=OWN)
    return made


def accepts(code: str) -> Act:
    return lambda tx: accepting.accept_invitation(tx, code, accepting.try_of(code, "10.0.0.1", 10))


def signs_up(code: str, name: str) -> Act:
    request = SignUp.model_validate({"code": code, "name": name, "password": "correct horse"})
    return lambda tx: accepting.sign_up(tx, request, "scrypt$x", accepting.try_of(code, "10.0.0.1", 10))


def count_members(lab: Lab) -> int:
    return len(lab.read(members.list_members, "lab").items)


@pytest.mark.parametrize("commit", [True, False])
def test_the_last_use_lets_in_exactly_one_of_two(lab: Lab, other: Database, commit: bool) -> None:
    made, second = invite(lab), lab.sign_up("second")
    before = count_members(lab)
    won, lost = interleave(
        Step(lab.database, lab.stranger, accepts(made.code)), Step(other, second, accepts(made.code)), commit=commit
    )
    if commit:
        assert isinstance(won, AcceptedInvitation)
        assert isinstance(lost, NotFoundProblem)
        assert lost.error_code == "invitation-invalid"
    else:
        assert isinstance(lost, AcceptedInvitation)
    assert count_members(lab) == before + 1


def test_the_same_person_twice_at_once_uses_an_invitation_once(lab: Lab, other: Database) -> None:
    made = invite(lab, uses=2)
    one, two = interleave(
        Step(lab.database, lab.stranger, accepts(made.code)), Step(other, lab.stranger, accepts(made.code))
    )
    assert one == two == AcceptedInvitation(project="lab", role=Role.CONTRIBUTOR, joined=True)
    page = lab.read(issuing.list_invitations, "lab", cursor=None, limit=5, required=OWN)
    assert [left.uses_left for left in page.items] == [1]


def test_two_invitations_at_once_give_the_higher_role_and_the_lower_one_is_not_used(lab: Lab, other: Database) -> None:
    high, low = invite(lab, Role.MAINTAINER), invite(lab, Role.READER)
    one, two = interleave(
        Step(lab.database, lab.stranger, accepts(high.code)), Step(other, lab.stranger, accepts(low.code))
    )
    assert (one.role, one.joined) == (Role.MAINTAINER, True)
    assert (two.role, two.joined) == (Role.MAINTAINER, False)
    found = {member.user: member.role for member in lab.read(members.list_members, "lab").items}
    assert found[str(lab.stranger.user_name)] is Role.MAINTAINER


def test_a_crowd_gets_in_as_often_as_there_are_uses(lab: Lab, other: Database) -> None:
    made = invite(lab, uses=2)
    crowd = [lab.sign_up(f"guest-{number}") for number in range(CROWD)]
    before = count_members(lab)

    def enter(number: int) -> bool:
        database = (lab.database, other)[number % 2]
        try:
            database.write(crowd[number], accepts(made.code))
        except NotFoundProblem:
            return False
        return True

    with ThreadPoolExecutor(CROWD) as threads:
        entered = list(threads.map(enter, range(CROWD)))
    assert entered.count(True) == 2
    assert count_members(lab) == before + 2


def test_two_people_with_one_invitation_create_one_account(lab: Lab, other: Database) -> None:
    made = invite_person(lab, lab.sign_up("chief", administrator=True))
    won, lost = interleave(
        Step(lab.database, ANONYMOUS, signs_up(made.code, "ada")), Step(other, ANONYMOUS, signs_up(made.code, "ben"))
    )
    assert isinstance(won, SignedUp)
    assert isinstance(lost, NotFoundProblem)
    assert names(lab) >= {"ada"}
    assert "ben" not in names(lab)


def test_two_invitations_create_one_account_of_a_name_and_the_other_stays_open(lab: Lab, other: Database) -> None:
    chief = lab.sign_up("chief", administrator=True)
    one, two = invite_person(lab, chief), invite_person(lab, chief)
    won, lost = interleave(
        Step(lab.database, ANONYMOUS, signs_up(one.code, "ada")), Step(other, ANONYMOUS, signs_up(two.code, "ada"))
    )
    assert isinstance(won, SignedUp)
    assert isinstance(lost, ConflictProblem)
    lab.database.write(ANONYMOUS, signs_up(two.code, "ben"))


def names(lab: Lab) -> set[str]:
    return set(lab.database.read(SYSTEM, lambda tx: tx.execute(select(user.c.name)).scalars().all()))


@pytest.mark.parametrize("loss", ["removal", "disabling", "deletion", "withdrawal"])
def test_an_acceptance_during_the_loss_of_the_right_to_invite_is_refused(lab: Lab, other: Database, loss: str) -> None:
    inviter, chief = str(lab.maintainer.user_name), lab.sign_up("chief", administrator=True)
    lab.write(members.put_member, "lab", inviter, MemberChange(role=Role.OWNER), required=OWN)
    made = invite(lab, who=lab.maintainer)
    losses: dict[str, tuple[Principal, Act]] = {
        "removal": (lab.owner, lambda tx: members.remove_member(tx, "lab", inviter, expected_rev=None)),
        "disabling": (chief, lambda tx: users.delete_user(tx, inviter, expected_rev=None)),
        "deletion": (lab.owner, lambda tx: projects.delete_project(tx, "lab", expected_rev=None)),
        "withdrawal": (lab.owner, lambda tx: issuing.withdraw_invitation(tx, "lab", made.prefix)),
    }
    _, refused = interleave(
        Step(lab.database, *losses[loss]), Step(other, lab.stranger, accepts(made.code))
    )  # fmt: skip
    assert isinstance(refused, NotFoundProblem)
    assert refused.error_code == "invitation-invalid"
    joined = select(func.count()).where(member.c.user_id == lab.stranger.user_id)
    assert lab.database.read(SYSTEM, lambda tx: tx.execute(joined).scalar_one()) == 0


@pytest.mark.parametrize("loss", ["removal", "disabling", "deletion"])
def test_a_loss_during_an_acceptance_waits_for_it_and_both_succeed(lab: Lab, other: Database, loss: str) -> None:
    inviter, chief = str(lab.maintainer.user_name), lab.sign_up("chief", administrator=True)
    lab.write(members.put_member, "lab", inviter, MemberChange(role=Role.OWNER), required=OWN)
    made = invite(lab, who=lab.maintainer, uses=2)
    losses: dict[str, tuple[Principal, Act]] = {
        "removal": (lab.owner, lambda tx: members.remove_member(tx, "lab", inviter, expected_rev=None)),
        "disabling": (chief, lambda tx: users.delete_user(tx, inviter, expected_rev=None)),
        "deletion": (lab.owner, lambda tx: projects.delete_project(tx, "lab", expected_rev=None)),
    }
    joined, lost = interleave(Step(lab.database, lab.stranger, accepts(made.code)), Step(other, *losses[loss]))
    assert isinstance(joined, AcceptedInvitation)
    assert lost is None
    with pytest.raises(NotFoundProblem):
        lab.database.write(lab.sign_up("late"), accepts(made.code))
