"""Rights of roles in a project."""

from typing import Any

import pytest
from tests.support.present import present
from tests.support.store_fixtures import Lab, declared, requiring

from marey_schemas.access import MemberChange, ProjectChange, ProjectCreate, Role, Visibility
from marey_server.access.principal import Principal
from marey_server.access.roles import RequiredRole
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    NotFoundProblem,
    PreconditionFailedProblem,
    UnauthenticatedProblem,
)
from marey_server.store import members, projects

ROLES = list(Role)


OWNERS = declared("DELETE", "/projects/{project}")
MEMBERS_ONLY = declared("GET", "/projects/{project}/members")


def allowed(lab: Lab, who: Principal, need: Role, scope: str = "read", *, public: bool = True) -> int:
    required = RequiredRole(need, scope, guests=public)
    try:
        lab.database.read(who, requiring(required, projects.require), "lab")
    except (NotFoundProblem, ForbiddenProblem, UnauthenticatedProblem) as error:
        return error.status
    return 200


def test_each_role_includes_the_ones_before_it_and_no_more(lab: Lab) -> None:
    for position, role in enumerate(ROLES):
        who = getattr(lab, role.value)
        for need_position, need in enumerate(ROLES):
            assert allowed(lab, who, need) == (200 if need_position <= position else 403), (role, need)


def test_a_private_project_does_not_exist_for_those_who_are_not_in_it(lab: Lab) -> None:
    for who in (lab.stranger, lab.anonymous):
        for need in ROLES:
            assert allowed(lab, who, need) == 404
    with pytest.raises(NotFoundProblem) as hidden:
        lab.read(projects.read_project, "lab", who=lab.stranger)
    with pytest.raises(NotFoundProblem) as absent:
        lab.read(projects.read_project, "nope", who=lab.stranger)
    assert hidden.value.detail.replace("lab", "nope") == absent.value.detail


def test_everybody_reads_a_public_project_and_nothing_more(lab: Lab) -> None:
    lab.make_public()
    assert allowed(lab, lab.anonymous, Role.READER) == 200
    assert allowed(lab, lab.stranger, Role.READER) == 200
    assert allowed(lab, lab.anonymous, Role.CONTRIBUTOR, "write") == 401
    assert allowed(lab, lab.stranger, Role.CONTRIBUTOR, "write") == 403
    assert allowed(lab, lab.stranger, Role.READER, public=False) == 403
    assert allowed(lab, lab.reader, Role.READER, public=False) == 200


def test_administrators_act_as_owners_everywhere(lab: Lab) -> None:
    assert allowed(lab, lab.sign_up("chief", administrator=True), Role.OWNER, "write") == 200


def test_a_credential_reaches_no_further_than_its_scopes(lab: Lab) -> None:
    def narrowed(*scopes: Any) -> Principal:
        return Principal("user", lab.owner.user_id, lab.owner.user_name, scopes=scopes)

    assert allowed(lab, narrowed("read"), Role.OWNER) == 200
    assert allowed(lab, narrowed("read"), Role.OWNER, "write") == 403
    assert allowed(lab, narrowed("read!project=lab"), Role.READER) == 200
    assert allowed(lab, narrowed("read", "write!project=lab"), Role.OWNER, "write") == 200
    assert allowed(lab, narrowed("read", "write!project=other"), Role.OWNER, "write") == 403
    assert allowed(lab, narrowed("read!project=other"), Role.READER) == 404
    assert allowed(lab, narrowed(), Role.READER) == 404


def test_an_attempt_reads_its_own_project_and_does_nothing_else(lab: Lab) -> None:
    project_id = lab.read(projects.read_project, "lab").id
    mine = Principal("attempt", lab.owner.user_id, scopes=("read",), job_id="job_1", fence=1, project_id=project_id)
    other = Principal("attempt", lab.owner.user_id, scopes=("read",), job_id="job_1", fence=1, project_id="project_x")
    assert allowed(lab, mine, Role.READER) == 200
    assert allowed(lab, mine, Role.CONTRIBUTOR) == 403
    assert allowed(lab, mine, Role.READER, "write") == 403
    assert allowed(lab, other, Role.READER) == 404


def test_lists_show_what_may_be_read_and_the_callers_role(lab: Lab) -> None:
    lab.write(projects.create_project, ProjectCreate(name="open", visibility=Visibility.PUBLIC), who=lab.stranger)

    def listed(who: Principal) -> dict[str, Any]:
        return {found.name: found.role for found in lab.read(projects.list_projects, who=who).items}

    assert listed(lab.reader) == {"lab": Role.READER, "open": None}
    assert listed(lab.stranger) == {"open": Role.OWNER}
    assert listed(lab.anonymous) == {"open": None}
    bound = Principal("user", lab.owner.user_id, lab.owner.user_name, scopes=("read!project=open",))
    assert listed(bound) == {"open": None}


def test_lists_of_projects_come_in_pages(lab: Lab) -> None:
    for number in range(5):
        lab.write(projects.create_project, ProjectCreate(name=f"p{number}"))
    seen, cursor = [], None
    while True:
        page = lab.read(projects.list_projects, limit=2, cursor=cursor)
        seen += [found.name for found in page.items]
        cursor = page.next_cursor
        if cursor is None:
            break
    assert seen == ["lab", "p0", "p1", "p2", "p3", "p4"]


def test_names_are_unique_among_living_projects(lab: Lab) -> None:
    with pytest.raises(ConflictProblem) as taken:
        lab.write(projects.create_project, ProjectCreate(name="lab"), who=lab.stranger)
    assert taken.value.error_code == "name-taken"
    lab.write(projects.delete_project, "lab", expected_rev=None)
    again = lab.write(projects.create_project, ProjectCreate(name="lab"), who=lab.stranger)
    with pytest.raises(ConflictProblem):
        lab.write(projects.restore_project, "lab")
    lab.write(projects.delete_project, "lab", expected_rev=None, who=lab.stranger)
    assert lab.write(projects.restore_project, "lab", who=lab.stranger).id == again.id


def test_a_deleted_project_is_gone_until_an_owner_restores_it(lab: Lab) -> None:
    before = lab.read(projects.read_project, "lab")
    lab.write(projects.delete_project, "lab", expected_rev=before.rev)
    assert allowed(lab, lab.owner, Role.READER) == 404
    with pytest.raises(ForbiddenProblem):
        lab.write(projects.restore_project, "lab", who=lab.reader, required=OWNERS)
    with pytest.raises(NotFoundProblem):
        lab.write(projects.restore_project, "lab", who=lab.stranger)
    assert lab.write(projects.restore_project, "lab").id == before.id
    assert allowed(lab, lab.reader, Role.READER) == 200


def test_a_change_of_a_state_that_has_passed_is_refused_and_changes_nothing(lab: Lab) -> None:
    before = lab.read(projects.read_project, "lab")
    lab.write(projects.change_project, "lab", ProjectChange(title="First"), expected_rev=before.rev)
    with pytest.raises(PreconditionFailedProblem) as failed:
        lab.write(projects.change_project, "lab", ProjectChange(title="Second"), expected_rev=before.rev)
    assert failed.value.context == {"rev": before.rev + 1}
    assert lab.read(projects.read_project, "lab").title == "First"


def test_absent_fields_stay(lab: Lab) -> None:
    lab.write(projects.change_project, "lab", ProjectChange(title="T", description="d"), expected_rev=None)
    lab.write(projects.change_project, "lab", ProjectChange(visibility=Visibility.PUBLIC), expected_rev=None)
    after = lab.read(projects.read_project, "lab")
    assert (after.title, after.description, after.visibility) == ("T", "d", Visibility.PUBLIC)


def test_members_are_known_to_members_only(lab: Lab) -> None:
    lab.make_public()
    names = [one.user for one in lab.read(members.list_members, "lab", who=lab.reader).items]
    assert names == sorted(present(who.user_name) for who in (lab.owner, lab.maintainer, lab.contributor, lab.reader))
    for who in (lab.stranger, lab.anonymous):
        with pytest.raises((ForbiddenProblem, UnauthenticatedProblem)):
            lab.read(members.list_members, "lab", who=who, required=MEMBERS_ONLY)


def test_only_owners_change_members(lab: Lab) -> None:
    for who in (lab.reader, lab.contributor, lab.maintainer):
        with pytest.raises(ForbiddenProblem):
            lab.write(
                members.put_member,
                "lab",
                lab.stranger.user_name,
                MemberChange(role=Role.READER),
                who=who,
                required=OWNERS,
            )


def test_a_project_keeps_an_owner(lab: Lab) -> None:
    owner = lab.owner.user_name
    with pytest.raises(ConflictProblem) as refused:
        lab.write(members.put_member, "lab", owner, MemberChange(role=Role.READER))
    assert refused.value.error_code == "last-owner"
    with pytest.raises(ConflictProblem):
        lab.write(members.remove_member, "lab", owner, expected_rev=None)
    assert lab.read(members.read_member, "lab", owner).role is Role.OWNER
    lab.write(members.put_member, "lab", lab.reader.user_name, MemberChange(role=Role.OWNER))
    lab.write(members.remove_member, "lab", owner, expected_rev=None)
    assert allowed(lab, lab.owner, Role.READER) == 404


def test_membership_changes_honour_their_preconditions(lab: Lab) -> None:
    name = lab.reader.user_name
    before = lab.read(members.read_member, "lab", name)
    with pytest.raises(PreconditionFailedProblem):
        lab.write(members.put_member, "lab", name, MemberChange(role=Role.OWNER), absent=True)
    changed = lab.write(members.put_member, "lab", name, MemberChange(role=Role.OWNER), expected_rev=before.rev)
    with pytest.raises(PreconditionFailedProblem):
        lab.write(members.remove_member, "lab", name, expected_rev=before.rev)
    lab.write(members.remove_member, "lab", name, expected_rev=changed.rev)
    with pytest.raises(NotFoundProblem):
        lab.read(members.read_member, "lab", name)
    with pytest.raises(NotFoundProblem):
        lab.write(members.put_member, "lab", "nobody", MemberChange(role=Role.READER))
