"""Users, passwords, tokens."""

from datetime import datetime
from typing import Any

import pytest
import sqlalchemy
from tests.support.database_fixtures import AdjustableClock
from tests.support.present import present
from tests.support.store_fixtures import Lab

from marey_schemas.access import NewToken, ProjectCreate, TokenCreate, UserChange, UserCreate
from marey_schemas.queue.jobs import JobState
from marey_server.access import passwords
from marey_server.access.principal import ANONYMOUS, SYSTEM, Principal
from marey_server.access.secret_tokens import issue_attempt_token
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    LeaseLostProblem,
    NotFoundProblem,
    PreconditionFailedProblem,
    UnauthenticatedProblem,
)
from marey_server.store import projects, users
from marey_server.store.credentials import tokens
from marey_server.store.credentials.tokens import TokenFilter
from marey_server.store.database.connections import Database
from marey_server.store.garbage import collect_garbage
from marey_server.store.tables import attempt, job
from marey_server.store.transaction import Transaction


@pytest.fixture(autouse=True)
def cheap_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passwords, "LOG2_N", 4)


@pytest.fixture
def chief(database: Database) -> Principal:
    made = database.write(SYSTEM, users.ensure_first_administrator)
    assert made is not None
    return database.read(SYSTEM, users.administrator_principal)


def test_a_password_that_was_changed_while_it_was_checked_signs_nobody_in(database: Database, chief: Principal) -> None:
    sign_up(database, chief, "ann", "correct horse")
    verified = database.read(ANONYMOUS, users.stored_hash, "ann")
    new = passwords.hash_password("battery staple")
    change = UserChange(password="battery staple")
    database.write(chief, users.change_user, "ann", change, expected_rev=None, password_hash=new)
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, users.authenticated, "ann", present(verified))


def sign_up(database: Database, chief: Principal, name: str, password: str | None = None) -> Principal:
    hashed = passwords.hash_password(password) if password else None
    made = database.write(chief, users.create_user, UserCreate(name=name), password_hash=hashed)
    return Principal("user", made.id, name, scopes=("read", "write", "jobs"))


def check(database: Database, name: str, password: str) -> Principal:
    """Sign in as a server does, and return the principal; the password is compared outside of transactions."""
    stored = database.read(ANONYMOUS, users.stored_hash, name)
    if not passwords.password_matches(password, stored):
        raise users.wrong_password()
    return database.read(ANONYMOUS, users.authenticated, name, present(stored))


def test_the_first_administrator_is_made_once(database: Database, chief: Principal) -> None:
    assert chief.administrator
    assert database.write(SYSTEM, users.ensure_first_administrator) is None


def test_only_administrators_make_and_list_users(database: Database, chief: Principal) -> None:
    ann = sign_up(database, chief, "ann")
    weak_chief = Principal("user", chief.user_id, "admin", administrator=True, scopes=("read", "write"))
    for who in (ann, weak_chief):
        with pytest.raises(ForbiddenProblem):
            database.write(who, users.create_user, UserCreate(name="ben"))
        with pytest.raises(ForbiddenProblem):
            database.read(who, users.list_users)
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, users.list_users)
    made = database.write(ann, tokens.create_token, TokenCreate(name="t", scopes=("read",)))
    database.write(SYSTEM, tokens.note_use, made.id)
    found = database.read(chief, users.list_users).items
    assert [(one.name, one.last_seen_at is not None) for one in found] == [("admin", False), ("ann", True)]


def test_names_of_users_are_unique(database: Database, chief: Principal) -> None:
    sign_up(database, chief, "ann")
    with pytest.raises(ConflictProblem):
        sign_up(database, chief, "ann")


def test_users_see_themselves_and_nobody_else(database: Database, chief: Principal) -> None:
    ann, ben = sign_up(database, chief, "ann"), sign_up(database, chief, "ben")
    assert database.read(ann, users.find_user, "ann").name == "ann"
    with pytest.raises(NotFoundProblem):
        database.read(ben, users.find_user, "ann")


def test_signing_in_needs_the_password(database: Database, chief: Principal) -> None:
    sign_up(database, chief, "ann", "correct horse")
    sign_up(database, chief, "silent")
    principal = check(database, "ann", "correct horse")
    assert (principal.user_name, principal.administrator) == ("ann", False)
    assert "admin" not in principal.scopes
    for name, password in (("ann", "wrong horse"), ("nobody", "correct horse"), ("silent", ""), ("admin", "")):
        with pytest.raises(UnauthenticatedProblem) as refused:
            check(database, name, password)
        assert refused.value.detail == "The name or the password is wrong."


def test_a_user_changes_the_password_with_the_current_one(database: Database, chief: Principal) -> None:
    ann = sign_up(database, chief, "ann", "correct horse")
    change = UserChange(password="battery staple", current_password="correct horse")
    new = passwords.hash_password("battery staple")
    with pytest.raises(ForbiddenProblem):
        database.write(ann, users.change_user, "ann", change, expected_rev=None, password_hash=new)
    old = database.read(ann, users.stored_hash, "ann")
    database.write(ann, users.change_user, "ann", change, expected_rev=None, password_hash=new, verified_hash=old)
    assert check(database, "ann", "battery staple").user_name == "ann"
    with pytest.raises(PreconditionFailedProblem):
        database.write(ann, users.change_user, "ann", change, expected_rev=None, password_hash=new, verified_hash=old)


def test_users_cannot_raise_themselves(database: Database, chief: Principal) -> None:
    ann = sign_up(database, chief, "ann")
    with pytest.raises(ForbiddenProblem):
        database.write(ann, users.change_user, "ann", UserChange(administrator=True), expected_rev=None)
    assert not database.read(ann, users.find_user, "ann").administrator


def test_somebody_stays_administrator(database: Database, chief: Principal) -> None:
    with pytest.raises(ConflictProblem):
        database.write(chief, users.delete_user, "admin", expected_rev=None)
    with pytest.raises(ConflictProblem):
        database.write(chief, users.change_user, "admin", UserChange(administrator=False), expected_rev=None)
    assert database.read(chief, users.find_user, "admin").administrator


def make_token(database: Database, who: Principal, **kwargs: Any) -> NewToken:
    return database.write(who, tokens.create_token, TokenCreate(name="mine", **kwargs))


def test_a_token_stands_for_its_user_until_it_is_revoked(database: Database, chief: Principal) -> None:
    ann, ben = sign_up(database, chief, "ann"), sign_up(database, chief, "ben")
    made = make_token(database, ann, scopes=("read",))
    found = database.read(ANONYMOUS, tokens.resolve_token, made.secret)
    assert (found.user_id, found.scopes, found.token_id) == (ann.user_id, ("read",), made.id)
    assert [one.id for one in database.read(ann, tokens.list_tokens).items] == [made.id]
    with pytest.raises(NotFoundProblem):
        database.write(ben, tokens.revoke_token, made.id)
    database.write(ann, tokens.revoke_token, made.id)
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, tokens.resolve_token, made.secret)


def test_a_token_expires(database: Database, chief: Principal, clock: AdjustableClock) -> None:
    made = make_token(database, chief, expires_in_s=60)
    clock.advance(59)
    assert database.read(ANONYMOUS, tokens.resolve_token, made.secret).user_name == "admin"
    clock.advance(2)
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, tokens.resolve_token, made.secret)


def test_a_token_makes_none_that_outlives_it(database: Database, chief: Principal, clock: AdjustableClock) -> None:
    hour = make_token(database, chief, expires_in_s=3600)
    leaked = database.read(ANONYMOUS, tokens.resolve_token, hour.secret)
    for lifetime_s in (None, 3601, 90 * 86400):
        with pytest.raises(ForbiddenProblem, match="cannot be valid longer") as refused:
            make_token(database, leaked, expires_in_s=lifetime_s)
        assert refused.value.error_code == "outlives-credential"
    assert make_token(database, leaked).expires_at == hour.expires_at
    shorter, whole = make_token(database, leaked, expires_in_s=600).expires_at, hour.expires_at
    assert shorter is not None
    assert whole is not None
    assert shorter < whole
    clock.advance(3300)
    with pytest.raises(ForbiddenProblem, match="cannot be valid longer"):
        make_token(database, leaked, expires_in_s=600)


@pytest.mark.parametrize(
    ("left_s", "words"), [(7.5 * 86_400, "7 days"), (1.5 * 86_400, "1 day"), (9000, "2 hours"), (3595, "59 minutes")]
)
def test_a_token_that_would_outlive_its_creator_is_refused_with_the_latest_date(
    database: Database, chief: Principal, left_s: float, words: str
) -> None:
    held = make_token(database, chief, expires_in_s=int(left_s))
    caller = database.read(ANONYMOUS, tokens.resolve_token, held.secret)
    with pytest.raises(
        ForbiddenProblem, match=f"ends on {held.expires_at:%Y-%m-%d at %H:%M} UTC, in {words}"
    ) as refused:
        make_token(database, caller, expires_in_s=None)
    assert refused.value.context["latest"] == present(held.expires_at).isoformat()


def test_a_chain_of_tokens_never_widens(database: Database, chief: Principal) -> None:
    for name in ("walk", "run"):
        database.write(chief, projects.create_project, ProjectCreate(name=name))
    first = make_token(database, chief, scopes=("read", "write", "jobs!project=walk"), expires_in_s=3600)
    held = first
    for narrower in (("read", "write"), ("write",), ("write!project=run",)):
        caller = database.read(ANONYMOUS, tokens.resolve_token, held.secret)
        for wider in ("admin", "work", "jobs", "jobs!project=run", "admin!project=walk"):
            with pytest.raises(ForbiddenProblem):
                make_token(database, caller, scopes=(wider,))
        held = make_token(database, caller, scopes=narrower)
        assert held.created_by == caller.token_id
        assert held.expires_at == first.expires_at


def test_a_token_for_a_project_that_the_caller_cannot_see_is_refused(database: Database, chief: Principal) -> None:
    administrator = holder(database, make_token(database, chief))
    ann = holder(database, make_token(database, sign_up(database, chief, "ann")))
    database.write(chief, projects.create_project, ProjectCreate(name="hidden"))
    assert make_token(database, administrator, scopes=("read!project=hidden",)).scopes == ("read!project=hidden",)
    for name in ("hidden", "hiden"):
        with pytest.raises(NotFoundProblem, match=f"There is no project '{name}' that you may see") as refused:
            make_token(database, ann, scopes=("write", f"read!project={name}"))
        assert refused.value.error_code == "no-project"


def holder(database: Database, made: NewToken) -> Principal:
    return database.read(ANONYMOUS, tokens.resolve_token, made.secret)


def test_a_token_bound_to_labels_makes_none_that_allows_others(database: Database, chief: Principal) -> None:
    lyon = {"gpu": "a100", "site": "lyon"}
    database.write(chief, projects.create_project, ProjectCreate(name="walk"))
    held = make_token(database, chief, scopes=("write", "work"), labels=lyon)
    caller = holder(database, held)
    assert caller.labels == held.labels == lyon
    for wider in ({"gpu": "a100", "site": "paris"}, {"disk": "ssd"}):
        with pytest.raises(ForbiddenProblem, match="does not allow the label") as refused:
            make_token(database, caller, scopes=("work",), labels=wider)
        assert refused.value.error_code == "label-not-allowed"
    assert make_token(database, caller, scopes=("work!project=walk",)).labels == lyon
    assert make_token(database, caller, scopes=("work",), labels=None).labels == lyon
    narrower = make_token(database, caller, scopes=("write", "work"), labels={"gpu": "a100"})
    assert make_token(database, holder(database, narrower), scopes=("work",)).labels == {"gpu": "a100"}
    assert make_token(database, holder(database, narrower), scopes=("work",), labels={}).labels == {}
    assert make_token(database, caller, scopes=("write",)).labels is None
    shown = {one.id: one.labels for one in database.read(chief, tokens.list_tokens).items}
    assert shown[held.id] == lyon


@pytest.mark.parametrize(
    ("scopes", "labels"),
    [(("read", "write", "jobs"), {"gpu": "a100"}), (("admin",), {}), (("work",), {f"n{n}": "x" for n in range(7)})],
)
def test_labels_that_a_token_cannot_have_are_refused(
    database: Database, chief: Principal, scopes: tuple[str, ...], labels: dict[str, str]
) -> None:
    with pytest.raises(InvalidProblem) as refused:
        make_token(database, chief, scopes=scopes, labels=labels)
    assert [error.pointer for error in refused.value.errors] == ["/labels"]
    assert database.read(chief, tokens.list_tokens).items == ()


def sign_in(database: Database, name: str, password: str) -> NewToken:
    def start(tx: Transaction) -> NewToken:
        tx.principal = check(database, name, password)
        return tokens.create_session(tx, 3600)

    return database.write(ANONYMOUS, start)


def works(database: Database, *made: NewToken) -> list[bool]:
    def one(secret: str) -> bool:
        try:
            return bool(database.read(ANONYMOUS, tokens.resolve_token, secret).user_id)
        except UnauthenticatedProblem:
            return False

    return [one(token.secret) for token in made]


@pytest.mark.parametrize(
    ("end_tokens", "left"), [(None, [True, False, True]), ("none", [True] * 3), ("all", [True, False, False])]
)
def test_a_new_password_ends_other_sessions_and_all_tokens_if_asked(
    database: Database, chief: Principal, end_tokens: str | None, left: list[bool]
) -> None:
    sign_up(database, chief, "ann", "correct horse")
    here, elsewhere = (sign_in(database, "ann", "correct horse") for _ in range(2))
    ann = database.read(ANONYMOUS, tokens.resolve_token, here.secret)
    program = make_token(database, ann)
    beside = make_token(database, chief)
    given = {} if end_tokens is None else {"end_tokens": end_tokens}
    change = UserChange(password="battery staple", current_password="correct horse", **given)
    old, new = database.read(ann, users.stored_hash, "ann"), passwords.hash_password("battery staple")
    database.write(ann, users.change_user, "ann", change, expected_rev=None, password_hash=new, verified_hash=old)
    assert works(database, here, elsewhere, program) == left
    assert works(database, beside) == [True]


def test_a_password_set_by_an_administrator_ends_every_session(database: Database, chief: Principal) -> None:
    sign_up(database, chief, "ann", "correct horse")
    session = sign_in(database, "ann", "correct horse")
    new = passwords.hash_password("battery staple")
    change = UserChange(password="battery staple")
    database.write(chief, users.change_user, "ann", change, expected_rev=None, password_hash=new)
    assert works(database, session) == [False]


def test_administrators_list_and_end_tokens_of_others(database: Database, chief: Principal) -> None:
    ann, ben = sign_up(database, chief, "ann"), sign_up(database, chief, "ben")
    made = make_token(database, ann, scopes=("read!project=walk",))
    own = make_token(database, chief, expires_in_s=3600)
    listed = database.read(chief, tokens.list_tokens, TokenFilter(user="ann")).items
    assert [(one.id, one.user, one.scopes) for one in listed] == [(made.id, "ann", ("read!project=walk",))]
    every = database.read(chief, tokens.list_tokens, TokenFilter(everybody=True)).items
    assert {one.id for one in every} == {made.id, own.id}
    found = database.read(
        chief, tokens.list_tokens, TokenFilter(everybody=True, prefix=made.secret.split("_")[1])
    ).items
    assert [one.id for one in found] == [made.id]
    soon = database.read(chief, tokens.list_tokens, TokenFilter(everybody=True, ends_within_s=7200)).items
    assert [one.id for one in soon] == [own.id]
    narrow = Principal("user", chief.user_id, "admin", administrator=True, scopes=("read", "write"))
    for who in (ben, narrow):
        with pytest.raises(NotFoundProblem):
            database.read(who, tokens.list_tokens, TokenFilter(user="ann"))
        with pytest.raises(ForbiddenProblem):
            database.read(who, tokens.list_tokens, TokenFilter(everybody=True))
        with pytest.raises(NotFoundProblem):
            database.write(who, tokens.revoke_token, made.id)
    with pytest.raises(NotFoundProblem):
        database.read(chief, tokens.list_tokens, TokenFilter(user="nobody"))
    database.write(chief, tokens.revoke_token, made.id)
    assert works(database, made) == [False]


def test_a_leaked_token_is_revoked_with_all_that_were_created_with_it(database: Database, chief: Principal) -> None:
    def child(parent: NewToken) -> NewToken:
        return make_token(database, database.read(ANONYMOUS, tokens.resolve_token, parent.secret))

    leaked, beside = make_token(database, chief), make_token(database, chief)
    first = child(leaked)
    second = child(first)
    third = child(second)
    database.write(chief, tokens.revoke_token, second.id)  # as somebody would who hides where `third` comes from
    assert works(database, leaked, first, third, beside) == [True, True, True, True]
    database.write(chief, tokens.revoke_token, leaked.id, with_created=True)
    assert works(database, leaked, first, third, beside) == [False, False, False, True]


def test_expired_tokens_are_listed_for_a_month_and_then_deleted(
    database: Database, chief: Principal, clock: AdjustableClock
) -> None:
    make_token(database, chief, expires_in_s=60)
    lasting = make_token(database, chief, expires_in_s=None)
    clock.advance(20 * 86400)
    assert collect_garbage(database).tokens == 0
    clock.advance(11 * 86400)
    assert collect_garbage(database).tokens == 1
    assert [one.id for one in database.read(chief, tokens.list_tokens).items] == [lasting.id]


def test_tokens_of_a_disabled_user_are_worth_nothing(database: Database, chief: Principal) -> None:
    ann = sign_up(database, chief, "ann", "correct horse")
    made = make_token(database, ann)
    database.write(chief, users.delete_user, "ann", expected_rev=None)
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, tokens.resolve_token, made.secret)
    with pytest.raises(UnauthenticatedProblem):
        check(database, "ann", "correct horse")


@pytest.mark.parametrize(
    "text",
    ["", "marey_", "marey_abc", "marey__x", "mareyjob_", "mareyjob_0", "Bearer x", "marey_\ud800_\x00", "x" * 5000],
)
def test_what_is_no_token_is_refused(database: Database, text: str) -> None:
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, tokens.resolve_token, text)


def test_a_wrong_secret_behind_a_right_prefix_is_refused(database: Database, chief: Principal) -> None:
    made = make_token(database, chief)
    with pytest.raises(UnauthenticatedProblem):
        database.read(ANONYMOUS, tokens.resolve_token, made.secret[:-1] + ("0" if made.secret[-1] != "0" else "1"))


def test_no_secret_is_stored(database: Database, chief: Principal) -> None:
    made = make_token(database, chief)
    secret = made.secret.rpartition("_")[2]
    with database.engine.connect() as connection:
        for table in ("token", "event"):
            rows = connection.exec_driver_sql(f'SELECT * FROM "{table}"').all()
            assert rows
            assert secret not in str(rows)


def test_a_token_never_makes_a_stronger_one(database: Database, chief: Principal) -> None:
    ann = sign_up(database, chief, "ann")
    weak = Principal("user", ann.user_id, "ann", scopes=("read", "write", "jobs!project=walk"))
    for scope in ("admin", "work", "jobs", "jobs!project=run"):
        with pytest.raises(ForbiddenProblem):
            make_token(database, weak, scopes=(scope,))
    assert make_token(database, weak, scopes=("write!project=run", "jobs!project=walk")).scopes
    with pytest.raises(ForbiddenProblem):
        make_token(database, Principal("user", ann.user_id, "ann", scopes=("read",)), scopes=("read",))


def test_use_of_a_token_is_noted_once_an_hour(database: Database, chief: Principal, clock: AdjustableClock) -> None:
    made = make_token(database, chief)

    def last_used() -> datetime:
        return database.read(chief, tokens.list_tokens).items[0].last_used_at

    database.write(SYSTEM, tokens.note_use, made.id)
    first = last_used()
    clock.advance(600)
    database.write(SYSTEM, tokens.note_use, made.id)
    assert last_used() == first
    clock.advance(3600)
    database.write(SYSTEM, tokens.note_use, made.id)
    assert last_used() > first


@pytest.fixture
def running(lab: Lab) -> str:
    """The token of a running attempt of a job that the contributor submitted."""
    project_id = lab.read(projects.read_project, "lab").id
    issued = issue_attempt_token()

    def insert(tx: Transaction) -> None:
        row = {
            "kind": "retarget",
            "params": {},
            "inputs": {},
            "time_limit_s": 60,
            "memory_limit_mb": 64,
            "run_at_us": 0,
            "fence": 3,
        }
        row |= {"id": "job_1", "project_id": project_id, "author_id": lab.contributor.user_id, "created_us": 0}
        tx.execute(sqlalchemy.insert(job).values(state=JobState.RUNNING, **row))
        row = {"job_id": "job_1", "fence": 3, "worker": "w", "token_hash": issued.secret_hash, "started_us": 0}
        tx.execute(sqlalchemy.insert(attempt).values(**row))

    lab.write(insert)
    return issued.text


def change_job(lab: Lab, **values: Any) -> None:
    lab.write(lambda tx: tx.execute(sqlalchemy.update(job).values(**values)))


def test_the_token_of_an_attempt_reads_its_project(lab: Lab, running: str) -> None:
    found = lab.read(tokens.resolve_token, running)
    assert (found.kind, found.job_id, found.fence, found.scopes) == ("attempt", "job_1", 3, ("read",))
    assert lab.read(projects.read_project, "lab", who=found).name == "lab"


def test_the_token_of_an_attempt_dies_when_the_fence_moves(lab: Lab, running: str) -> None:
    change_job(lab, fence=4)
    with pytest.raises(LeaseLostProblem):
        lab.read(tokens.resolve_token, running)


@pytest.mark.parametrize("state", [state for state in JobState if state is not JobState.RUNNING])
def test_the_token_of_an_attempt_that_is_over_is_refused(lab: Lab, running: str, state: JobState) -> None:
    change_job(lab, state=state)
    with pytest.raises(LeaseLostProblem):
        lab.read(tokens.resolve_token, running)
