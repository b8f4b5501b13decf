"""Schedules: their times, and the submission of their jobs."""

from __future__ import annotations

import threading
from datetime import UTC, datetime, timedelta
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from sqlalchemy import select, update
from tests.support.present import present
from tests.support.queue_desk import Desk

from marey_schemas.access import EndTokens, MemberChange, Role, UserChange, UserCreate
from marey_schemas.queue.jobs import JobCreate, JobOutputsInput
from marey_schemas.queue.schedules import Schedule, ScheduleChange, ScheduleCreate
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ConflictProblem, InvalidProblem, QuotaExceededProblem, UnavailableProblem
from marey_server.store import members, projects, users
from marey_server.store.jobs.submission import submit
from marey_server.store.schedules import firing, managing
from marey_server.store.schedules.times import next_time_us
from marey_server.store.tables import event, job, schedule, user
from marey_server.store.transaction import Quotas, Transaction

HOUR_S = 3600.0


def us_of(*parts: int, zone: str = "UTC") -> int:
    return int(datetime(*parts, tzinfo=ZoneInfo(zone)).timestamp()) * 1_000_000


@pytest.mark.parametrize(
    ("cron", "zone", "after", "expected"),
    [
        ("0 3 * * 1-5", "UTC", us_of(2026, 11, 27, 3, 0), us_of(2026, 11, 30, 3, 0)),
        ("0 3 * * 1-5", "Europe/Berlin", us_of(2026, 11, 27, 1, 59), us_of(2026, 11, 27, 2, 0)),
        ("*/15 * * * *", "UTC", us_of(2026, 11, 27, 3, 0) + 1, us_of(2026, 11, 27, 3, 15)),
        # Clocks go from 2:00 to 3:00, and from 3:00 back to 2:00.
        ("30 2 * * *", "Europe/Berlin", us_of(2026, 3, 28, 12, 0), us_of(2026, 3, 29, 1, 0)),
        ("30 2 * * *", "Europe/Berlin", us_of(2026, 10, 24, 12, 0), us_of(2026, 10, 25, 0, 30)),
        ("30 2 * * *", "Europe/Berlin", us_of(2026, 10, 25, 0, 30), us_of(2026, 10, 26, 1, 30)),
    ],
)
def test_the_next_time_of_an_expression(cron: str, zone: str, after: int, expected: int) -> None:
    assert next_time_us(cron, zone, after) == expected


@given(st.integers(0, 2**31), st.integers(0, 59), st.integers(0, 23))
def test_a_daily_time_comes_within_a_day_and_after_now(now_s: int, minute: int, hour: int) -> None:
    found = datetime.fromtimestamp(next_time_us(f"{minute} {hour} * * *", "UTC", now_s * 1_000_000) / 1e6, UTC)
    now = datetime.fromtimestamp(now_s, UTC)
    assert (found.minute, found.hour, found.second) == (minute, hour, 0)
    assert timedelta() < found - now <= timedelta(days=1)


@pytest.mark.parametrize(
    ("cron", "zone", "pointer"),
    [
        ("0 3 * *", "UTC", "/cron"),
        ("0 0 3 * * 1", "UTC", "/cron"),
        ("61 3 * * *", "UTC", "/cron"),
        ("0 0 31 2 *", "UTC", "/cron"),
        ("* * */20 * 1L", "UTC", "/cron"),
        ("at dawn on monday please", "UTC", "/cron"),
        ("0 3 * * *", "localtime", "/timezone"),
        ("0 3 * * *", "Mars/Olympus", "/timezone"),
        ("0 3 * * *", "Europe", "/timezone"),
        ("0 3 * * *", "../../etc/passwd", "/timezone"),
    ],
)
def test_invalid_times_are_refused_with_their_place(cron: str, zone: str, pointer: str) -> None:
    with pytest.raises(InvalidProblem) as refused:
        next_time_us(cron, zone, 0)
    assert [one.pointer for one in refused.value.errors] == [pointer]


def create(desk: Desk, name: str = "hourly", **fields: Any) -> Schedule:
    request = ScheduleCreate(name=name, **dict[str, Any](cron="0 * * * *", job=JobCreate(kind="errand")) | fields)
    return desk.database.write(desk.user, managing.create_schedule, "lab", request)


def read(desk: Desk, name: str = "hourly") -> Schedule:
    return desk.database.read(desk.user, managing.read_schedule, "lab", name)


def change(desk: Desk, principal: Principal | None = None, name: str = "hourly", **fields: Any) -> Schedule:
    who, request = principal or desk.user, ScheduleChange(**fields)
    return desk.database.write(who, managing.change_schedule, "lab", name, request, expected_rev=None)


def jobs_of(desk: Desk) -> list[str]:
    return desk.database.read(SYSTEM, lambda tx: list(tx.execute(select(job.c.id).order_by(job.c.id)).scalars()))


def kinds_of_events(desk: Desk) -> list[str]:
    kinds = select(event.c.kind).where(event.c.kind.like("schedule.%")).order_by(event.c.seq)
    return desk.database.read(SYSTEM, lambda tx: list(tx.execute(kinds).scalars()))


def test_a_due_schedule_submits_one_job_as_its_author(desk: Desk) -> None:
    create(desk, job=JobCreate(kind="errand", params={"number": 7}, priority=3))
    assert firing.submit_due(desk.database) == 0
    desk.clock.advance(HOUR_S)
    assert firing.submit_due(desk.database) == 1
    assert firing.submit_due(desk.database) == 0
    (only,) = jobs_of(desk)
    shown, made = read(desk), desk.job(only)
    assert (made.author, made.params, made.priority, made.state) == ("ann", {"number": 7}, 3, "queued")
    assert (shown.last_job, shown.problem) == (only, None)
    assert shown.last_at is not None
    assert shown.next_at is not None
    assert shown.next_at - shown.last_at <= timedelta(hours=1)
    assert kinds_of_events(desk) == ["schedule.created", "schedule.submitted"]


def test_times_that_passed_while_no_server_ran_submit_one_job(desk: Desk) -> None:
    create(desk)
    desk.clock.advance(10 * HOUR_S)
    firing.submit_due(desk.database)
    assert len(jobs_of(desk)) == 1


def test_a_time_is_skipped_while_the_previous_job_runs(desk: Desk) -> None:
    create(desk)
    desk.clock.advance(HOUR_S)
    firing.submit_due(desk.database)
    desk.clock.advance(HOUR_S)
    firing.submit_due(desk.database)
    (only,) = jobs_of(desk)
    assert read(desk).problem == f"Skipped, because the previous job {only} has not ended."
    desk.complete(desk.claim())
    desk.clock.advance(HOUR_S)
    firing.submit_due(desk.database)
    assert len(jobs_of(desk)) == 2
    assert read(desk).problem is None


def test_a_refusal_after_a_skipped_time_is_reported(desk: Desk) -> None:
    create(desk)
    for _ in range(2):
        desk.clock.advance(HOUR_S)
        firing.submit_due(desk.database)
    desk.complete(desk.claim())
    desk.database.write(SYSTEM, disable_author)
    desk.clock.advance(HOUR_S)
    firing.submit_due(desk.database)
    assert kinds_of_events(desk) == ["schedule.created", "schedule.submitted", "schedule.refused"]


def test_overlapping_jobs_are_submitted_if_the_schedule_allows_them(desk: Desk) -> None:
    create(desk, overlapping=True)
    for _ in range(3):
        desk.clock.advance(HOUR_S)
        firing.submit_due(desk.database)
    assert len(jobs_of(desk)) == 3


def test_a_schedule_over_a_folder_is_refused_when_its_author_has_submitted_too_many_inputs(desk: Desk) -> None:
    desk.database.quotas = Quotas(user_daily_inputs=5)
    desk.things(4, "raw")
    work = JobCreate(kind="square", inputs={"things": {"collection": "raw"}}, cache="off")
    create(desk, overlapping=True, job=work)
    for problem in (None, "5 inputs per day"):
        desk.clock.advance(HOUR_S)
        firing.submit_due(desk.database)
        shown = read(desk).problem
        assert shown is None if problem is None else problem in present(shown)
    assert len(jobs_of(desk)) == 1 + 2  # one job with two tasks


def test_a_paused_schedule_submits_nothing_until_it_is_resumed(desk: Desk) -> None:
    assert create(desk, paused=True).next_at is None
    desk.clock.advance(HOUR_S)
    assert firing.submit_due(desk.database) == 0
    assert change(desk, paused=False).next_at is not None
    assert firing.submit_due(desk.database) == 0  # the times of the pause have passed
    assert change(desk, paused=True).paused
    desk.clock.advance(HOUR_S)
    assert firing.submit_due(desk.database) == 0


def test_concurrent_servers_submit_one_job_for_a_time(desk: Desk) -> None:
    create(desk, overlapping=True)
    desk.clock.advance(HOUR_S)
    due = desk.database.read(SYSTEM, lambda tx: list(tx.execute(select(schedule.c.id)).scalars()))
    submit = [
        threading.Thread(target=desk.database.write, args=(SYSTEM, firing.submit_if_due, due[0])) for _ in range(6)
    ]
    for one in submit:
        one.start()
    for one in submit:
        one.join()
    assert len(jobs_of(desk)) == 1


def disable_author(tx: Transaction) -> None:
    tx.execute(update(user).where(user.c.name == "ann").values(disabled=True))


def remove_author(tx: Transaction) -> None:
    members.remove_member(tx, "lab", "ann", expected_rev=None)


@pytest.mark.parametrize("lose", [disable_author, remove_author])
def test_an_author_without_rights_submits_nothing(desk: Desk, lose: Any) -> None:
    second(desk, Role.OWNER)
    create(desk)
    desk.database.write(SYSTEM, lose)
    for _ in range(2):
        desk.clock.advance(HOUR_S)
        firing.submit_due(desk.database)
    problem = desk.database.read(SYSTEM, lambda tx: tx.execute(select(schedule.c.problem)).scalar_one())
    assert jobs_of(desk) == []
    assert problem.startswith("Refused for the user ann: ")
    assert kinds_of_events(desk).count("schedule.refused") == 1


def test_a_schedule_has_the_scopes_of_the_token_that_made_it(desk: Desk) -> None:
    narrow = Principal("user", desk.user.user_id, "ann", scopes=("jobs!project=lab",), token_id="token_narrow")
    request = ScheduleCreate(name="narrow", cron="0 * * * *", job=JobCreate(kind="errand"))

    def make(tx: Transaction) -> Schedule:
        tx.required_role = firing._SUBMITS
        return managing.create_schedule(tx, "lab", request)

    desk.database.write(narrow, make)
    scopes = select(schedule.c.scopes)
    assert desk.database.read(SYSTEM, lambda tx: tx.execute(scopes).scalar_one()) == ["jobs!project=lab"]
    desk.clock.advance(HOUR_S)
    firing.submit_due(desk.database)
    assert len(jobs_of(desk)) == 1


def second(desk: Desk, role: Role) -> Principal:
    """Create the user `ben` with a role in the project."""
    made = desk.database.write(SYSTEM, users.create_user, UserCreate(name="ben"))
    desk.database.write(desk.user, members.put_member, "lab", "ben", MemberChange(role=role))
    return Principal("user", made.id, "ben", scopes=("read", "write", "jobs"), token_id="token_ben")


def test_who_sets_the_job_or_resumes_the_schedule_is_its_author(desk: Desk) -> None:
    ben = second(desk, Role.OWNER)
    create(desk)
    assert change(desk, ben, description="by ben").author == "ann"
    assert change(desk, ben, paused=True).author == "ann"
    assert change(desk, paused=False).author == "ann"
    assert change(desk, ben, cron="* * * * *").author == "ben", "nobody chooses when another user submits jobs"
    assert change(desk, timezone="Europe/Berlin").author == "ann"
    assert change(desk, ben, job=JobCreate(kind="errand")).author == "ben"
    assert change(desk, paused=False).author == "ann"


def test_a_refused_job_changes_nothing(desk: Desk) -> None:
    refused_fields: tuple[dict[str, Any], ...] = (
        {"job": JobCreate(kind="unknown")},
        {"job": JobCreate(kind="errand", params={"number": "many"})},
        {"job": JobCreate(kind="errand", after=("job_x",))},
        {"job": JobCreate(kind="square", inputs={"things": JobOutputsInput(job="job_x")})},
        {"cron": "0 3 * * 9"},
        {"timezone": "Nowhere"},
    )
    for fields in refused_fields:
        with pytest.raises(InvalidProblem) as refused:
            create(desk, **fields)
        pointer = refused.value.errors[0].pointer
        assert pointer.split("/")[1] == next(iter(fields)), pointer
    assert list(desk.database.read(desk.user, managing.list_schedules, "lab", cursor=None, limit=10).items) == []


def test_names_are_unique_and_the_number_is_limited(desk: Desk) -> None:
    create(desk)
    with pytest.raises(ConflictProblem, match="has a schedule 'hourly'"):
        create(desk)
    desk.database.quotas = Quotas(project_schedules=1)
    with pytest.raises(QuotaExceededProblem, match="project_schedules"):
        create(desk, "another")


def fail_once(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """Let the next submission of a scheduled job fail."""
    errors = [error]

    def fail_or_submit(*args: Any) -> Any:
        if errors:
            raise errors.pop()
        return submit(*args)

    monkeypatch.setattr("marey_server.store.schedules.firing.submit", fail_or_submit)


def test_a_failing_schedule_does_not_stop_the_others(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    create(desk, "a", overlapping=True)
    create(desk, "b", overlapping=True)
    desk.clock.advance(HOUR_S)
    fail_once(monkeypatch, RuntimeError("a fault of ours"))
    assert firing.submit_due(desk.database) == 2
    assert len(jobs_of(desk)) == 1
    assert firing.submit_due(desk.database) == 0, "the failed schedule waits for its next time"
    assert read(desk, "a").problem == "Failed because of a fault of the server; its log gives the reason."
    desk.clock.advance(HOUR_S)
    assert firing.submit_due(desk.database) == 2
    assert len(jobs_of(desk)) == 3
    assert read(desk, "a").problem is None


def test_a_schedule_that_cannot_be_stored_now_is_tried_again_after_the_others(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    create(desk, "a", overlapping=True)
    create(desk, "b", overlapping=True)
    desk.clock.advance(HOUR_S)
    fail_once(monkeypatch, UnavailableProblem("Busy."))
    assert (firing.submit_due(desk.database), len(jobs_of(desk))) == (1, 1)
    assert (firing.submit_due(desk.database), len(jobs_of(desk))) == (1, 2)


def test_a_disabled_author_has_no_active_schedules(desk: Desk) -> None:
    desk.database.write(SYSTEM, users.create_user, UserCreate(name="root", administrator=True))
    create(desk)
    desk.database.write(SYSTEM, users.change_user, "ann", UserChange(disabled=True), expected_rev=None)
    desk.database.write(SYSTEM, users.change_user, "ann", UserChange(disabled=False), expected_rev=None)
    assert read(desk).paused


@pytest.mark.parametrize("cron", ["0 3 * *\u2028*", "0 3 * * \x1b", "0\t3 * * *"])
def test_an_expression_has_no_control_characters(cron: str) -> None:
    with pytest.raises(ValidationError):
        ScheduleCreate(name="s", cron=cron, job=JobCreate(kind="errand"))


@pytest.mark.parametrize(("granted", "shown"), [("jobs", False), ("read", True)])
def test_a_problem_has_no_names_that_the_token_may_not_read(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, granted: str, shown: bool
) -> None:
    create(desk)
    scopes = ["jobs"] if granted == "jobs" else ["jobs", "read"]
    desk.database.write(SYSTEM, lambda tx: tx.execute(update(schedule).values(scopes=scopes)))

    def refuse(*_args: Any) -> Any:
        raise ConflictProblem("The result would replace SECRET.", unnamed="The result would replace another item.")

    monkeypatch.setattr("marey_server.store.schedules.firing.submit", refuse)
    desk.clock.advance(HOUR_S)
    firing.submit_due(desk.database)
    assert ("SECRET" in (read(desk).problem or "")) == shown


def test_after_a_correction_of_the_clock_nothing_is_due(desk: Desk) -> None:
    create(desk)
    desk.database.write(SYSTEM, lambda tx: tx.execute(update(schedule).values(due_us=0)))
    assert read(desk).next_at is None
    assert firing.submit_due(desk.database) == 1
    assert jobs_of(desk) == []
    assert read(desk).next_at is not None
    assert read(desk).last_at is None


def test_revoking_all_tokens_of_a_user_pauses_the_schedules_of_the_user(desk: Desk) -> None:
    desk.database.write(SYSTEM, users.create_user, UserCreate(name="root", administrator=True))
    create(desk)
    end = UserChange(end_tokens=EndTokens.SESSIONS)
    desk.database.write(SYSTEM, users.change_user, "ann", end, expected_rev=None)
    assert not read(desk).paused
    desk.database.write(SYSTEM, users.change_user, "ann", UserChange(end_tokens=EndTokens.ALL), expected_rev=None)
    assert read(desk).paused
    assert read(desk).problem == "Paused, because all tokens of the author were revoked, or the author was disabled."
    assert change(desk, paused=False).problem is None


def test_the_schedules_of_a_deleted_project_wait(desk: Desk) -> None:
    create(desk)
    desk.database.write(desk.user, projects.delete_project, "lab", expected_rev=None)
    desk.clock.advance(HOUR_S)
    assert firing.submit_due(desk.database) == 0
    assert jobs_of(desk) == []
