"""Quotas of users: concurrent requests cannot exceed a quota, and used quota becomes free when something ends."""

import os
import random
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.queue_desk import Desk
from tests.support.store_fixtures import Lab

from marey_schemas.access import ProjectCreate, TokenCreate
from marey_schemas.queue.jobs import ItemInput, JobCreate
from marey_server.errors import QuotaExceededProblem
from marey_server.process.settings import Settings
from marey_server.store import blobs, projects, uploads
from marey_server.store.blobs import digest_of
from marey_server.store.credentials import tokens
from marey_server.store.jobs import reading
from marey_server.store.transaction import Quotas, Transaction

LIMIT = 3
Make = Callable[[Transaction, int], Any]


def make_token(tx: Transaction, number: int) -> None:
    session = tokens.create_session(tx, 3600)  # which does not count
    tx.principal = replace(tx.principal, token_id=session.id)
    tokens.create_token(tx, TokenCreate(name=f"t{number}"))


def make_project(tx: Transaction, number: int) -> None:
    projects.create_project(tx, ProjectCreate(name=f"p{number}"))


def make_upload(tx: Transaction, number: int) -> None:
    uploads.create_upload(tx, 1)


@pytest.mark.parametrize(
    ("quota", "make"),
    [
        ("user_tokens", make_token),
        ("user_projects", make_project),
        ("user_uploads", make_upload),
        ("user_upload_bytes", make_upload),
    ],
)
def test_many_requests_at_once_never_exceed_a_quota(lab: Lab, quota: str, make: Make) -> None:
    lab.database.quotas = Quotas(**{quota: LIMIT})
    futures = [lab.database.submit_write(lab.stranger, make, number) for number in range(3 * LIMIT)]
    errors = [error for future in futures if (error := future.exception(60)) is not None]
    assert len(errors) == 2 * LIMIT
    for error in errors:
        assert isinstance(error, QuotaExceededProblem)
        assert error.context == {"quota": quota, "used": LIMIT, "limit": LIMIT}
    lab.write(make, 99, who=lab.contributor)  # the quota of somebody else


def test_what_ends_makes_room_and_nothing_is_lost(lab: Lab) -> None:
    draw = random.Random(13)
    lab.database.quotas = Quotas(user_uploads=LIMIT, user_upload_bytes=10)
    open_bytes: dict[str, int] = {}
    for _ in range(60):
        length = draw.randint(1, 6)
        action = draw.choice(("begin", "begin", "abandon", "finish"))
        if action == "begin":
            if len(open_bytes) < LIMIT and sum(open_bytes.values()) + length <= 10:
                open_bytes[lab.write(uploads.create_upload, length).id] = length
            else:
                with pytest.raises(QuotaExceededProblem, match="Finish or delete one of them, such as upload_"):
                    lab.write(uploads.create_upload, length)
        elif open_bytes:
            ended = draw.choice(sorted(open_bytes))
            data = os.urandom(open_bytes.pop(ended))
            if action == "finish":
                lab.write(uploads.append, ended, 0, data)
                lab.write(uploads.finish, ended, digest_of(data), None)
            else:
                lab.write(uploads.abandon, ended)


def restore_project(tx: Transaction, number: int) -> None:
    projects.restore_project(tx, f"p{number}")


def test_restoring_projects_at_once_never_exceeds_the_quota(lab: Lab) -> None:
    numbers = range(2 * LIMIT)
    for number in numbers:
        lab.write(make_project, number, who=lab.stranger)
        lab.write(projects.delete_project, f"p{number}", expected_rev=None, who=lab.stranger)
    lab.database.quotas = Quotas(user_projects=LIMIT)
    futures = [lab.database.submit_write(lab.stranger, restore_project, number) for number in numbers]
    errors = [future.exception(60) for future in futures]
    assert [type(error) for error in errors if error is not None] == [QuotaExceededProblem] * LIMIT
    refused = next(number for number, error in zip(numbers, errors, strict=True) if error is not None)
    administrator = replace(lab.owner, administrator=True)
    lab.write(projects.restore_project, f"p{refused}", who=administrator)  # who does not own it afterwards


def test_unfinished_jobs_and_their_tasks_count_until_they_end(desk: Desk) -> None:
    desk.database.quotas = Quotas(user_jobs=LIMIT)
    things = tuple(ItemInput(item=one) for one in desk.things(4))
    first = desk.submit("square", inputs={"things": things})
    with pytest.raises(
        QuotaExceededProblem, match="3 unfinished jobs, the limit is 3, and this needs 1 more"
    ) as refused:
        desk.submit()
    assert refused.value.context == {"quota": "user_jobs", "used": 3, "limit": LIMIT}
    assert [job.id for job in desk.database.read(desk.user, reading.list_jobs, desk.project).items] == [first]
    desk.cancel(first)
    desk.submit_many(*[JobCreate(kind="errand")] * LIMIT)
    desk.complete(desk.claim())
    later = desk.submit()
    desk.cancel(later)
    desk.submit()


def test_tasks_of_a_job_that_gets_its_inputs_later_count_as_well(desk: Desk) -> None:
    desk.database.quotas = Quotas(user_jobs=7)
    maker = desk.submit("sum")
    late = desk.submit_many(
        *(JobCreate(kind="square", inputs={"things": {"job": maker}}, into=f"{n}") for n in range(3))
    )
    lease = desk.claim()
    desk.stage(lease, *(f"thing{number}" for number in range(4)))
    desk.complete(lease)  # each of the three jobs needs two tasks, but there is room for four
    states = [desk.state(job) for job in late]
    assert sorted(states) == ["failed", "running", "running"]
    failure = desk.job(late[states.index("failed")]).failure
    assert failure is not None
    assert (failure.code, failure.detail) == (
        "quota-exceeded",
        "The job would have 2 tasks, but its author may have only 0 more unfinished jobs (quota `user_jobs`). Retry "
        "the job when some have ended.",
    )


def test_new_bytes_are_limited_per_day_and_become_free_with_time(lab: Lab, clock: AdjustableClock) -> None:
    lab.database.quotas = Quotas(user_daily_bytes=1000)
    lab.write(blobs.put_blob, b"a" * 600)
    lab.write(blobs.put_blob, b"a" * 600)  # which the server has already
    with pytest.raises(QuotaExceededProblem, match="1,000 new bytes per day") as refused:
        lab.write(blobs.put_blob, b"b" * 600)
    assert refused.value.context["wait_s"] == pytest.approx(0.2 * 86400, abs=60)
    assert lab.read(blobs.readable, [digest_of(b"b" * 600)]) == set()
    with pytest.raises(QuotaExceededProblem):
        lab.write(uploads.create_upload, 401)
    lab.write(blobs.put_blob, b"c" * 600, who=lab.contributor)  # the quota of somebody else
    clock.advance(0.21 * 86400)
    lab.write(blobs.put_blob, b"b" * 600)
    clock.advance(10 * 86400)
    with pytest.raises(QuotaExceededProblem):
        lab.write(blobs.put_blob, b"d" * 1001)


def test_bytes_of_a_cancelled_upload_count_if_they_were_received(lab: Lab) -> None:
    lab.database.quotas = Quotas(user_daily_bytes=1000)
    upload = lab.write(uploads.create_upload, 1000)
    lab.write(uploads.append, upload.id, 0, b"a" * 300)
    lab.write(uploads.abandon, upload.id)
    with pytest.raises(QuotaExceededProblem):
        lab.write(uploads.create_upload, 701)
    lab.write(uploads.create_upload, 699)


def test_an_upload_of_bytes_that_are_there_does_not_count(lab: Lab) -> None:
    lab.database.quotas = Quotas(user_daily_bytes=1300)
    data = b"a" * 600
    first = lab.write(uploads.create_upload, len(data))
    lab.write(uploads.append, first.id, 0, data)
    lab.write(blobs.put_blob, data)
    lab.write(uploads.finish, first.id, digest_of(data), None)
    lab.write(blobs.put_blob, b"b" * 600)


def test_every_quota_is_a_setting_with_the_same_default() -> None:
    assert Settings().quotas == Quotas()
    assert {field.name for field in fields(Quotas)} <= Settings.model_fields.keys()
