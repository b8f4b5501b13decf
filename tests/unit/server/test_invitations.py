"""Invitations: who may create and use them, when they end, and that codes are stored only as hashes."""

from __future__ import annotations

import hmac
from typing import Any

import pytest
from sqlalchemy import func, select
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab, declared

from marey_schemas.access import MemberChange, Role, UserChange
from marey_schemas.invitations import (
    MAX_DAYS,
    AcceptedInvitation,
    AccountInvitationCreate,
    Invitation,
    InvitationCreate,
    NewInvitation,
    SignedUp,
    SignUp,
)
from marey_server.access.principal import ANONYMOUS, SYSTEM, Principal
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    NotFoundProblem,
    QuotaExceededProblem,
    TooManyRequestsProblem,
)
from marey_server.store import members, projects, users
from marey_server.store.credentials import sign_ins, tokens
from marey_server.store.database.connections import Database
from marey_server.store.garbage import collect_garbage
from marey_server.store.invitations import accepting, issuing
from marey_server.store.tables import event, invitation, invitation_use, metadata
from marey_server.store.transaction import Transaction

DAY_S = 86_400
ADDRESS = "10.0.0.1"
PER_MINUTE = 10
OWN = declared("POST", "/projects/{project}/invitations")
PASSWORD_HASH = "scrypt$of-a-password"


def invite(lab: Lab, role: Role = Role.CONTRIBUTOR, *, who: Principal | None = None, **terms: Any) -> NewInvitation:
    made: NewInvitation = lab.write(
        issuing.create_invitation, "lab", InvitationCreate(role=role, **terms), who=who, required=OWN
    )
    return made


def invite_person(lab: Lab, chief: Principal, **terms: Any) -> NewInvitation:
    made: NewInvitation = lab.write(
        issuing.create_account_invitation, AccountInvitationCreate(**terms), who=chief, required=OWN
    )
    return made


def accept(lab: Lab, code: str, who: Principal | None = None) -> AcceptedInvitation:
    attempt = accepting.try_of(code, ADDRESS, PER_MINUTE)
    lab.database.write(ANONYMOUS, sign_ins.count, attempt)
    return lab.database.write(who or lab.stranger, accepting.accept_invitation, code, attempt)


def sign_up(lab: Lab, code: str, name: str = "ada") -> SignedUp:
    attempt = accepting.try_of(code, ADDRESS, PER_MINUTE)
    request = SignUp.model_validate({"code": code, "name": name, "password": "correct horse"})
    return lab.database.write(ANONYMOUS, accepting.sign_up, request, PASSWORD_HASH, attempt)


def listed(lab: Lab) -> list[Invitation]:
    page = lab.read(issuing.list_invitations, "lab", cursor=None, limit=50, required=OWN)
    return list(page.items)


def role_of(lab: Lab, who: Principal) -> Role | None:
    found = {one.user: one.role for one in lab.read(members.list_members, "lab").items}
    return found.get(str(who.user_name))


def kinds(lab: Lab) -> list[str]:
    return list(lab.database.read(SYSTEM, lambda tx: tx.execute(select(event.c.kind).order_by(event.c.seq)).scalars()))


def is_invalid(lab: Lab, code: str, who: Principal | None = None) -> bool:
    """Return whether a code is refused; fail unless all invalid codes are refused in the same way."""
    refused = None
    try:
        accept(lab, code, who)
    except NotFoundProblem as error:
        refused = error
    if refused is not None:
        known = accepting.invitation_invalid()
        assert (refused.error_code, refused.detail) == (known.error_code, known.detail)
    return refused is not None


def test_an_accepted_invitation_gives_its_role_once_and_a_repetition_gets_the_same_answer(lab: Lab) -> None:
    made = invite(lab, Role.MAINTAINER, note="animation team")
    assert (made.uses_left, made.inviter, made.note) == (1, lab.owner.user_name, "animation team")
    assert [one.model_dump() for one in listed(lab)] == [made.model_dump(exclude={"code"})]
    first, again = accept(lab, made.code), accept(lab, made.code)
    assert first == again == AcceptedInvitation(project="lab", role=Role.MAINTAINER, joined=True)
    assert role_of(lab, lab.stranger) is Role.MAINTAINER
    assert listed(lab) == []
    assert is_invalid(lab, made.code, lab.sign_up("second"))
    assert [kind for kind in kinds(lab) if kind.startswith("invitation")] == [
        "invitation.created",
        "invitation.accepted",
    ]


def test_a_member_with_the_same_or_a_higher_role_does_not_use_an_invitation_up(lab: Lab) -> None:
    made = invite(lab, Role.CONTRIBUTOR)
    for who, role in ((lab.contributor, Role.CONTRIBUTOR), (lab.maintainer, Role.MAINTAINER), (lab.owner, Role.OWNER)):
        assert accept(lab, made.code, who) == AcceptedInvitation(project="lab", role=role, joined=False)
        assert role_of(lab, who) is role
    assert [one.uses_left for one in listed(lab)] == [1]
    assert accept(lab, made.code, lab.reader).joined
    assert role_of(lab, lab.reader) is Role.CONTRIBUTOR


def test_an_invitation_lets_in_as_many_people_as_it_says(lab: Lab) -> None:
    made = invite(lab, Role.READER, uses=2)
    people = [lab.sign_up(f"guest-{number}") for number in range(3)]
    assert [is_invalid(lab, made.code, person) for person in people] == [False, False, True]
    assert [role_of(lab, person) for person in people] == [Role.READER, Role.READER, None]


def test_nobody_who_was_removed_or_demoted_gets_back_with_the_same_invitation(lab: Lab) -> None:
    made = invite(lab, Role.MAINTAINER, uses=5)
    name = str(lab.stranger.user_name)
    accept(lab, made.code)
    lab.write(members.put_member, "lab", name, MemberChange(role=Role.READER), required=OWN)
    assert accept(lab, made.code) == AcceptedInvitation(project="lab", role=Role.READER, joined=True)
    assert role_of(lab, lab.stranger) is Role.READER
    lab.write(members.remove_member, "lab", name, expected_rev=None, required=OWN)
    assert is_invalid(lab, made.code)
    assert role_of(lab, lab.stranger) is None


def test_every_code_that_is_not_valid_gets_the_same_answer(lab: Lab, clock: AdjustableClock) -> None:
    right, used, withdrawn, old = (
        invite(lab, expires_in_s=60 if number == 3 else DAY_S) for number in range(4)
    )  # fmt: skip
    accept(lab, used.code, lab.sign_up("user"))
    lab.write(issuing.withdraw_invitation, "lab", withdrawn.prefix, required=OWN)
    clock.advance(61)
    start, prefix, secret = right.code.split("_")
    wrong = ["", "x", prefix, secret, right.code[:-1], f"{start}_{prefix}_", f"marey_{prefix}_{secret}"]
    wrong += [f"{start}_{'0' * 12}_{secret}", f"{start}_{prefix}_{'0' * 64}", f"{start}__{secret}", "\x00\ud800"]
    for code in (*wrong, used.code, withdrawn.code, old.code):
        clock.advance(60)
        assert is_invalid(lab, code), code
    assert not is_invalid(lab, right.code)


def test_checks_of_codes_compare_secrets_whether_or_not_the_prefix_exists(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[int] = []
    compare = hmac.compare_digest

    def noted(one: str, other: str) -> bool:
        compared.append(len(other))
        return compare(one, other)

    made = invite(lab)
    monkeypatch.setattr(hmac, "compare_digest", noted)
    start, prefix, _ = made.code.split("_")
    for code in (f"{start}_{prefix}_{'0' * 64}", f"{start}_{'0' * 12}_{'0' * 64}", "nonsense"):
        assert is_invalid(lab, code)
    assert compared == [64] * 3


@pytest.mark.parametrize("loss", ["removal", "demotion", "disabling", "deletion"])
def test_an_invitation_dies_for_good_when_its_inviter_may_no_longer_invite(lab: Lab, loss: str) -> None:
    other, chief = str(lab.maintainer.user_name), lab.sign_up("chief", administrator=True)
    lab.write(members.put_member, "lab", other, MemberChange(role=Role.OWNER), required=OWN)
    dying, kept = invite(lab, who=lab.maintainer), invite(lab)
    if loss == "removal":
        lab.write(members.remove_member, "lab", other, expected_rev=None, required=OWN)
    elif loss == "demotion":
        lab.write(members.put_member, "lab", other, MemberChange(role=Role.MAINTAINER), required=OWN)
    elif loss == "disabling":
        lab.write(users.delete_user, other, expected_rev=None, who=chief)
    else:
        lab.write(projects.delete_project, "lab", expected_rev=None, required=OWN)
        assert is_invalid(lab, kept.code)
    assert is_invalid(lab, dying.code)
    if loss == "deletion":
        lab.write(projects.restore_project, "lab", required=OWN)
    else:
        lab.write(users.change_user, other, UserChange(disabled=False), expected_rev=None, who=chief)
        lab.write(members.put_member, "lab", other, MemberChange(role=Role.OWNER), required=OWN)
    assert is_invalid(lab, dying.code)
    assert is_invalid(lab, kept.code) == (loss == "deletion")
    assert kinds(lab).count("invitation.withdrawn") == (2 if loss == "deletion" else 1)


def test_the_acceptance_itself_checks_the_right_of_the_inviter(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    other = str(lab.maintainer.user_name)
    lab.write(members.put_member, "lab", other, MemberChange(role=Role.OWNER), required=OWN)
    made = invite(lab, who=lab.maintainer)
    monkeypatch.setattr(members, "_withdraw_invitations", lambda *_: None)
    lab.write(members.put_member, "lab", other, MemberChange(role=Role.READER), required=OWN)
    assert listed(lab) == []
    assert is_invalid(lab, made.code)


def test_an_administrator_who_loses_the_rights_loses_the_invitations_too(lab: Lab) -> None:
    chief, other = (lab.sign_up(name, administrator=True) for name in ("chief", "other"))
    account = invite_person(lab, other, project="lab", role=Role.READER)
    lab.write(users.change_user, "other", UserChange(administrator=False), expected_rev=None, who=chief)
    with pytest.raises(NotFoundProblem, match="not valid"):
        sign_up(lab, account.code)


def test_an_invited_person_creates_an_account_and_joins_in_one_step(lab: Lab) -> None:
    chief = lab.sign_up("chief", administrator=True)
    made = invite_person(lab, chief, project="lab", role=Role.CONTRIBUTOR, note="new animator")
    assert [one.creates_account for one in listed(lab)] == [True]
    done = sign_up(lab, made.code)
    assert (done.project, done.role, done.user) == ("lab", Role.CONTRIBUTOR, "ada")
    person = lab.database.read(ANONYMOUS, tokens.resolve_token, done.secret)
    assert not person.administrator
    assert role_of(lab, person) is Role.CONTRIBUTOR
    assert lab.database.read(SYSTEM, users.stored_hash, "ada") == PASSWORD_HASH
    actors = select(event.c.kind, event.c.actor).order_by(event.c.seq.desc()).limit(4)
    assert {tuple(row) for row in lab.database.read(SYSTEM, lambda tx: tx.execute(actors).all())} == {
        (kind, "ada") for kind in ("user.created", "member.added", "invitation.accepted", "token.created")
    }


def test_a_taken_name_changes_nothing_and_the_invitation_stays_open(lab: Lab) -> None:
    chief = lab.sign_up("chief", administrator=True)
    made = invite_person(lab, chief, project="lab", role=Role.READER)
    with pytest.raises(ConflictProblem) as refused:
        sign_up(lab, made.code, "chief")
    assert refused.value.error_code == "name-taken"
    assert [one.uses_left for one in listed(lab)] == [1]
    assert sign_up(lab, made.code).role is Role.READER


def test_only_invitations_of_administrators_create_accounts(lab: Lab) -> None:
    with pytest.raises(ForbiddenProblem):
        invite_person(lab, lab.owner, project="lab", role=Role.READER)
    with pytest.raises(NotFoundProblem, match="not valid"):
        sign_up(lab, invite(lab).code)
    chief = lab.sign_up("chief", administrator=True)
    without_project = invite_person(lab, chief)
    assert is_invalid(lab, without_project.code)  # which lets nobody in anywhere
    done = sign_up(lab, without_project.code)
    assert (done.project, done.role) == (None, None)


def test_a_repeated_sign_up_gets_the_same_membership_only_with_the_same_password(lab: Lab) -> None:
    chief = lab.sign_up("chief", administrator=True)
    made = invite_person(lab, chief, project="lab", role=Role.READER)
    assert not lab.database.read(ANONYMOUS, accepting.needs_password_check, made.code, "ada")
    first = sign_up(lab, made.code)
    for name in ("ada", "chief", "nobody"):  # so that neither answer nor time show who has used the code
        assert lab.database.read(ANONYMOUS, accepting.needs_password_check, made.code, name)
    with pytest.raises(NotFoundProblem):
        lab.database.read(ANONYMOUS, accepting.needs_password_check, made.code[:-1] + "x", "ada")
    login, attempt = (sign_ins.SignInTry(name, ADDRESS, PER_MINUTE) for name in ("ada", "code"))
    request = SignUp.model_validate({"code": made.code, "name": "ada", "password": "correct horse"})
    again = lab.database.write(ANONYMOUS, accepting.sign_up_again, request, PASSWORD_HASH, login, attempt)
    assert (again.project, again.role, again.user) == (first.project, first.role, first.user)
    assert again.secret != first.secret
    with pytest.raises(NotFoundProblem, match="not valid"):
        lab.database.write(ANONYMOUS, accepting.sign_up_again, request, None, login, attempt)


def test_only_owners_and_administrators_invite_and_see_invitations(lab: Lab) -> None:
    for who in (lab.reader, lab.contributor, lab.maintainer):
        with pytest.raises(ForbiddenProblem):
            invite(lab, who=who)
        with pytest.raises(ForbiddenProblem):
            lab.read(issuing.list_invitations, "lab", cursor=None, limit=5, who=who, required=OWN)
    with pytest.raises(NotFoundProblem):
        invite(lab, who=lab.stranger)
    assert invite(lab, Role.OWNER, who=lab.sign_up("chief", administrator=True)).role is Role.OWNER


def test_a_project_withdraws_its_own_invitations_by_id_or_prefix_and_no_others(lab: Lab) -> None:
    one, two = invite(lab), invite(lab)
    elsewhere = Lab(lab.database, "elsewhere")
    for named in (one.id, one.prefix):
        with pytest.raises(NotFoundProblem) as refused:
            elsewhere.write(issuing.withdraw_invitation, "elsewhere", named, required=OWN)
        assert refused.value.error_code == "no-invitation"
    for named in (one.id, two.prefix):
        lab.write(issuing.withdraw_invitation, "lab", named, required=OWN)
        with pytest.raises(NotFoundProblem):
            lab.write(issuing.withdraw_invitation, "lab", named, required=OWN)
    assert listed(lab) == []


def test_open_invitations_are_bounded_and_the_error_says_what_to_do(lab: Lab) -> None:
    def limited(tx: Transaction, request: InvitationCreate) -> NewInvitation:
        tx.quotas = type(tx.quotas)(project_invitations=2, user_invitations=3)
        return issuing.create_invitation(tx, "lab", request)

    request = InvitationCreate(role=Role.READER)
    made = [lab.write(limited, request, required=OWN) for _ in range(2)]
    with pytest.raises(QuotaExceededProblem, match="marey member invitations lab"):
        lab.write(limited, request, required=OWN)
    lab.write(issuing.withdraw_invitation, "lab", made[0].prefix, required=OWN)
    accept(lab, lab.write(limited, request, required=OWN).code)
    lab.write(limited, request, required=OWN)
    lab.write(issuing.withdraw_invitation, "lab", made[1].prefix, required=OWN)
    lab.write(limited, request, required=OWN)


def test_a_user_has_a_bounded_number_of_open_invitations_in_all_projects(lab: Lab) -> None:
    chief = lab.sign_up("chief", administrator=True)

    def limited(tx: Transaction) -> NewInvitation:
        tx.quotas = type(tx.quotas)(user_invitations=2)
        return issuing.create_account_invitation(tx, AccountInvitationCreate())

    for _ in range(2):
        lab.write(limited, who=chief)
    with pytest.raises(QuotaExceededProblem, match="Withdraw one"):
        lab.write(limited, who=chief)


@pytest.mark.parametrize(
    "terms",
    [{"uses": 0}, {"uses": 101}, {"expires_in_s": MAX_DAYS * DAY_S + 1}, {"expires_in_s": 59}, {"note": "x" * 256}],
)
def test_terms_out_of_bounds_are_refused(terms: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(terms))):
        InvitationCreate(role=Role.READER, **terms)


def test_housekeeping_deletes_expired_invitations_and_keeps_the_others(lab: Lab, clock: AdjustableClock) -> None:
    def count(tx: Transaction) -> tuple[int, int]:
        tables = (invitation, invitation_use)
        one, two = (tx.execute(select(func.count()).select_from(table)).scalar_one() for table in tables)
        return one, two

    short, long = invite(lab, expires_in_s=60), invite(lab, expires_in_s=2 * DAY_S)
    accept(lab, short.code)
    assert lab.database.read(SYSTEM, count) == (2, 1)
    clock.advance(61)
    assert collect_garbage(lab.database).invitations == 1
    assert lab.database.read(SYSTEM, count) == (1, 0)
    assert [one.id for one in listed(lab)] == [long.id]


def test_no_secret_is_in_the_database(lab: Lab) -> None:
    made = invite(lab, note="team")
    accept(lab, made.code)
    secret = made.code.rpartition("_")[2]

    def everything(tx: Transaction) -> str:
        return "".join(str(row) for table in metadata.sorted_tables for row in tx.execute(select(table)))

    stored = lab.database.read(SYSTEM, everything)
    assert made.prefix in stored
    assert secret not in stored


def test_right_codes_do_not_count_towards_the_limits(lab: Lab) -> None:
    made = invite(lab)
    for _ in range(3 * PER_MINUTE):
        accept(lab, made.code)


def test_wrong_codes_do_not_count_towards_the_limit_of_an_account(database: Database) -> None:
    guesses = accepting.try_of("mareyinvite_ada_" + "0" * 64, ADDRESS, PER_MINUTE)
    for _ in range(PER_MINUTE):
        database.write(ANONYMOUS, sign_ins.count, guesses)
    with pytest.raises(TooManyRequestsProblem):
        database.write(ANONYMOUS, sign_ins.count, guesses)
    database.write(ANONYMOUS, sign_ins.count, sign_ins.SignInTry("ada", ADDRESS, PER_MINUTE))
