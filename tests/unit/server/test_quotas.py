"""Quotas of users: concurrent requests cannot exceed a quota, and used quota becomes free when something ends."""

import os
import random
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import fields, replace
from typing import Any

import pytest
from sqlalchemy import event, update
from tests.support.database_fixtures import AdjustableClock
from tests.support.queue_desk import Desk
from tests.support.store_fixtures import Lab, skeleton_tree

from marey_schemas.access import ProjectCreate, TokenCreate
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.queue.jobs import ItemInput, JobCreate
from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.errors import QuotaExceededProblem
from marey_server.motions import importing
from marey_server.motions.importing import PreparedImport, SourceFile
from marey_server.prepared_documents import prepare_document
from marey_server.process.settings import Settings
from marey_server.store import blobs, items, projects, uploads
from marey_server.store.credentials import tokens
from marey_server.store.database import connections
from marey_server.store.garbage import collect_garbage
from marey_server.store.items import Draft
from marey_server.store.jobs import reading, submission
from marey_server.store.tables import user
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


def test_a_submission_does_not_count_the_unfinished_jobs_again_while_there_is_room(desk: Desk) -> None:
    counts: list[str] = []

    def note(_connection: Any, _cursor: Any, statement: str, *_others: Any) -> None:
        if "count(*)" in statement and "FROM job" in statement:
            counts.append(statement)

    desk.database.quotas = Quotas(user_jobs=2 * LIMIT)
    event.listen(desk.database.engine, "before_cursor_execute", note)
    jobs = [desk.submit() for _ in range(2 * LIMIT)]
    assert len(counts) == 1
    with pytest.raises(QuotaExceededProblem, match="6 unfinished jobs"):
        desk.submit()
    for one in jobs[:LIMIT]:
        desk.cancel(one)
    counts.clear()
    for _ in range(LIMIT):
        desk.submit()
    assert len(counts) == 1
    with pytest.raises(QuotaExceededProblem, match="6 unfinished jobs"):
        desk.submit()


@pytest.mark.every_database
def test_the_first_count_waits_for_tasks_that_are_being_stored(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """After an upgrade, nobody has counted the jobs yet. On SQLite, writes follow one another in any case."""
    if desk.database.is_sqlite:
        return
    maker = desk.submit("sum")
    desk.submit("square", inputs={"things": [{"job": maker}]})
    desk.database.write(SYSTEM, lambda tx: tx.execute(update(user).values(jobs_bound=None)))
    desk.database.quotas = Quotas(user_jobs=5)
    lease = desk.claim(job=maker)
    desk.stage(lease, *(f"sum{number}" for number in range(5)))
    storing, go_on = threading.Event(), threading.Event()

    def hold(name: str) -> None:
        if name == "late_inputs.before_commit":
            storing.set()
            assert go_on.wait(60)

    monkeypatch.setattr(faults, "point", hold)
    with ThreadPoolExecutor() as pool:
        completing = pool.submit(desk.complete, lease)
        assert storing.wait(60)
        try:
            submitting = pool.submit(desk.submit)
            wait([submitting], 0.5)
        finally:
            go_on.set()
        completing.result(60)
        submitting.result(60)
    with pytest.raises(QuotaExceededProblem, match="5 unfinished jobs"):  # three tasks, their parent, and another job
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
    desk.database.quotas = Quotas(user_jobs=9)
    desk.submit_many(*[JobCreate(kind="errand")] * 3)
    with pytest.raises(QuotaExceededProblem, match="9 unfinished jobs"):
        desk.submit()


@pytest.mark.every_database
def test_submissions_at_once_never_exceed_the_quota_of_unfinished_jobs(desk: Desk) -> None:
    desk.database.quotas = Quotas(user_jobs=LIMIT)
    jobs = [desk.submit() for _ in range(LIMIT)]
    for one in jobs:
        desk.cancel(one)  # now each submission that may not rely on the stored number counts

    def submit_slowly(tx: Transaction) -> None:
        submission.submit(tx, desk.project, [JobCreate(kind="errand")])
        time.sleep(0.1)  # so that others count before this transaction is committed

    futures = [desk.database.submit_write(desk.user, submit_slowly) for _ in range(2 * LIMIT)]
    errors = [future.exception(60) for future in futures]
    assert [type(error) for error in errors if error is not None] == [QuotaExceededProblem] * LIMIT


def test_inputs_of_submitted_jobs_are_limited_per_day_even_if_the_jobs_are_cancelled(desk: Desk) -> None:
    desk.database.quotas = Quotas(user_daily_inputs=10)
    things = tuple(ItemInput(item=one) for one in desk.things(4))
    desk.cancel(desk.submit("square", inputs={"things": things}))
    ruled = {"things": things, "ruler": things[0]}  # each row has the ruler: the job and its two tasks
    with pytest.raises(QuotaExceededProblem, match="10 inputs per day, and this needs 7 more") as refused:
        desk.submit("square", inputs=ruled, cache="off")
    assert refused.value.context["wait_s"] == pytest.approx(0.1 * 86400, abs=60)
    with pytest.raises(QuotaExceededProblem, match="needs 16 more") as refused:
        desk.submit("survey", inputs={"things": things}, params={"number": 3})
    assert refused.value.context["wait_s"] is None
    desk.clock.advance(0.1 * 86400 + 60)
    desk.submit("square", inputs=ruled, cache="off")


def test_inputs_that_jobs_get_later_count_for_their_author(desk: Desk) -> None:
    desk.database.quotas = Quotas(user_daily_inputs=7)
    maker = desk.submit("sum")
    late = desk.submit_many(
        *(JobCreate(kind="square", inputs={"things": {"job": maker}}, into=f"{n}") for n in range(2))
    )
    lease = desk.claim()
    desk.stage(lease, *(f"thing{number}" for number in range(4)))
    desk.complete(lease)  # each of the two jobs gets four inputs for one that was counted
    states = [desk.state(job) for job in late]
    assert sorted(states) == ["failed", "running"]
    failure = desk.job(late[states.index("failed")]).failure
    assert failure is not None
    assert (failure.code, failure.detail) == (
        "quota-exceeded",
        "The job and its tasks would get 3 inputs, more than its author may submit now (quota `user_daily_inputs`). "
        "Retry the job later.",
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


def make_skeleton(tx: Transaction, name: str, bone_m: float) -> Item:
    parts = {"hierarchy": skeleton_tree(bone_m=bone_m)}
    return items.create_item(tx, "lab", Kind.SKELETON, ItemCreate(name=name, parts=parts))


def test_documents_of_items_count_for_the_day_even_if_the_items_are_deleted(lab: Lab) -> None:
    """A user who creates and deletes items in turn must not fill the disk without using up a quota."""
    size_bytes = prepare_document(skeleton_tree(bone_m=1.0)).size_bytes
    lab.database.quotas = Quotas(user_daily_bytes=int(2.5 * size_bytes))
    first = lab.write(make_skeleton, "first", 1.0)
    lab.write(make_skeleton, "again", 1.0)  # the server has its document already
    lab.write(items.delete_item, "lab", Kind.SKELETON, first.id, expected_rev=first.rev)
    second = lab.write(make_skeleton, "second", 2.0)
    with pytest.raises(QuotaExceededProblem, match="new bytes per day"):
        lab.write(make_skeleton, "third", 3.0)
    changed = "lab", Kind.SKELETON, second.id, "hierarchy", skeleton_tree(bone_m=4.0)
    with pytest.raises(QuotaExceededProblem, match="new bytes per day"):
        lab.write(items.put_part, *changed, expected_rev=second.rev)
    lab.write(make_skeleton, "third", 3.0, who=lab.contributor)  # the quota of somebody else


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


def test_pieces_of_an_upload_that_is_not_needed_count_until_they_are_deleted(lab: Lab) -> None:
    """A user who uploads the same bytes again and again must not fill the disk without using up a quota."""
    lab.database.quotas = Quotas(user_upload_bytes=1000)
    data = b"a" * 600
    for again in (False, True):
        made = lab.write(uploads.create_upload, len(data))
        lab.write(uploads.append, made.id, 0, data)
        lab.write(uploads.finish, made.id, digest_of(data), None)
        if not again:  # the pieces of the first upload are the blob
            lab.write(uploads.abandon, lab.write(uploads.create_upload, 1000).id)
    with pytest.raises(QuotaExceededProblem, match="Wait until the server has deleted the pieces"):
        lab.write(uploads.create_upload, 401)
    open_one = lab.write(uploads.create_upload, 400)
    with pytest.raises(QuotaExceededProblem, match=f"such as {open_one.id}"):
        lab.write(uploads.create_upload, 1)
    collect_garbage(lab.database)
    lab.write(uploads.create_upload, 600)


def read_file(name: str, *contents: bytes) -> PreparedImport:
    """Return the result of reading a file whose bytes were sent in several parts, and which contains one skeleton."""
    sources = tuple(SourceFile(name, digest_of(data), len(data), data) for data in contents)
    rig = Draft(name, Kind.SKELETON, name, {"hierarchy": skeleton_tree(bone_m=1 + len(name))}, reuse="by_name")
    return PreparedImport(name, sources, (rig,))


def test_files_of_an_import_that_exceed_the_day_are_refused_and_the_others_are_stored(lab: Lab) -> None:
    lab.database.quotas = Quotas(user_daily_bytes=1000)
    names = ("a", "bb", "ccc", "dddd")
    files = [read_file(name, name.encode() * size) for name, size in zip(names, (500, 150, 150, 100), strict=True)]
    entries = lab.write(importing.publish, "lab", files)
    assert [entry.error and entry.error.code for entry in entries] == [None, None, "quota-exceeded", "quota-exceeded"]
    lab.write(importing.publish, "lab", files)  # what is stored already does not count again
    with pytest.raises(QuotaExceededProblem):
        lab.write(blobs.put_blob, b"x" * 201)
    lab.write(blobs.put_blob, b"x" * 199)


def test_an_import_that_is_being_stored_does_not_delay_other_uploads_of_the_user(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On SQLite, writes follow one another in any case."""
    if lab.database.is_sqlite:
        return
    storing, go_on = threading.Event(), threading.Event()
    publish = items.publish

    def slow_publish(*args: Any, **kwargs: Any) -> Any:
        storing.set()
        assert go_on.wait(60)
        return publish(*args, **kwargs)

    monkeypatch.setattr(items, "publish", slow_publish)
    with ThreadPoolExecutor() as pool:
        importing_files = pool.submit(lab.write, importing.publish, "lab", [read_file("rig", b"a" * 100)])
        assert storing.wait(60)
        try:
            upload = pool.submit(lab.write, uploads.create_upload, 7).result(30)
            pool.submit(lab.write, uploads.append, upload.id, 0, b"example").result(30)
            pool.submit(lab.write, uploads.finish, upload.id, digest_of(b"example"), None).result(30)
            pool.submit(lab.write, blobs.put_blob, b"b" * 100).result(30)
        finally:
            go_on.set()
        assert importing_files.result(60)[0].error is None


def test_concurrent_uploads_of_one_user_do_not_deadlock_and_all_of_them_count(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Imports store the same files in different orders, at the same time as other uploads of the user."""
    monkeypatch.setattr(connections, "WRITE_TRIES", 1)  # so that a deadlock is an error
    lab.database.quotas = Quotas(user_daily_bytes=1_000_000)
    shared = [b"%d" % number * 1000 for number in range(10)]
    draw = random.Random(7)

    def import_files(number: int) -> Any:
        mine = [b"%d" % number * 500, *draw.sample(shared, len(shared))]
        files = [read_file(f"{number}-{place}", data) for place, data in enumerate(mine)]
        return lab.write(importing.publish, "lab", files)

    def upload(number: int) -> Any:
        data = b"u%d" % number * 500
        begun = lab.write(uploads.create_upload, len(data))
        lab.write(uploads.append, begun.id, 0, data)
        lab.write(uploads.finish, begun.id, digest_of(data), None)
        lab.write(blobs.put_blob, shared[number % len(shared)])

    with ThreadPoolExecutor(8) as pool:
        works = [pool.submit(work, 10 + number) for number in range(12) for work in (import_files, upload)]
        for work in works:
            work.result(120)
    sent_bytes = 12 * 2 * 500 + 12 * 3 * 500 + 10 * 1000
    with pytest.raises(QuotaExceededProblem):
        lab.write(blobs.put_blob, b"x" * (1_000_001 - sent_bytes + 2_000))
    lab.write(blobs.put_blob, b"x" * (1_000_000 - sent_bytes - 2_000))


def test_every_quota_is_a_setting_with_the_same_default() -> None:
    assert Settings().quotas == Quotas()
    assert {field.name for field in fields(Quotas)} <= Settings.model_fields.keys()
