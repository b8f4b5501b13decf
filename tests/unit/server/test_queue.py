"""Claims, leases and ends of jobs."""

from dataclasses import replace
from typing import Any

import pytest
from tests.support.present import present
from tests.support.queue_desk import Desk

from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobCreate, Progress
from marey_schemas.queue.worker_protocol import BatchCompletion, ClaimRequest, CompleteRequest
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ForbiddenProblem, InvalidProblem, LeaseLostProblem, NotFoundProblem
from marey_server.store import projects
from marey_server.store.jobs import completion, queue
from marey_server.store.jobs.endings import Ended
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database


def test_a_job_is_claimed_once_and_completed(desk: Desk) -> None:
    job = desk.submit()
    assert desk.state(job) == "queued"

    lease = desk.claim()
    assert (lease.job, lease.project, lease.fence, lease.attempt) == (job, "lab", 1, 1)
    assert desk.claim_many() == []
    assert desk.state(job) == "running"

    answer = desk.complete(lease, result={"frames": 12})
    assert answer.state == "succeeded"
    assert desk.job(job).result == {"frames": 12, "outputs": 0}
    assert desk.state(job) == "succeeded"


def test_what_an_attempt_staged_is_published_when_it_completes_and_not_before(desk: Desk) -> None:
    job = desk.submit(into="results")
    lease = desk.claim()
    assert desk.stage(lease, "a", "b", collection="deep") == 2
    assert desk.outputs(job) == []

    answer = desk.complete(lease)
    assert [one.name for one in answer.outputs] == ["a", "b"]
    assert [(one.name, one.revision, one.created) for one in desk.outputs(job)] == [("a", 1, True), ("b", 1, True)]


def test_a_worker_that_lost_its_lease_cannot_publish(desk: Desk) -> None:
    job = desk.submit()
    slept = desk.claim()
    desk.stage(slept, "stale")
    desk.clock.advance(slept.lease_ttl_s + 1)
    assert desk.reap() == 1
    awake = desk.claim()
    assert awake.fence > slept.fence

    for act in (
        lambda: desk.heartbeat(slept),
        lambda: desk.stage(slept, "late"),
        lambda: desk.complete(slept),
        lambda: desk.fail(slept),
    ):
        with pytest.raises(LeaseLostProblem):
            act()
    desk.stage(awake, "fresh")
    desk.complete(awake)
    with pytest.raises(LeaseLostProblem):
        desk.complete(slept)
    assert [one.name for one in desk.outputs(job)] == ["fresh"]


def test_jobs_are_picked_by_priority_and_then_by_age(desk: Desk) -> None:
    first = desk.submit()
    second = desk.submit()
    urgent = desk.submit(priority=5)
    idle = desk.submit(priority=-5)
    assert [lease.job for lease in desk.claim_many()] == [urgent, first, second, idle]


def test_a_worker_gets_only_kinds_and_labels_that_it_names(desk: Desk) -> None:
    gpu = desk.submit(labels={"gpu": "a100", "site": "lyon"})
    other_kind = desk.submit("sum")
    assert desk.claim_many(kinds=("errand",)) == []
    assert desk.claim_many(kinds=("errand",), labels={"gpu": "a100"}) == []
    held = desk.claim_many(kinds=("errand",), labels={"site": "lyon", "gpu": "a100", "disk": "ssd"})
    assert [lease.job for lease in held] == [gpu]
    assert [lease.job for lease in desk.claim_many(kinds=("sum",))] == [other_kind]


def test_too_many_labels_are_refused(desk: Desk) -> None:
    with pytest.raises(InvalidProblem, match="labels"):
        desk.claim_many(labels={f"label{n}": "x" for n in range(7)})


def test_a_worker_whose_token_is_bound_to_labels_announces_no_others(desk: Desk) -> None:
    plain = desk.submit()
    gpu = desk.submit(labels={"gpu": "a100"})
    both = desk.submit(labels={"gpu": "a100", "site": "lyon"})
    elsewhere = desk.submit(labels={"gpu": "a100", "site": "paris"})
    desk.user = replace(desk.user, labels={"gpu": "a100", "site": "lyon"})
    for labels in ({"gpu": "a100", "site": "paris"}, {"site": "paris"}, {"site": "lyon", "disk": "ssd"}):
        with pytest.raises(ForbiddenProblem, match="bound to other labels") as refused:
            desk.claim_many(labels=labels)
        assert refused.value.error_code == "label-not-allowed"
        assert refused.value.context["label"] in ("site=paris", "disk=ssd")
        assert refused.value.context["label"] in refused.value.detail
    assert [lease.job for lease in desk.claim_many(labels={"gpu": "a100"})] == [plain, gpu]
    assert [lease.job for lease in desk.claim_many(labels={"gpu": "a100", "site": "lyon"})] == [both]
    assert desk.claim_many(labels={"gpu": "a100", "site": "lyon"}, job=elsewhere) == []


def test_a_token_bound_to_no_label_claims_only_jobs_without_labels(desk: Desk) -> None:
    plain = desk.submit()
    desk.submit(labels={"gpu": "a100"})
    desk.user = replace(desk.user, labels={})
    with pytest.raises(ForbiddenProblem, match="gpu=a100"):
        desk.claim_many(labels={"gpu": "a100"})
    assert [lease.job for lease in desk.claim_many()] == [plain]


def test_at_most_one_job_runs_with_a_concurrency_key_and_others_are_passed_over(desk: Desk) -> None:
    keyed = [desk.submit(concurrency_key="camera") for _ in range(3)]
    free = desk.submit(priority=-1)
    leases = desk.claim_many()
    assert [lease.job for lease in leases] == [keyed[0], free]
    assert desk.claim_many() == []

    desk.complete(leases[0])
    assert [lease.job for lease in desk.claim_many()] == [keyed[1]]


def test_a_keyed_job_that_this_worker_cannot_do_does_not_stop_those_behind_it(desk: Desk) -> None:
    desk.submit(concurrency_key="camera", labels={"gpu": "a100"}, priority=5)
    plain = desk.submit(concurrency_key="camera")
    assert [lease.job for lease in desk.claim_many()] == [plain]


def test_only_the_job_that_is_asked_for_is_claimed(desk: Desk) -> None:
    desk.submit()
    wanted = desk.submit()
    assert [lease.job for lease in desk.claim_many(job=wanted)] == [wanted]
    assert desk.claim_many(job=wanted) == []


def test_a_late_heartbeat_keeps_a_lease_that_nobody_took(desk: Desk) -> None:
    desk.submit()
    lease = desk.claim()
    desk.clock.advance(lease.lease_ttl_s * 3)
    assert desk.heartbeat(lease).lease_ttl_s == pytest.approx(60, abs=5)
    assert desk.reap() == 0
    desk.complete(lease)


def test_the_token_of_an_attempt_ends_when_another_takes_its_place(desk: Desk) -> None:
    desk.submit()
    slept = desk.claim()
    assert desk.attempt(slept).project_id is not None
    desk.clock.advance(slept.lease_ttl_s + 1)
    assert desk.attempt(slept).project_id is not None
    desk.reap()
    with pytest.raises(LeaseLostProblem):
        desk.attempt(slept)
    awake = desk.claim()
    with pytest.raises(LeaseLostProblem):
        desk.attempt(slept)
    assert desk.attempt(awake).fence == awake.fence


def test_a_job_reads_nothing_of_another_project(desk: Desk) -> None:
    elsewhere = replace(desk, project="elsewhere")
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="elsewhere"))
    (theirs,) = elsewhere.things(1)
    made = elsewhere.submit("sum")
    for choice, code in (({"item": theirs}, "unknown-item"), ({"job": made}, "unknown-job")):
        with pytest.raises(InvalidProblem) as refused:
            desk.submit("square", inputs={"things": [choice]})
        assert [error.code for error in refused.value.errors] == [code]
    with pytest.raises(InvalidProblem) as refused:
        desk.submit(after=[made])
    assert [error.code for error in refused.value.errors] == ["unknown-job"]
    with pytest.raises(InvalidProblem) as refused:
        desk.submit("square", inputs={"things": {"collection": "raw"}})
    assert [error.code for error in refused.value.errors] == ["empty-collection"]
    assert elsewhere.submit("square", inputs={"things": [{"item": theirs}, {"job": made}]})


def test_jobs_of_a_deleted_project_rest_until_it_is_restored(desk: Desk) -> None:
    begun, queued = desk.submit(), desk.submit()
    lease = desk.claim(job=begun)
    desk.stage(lease, "made")
    desk.database.write(desk.user, projects.delete_project, "lab", expected_rev=None)
    assert desk.claim_many() == []
    assert desk.claim_many(job=queued) == []
    request = CompleteRequest(write_id=desk.write_id())
    attempt = desk.attempt(lease)
    desk.database.write(attempt, completion.complete, begun, lease.fence, request)
    desk.database.write(desk.user, projects.restore_project, "lab")
    assert [one.name for one in desk.outputs(begun)] == ["made"]
    assert [one.job for one in desk.claim_many()] == [queued]


def test_an_overdue_job_that_cannot_be_taken_back_keeps_no_other_from_it(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = desk.submit_many(*[JobCreate(kind="errand", max_attempts=1)] * 3)
    leases = {lease.job: lease for lease in desk.claim_many()}
    for lease in leases.values():
        desk.heartbeat(lease)
    desk.clock.advance(1000)

    def propagate_all_but_one(tx: Transaction, ended: list[Ended]) -> None:
        if any(end.id == jobs[1] for end in ended):
            raise ValueError("a fault of ours")
        propagate_ends(tx, ended)

    monkeypatch.setattr("marey_server.store.jobs.failure.propagate_ends", propagate_all_but_one)
    assert desk.reap() == 2
    assert [desk.state(job) for job in jobs] == ["failed", "running", "failed"]
    desk.complete(leases[jobs[1]])


def test_progress_is_shown_while_the_job_runs(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    desk.heartbeat(lease, Progress(done=3, total=12, note="third"))
    progress = desk.job(job).progress
    assert progress is not None
    assert (progress.done, progress.total, progress.note) == (3, 12, "third")


def test_a_lease_cannot_be_kept_beyond_the_time_limit_and_its_grace(desk: Desk) -> None:
    job = desk.submit(resources={"time_limit_s": 100})
    lease = desk.claim()
    assert desk.heartbeat(lease).deadline_s == pytest.approx(100, abs=5)
    desk.clock.advance(50)
    desk.heartbeat(lease)
    desk.clock.advance(49)
    assert desk.heartbeat(lease).lease_ttl_s == pytest.approx(31, abs=5)
    desk.clock.advance(40)
    answer = desk.heartbeat(lease)
    assert answer.deadline_s == 0
    assert answer.lease_ttl_s == 0
    assert desk.reap() == 1
    failure = desk.job(job).failure
    assert failure is not None
    assert failure.reason == "timeout"
    with pytest.raises(LeaseLostProblem):
        desk.complete(lease)


def test_a_worker_lost_long_before_its_time_was_over_is_lost_and_not_late(desk: Desk) -> None:
    job = desk.submit(resources={"time_limit_s": 100})
    desk.claim()
    desk.clock.advance(5000)
    assert desk.reap() == 1
    assert desk.state(job) == "queued"


def test_the_same_write_gets_the_same_answer_and_another_one_none(desk: Desk) -> None:
    desk.submit()
    lease = desk.claim()
    desk.stage(lease, "a")
    first = desk.complete(lease, write_id="write-one")
    assert desk.complete(lease, write_id="write-one") == first
    with pytest.raises(LeaseLostProblem):
        desk.complete(lease, write_id="write-two")
    with pytest.raises(LeaseLostProblem):
        desk.fail(lease, write_id="write-one")


def test_a_failure_said_twice_counts_once(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    first = desk.fail(lease, write_id="write-one")
    assert desk.fail(lease, write_id="write-one") == first
    assert first.retry_in_s == 10
    desk.clock.advance(11)
    again = desk.claim()
    assert desk.fail(lease, write_id="write-one") == first
    assert desk.state(job) == "running"
    with pytest.raises(LeaseLostProblem):
        desk.complete(lease, write_id="write-one")
    desk.complete(again)


def test_a_failed_job_rests_longer_each_time_and_then_has_failed(desk: Desk) -> None:
    job = desk.submit(max_attempts=4)
    rests = []
    for _ in range(3):
        rests.append(desk.fail(desk.claim(), detail="no luck").retry_in_s)
        assert desk.claim_many() == []
        desk.clock.advance(present(rests[-1]) + 1)
    assert rests == [10, 40, 160]
    desk.fail(desk.claim(), detail="no luck")
    failure = desk.job(job).failure
    assert failure is not None
    assert failure.reason == "attempts_exhausted"
    assert "no luck" in failure.detail


def test_an_error_that_trying_again_cannot_help_fails_the_job_at_once(desk: Desk) -> None:
    job = desk.submit()
    desk.fail(desk.claim(), "bad-input", retryable=False, detail="line 3 holds no number")
    failure = desk.job(job).failure
    assert failure is not None
    assert (failure.reason, failure.code, failure.detail) == ("error", "bad-input", "line 3 holds no number")


def test_a_job_that_brings_two_workers_down_in_the_same_way_is_not_given_to_a_third(desk: Desk) -> None:
    job = desk.submit(max_attempts=10)
    desk.fail(desk.claim(), "killed", signature="exit:SIGKILL")
    desk.clock.advance(11)
    desk.fail(desk.claim(), "raised", signature="exception:KeyError")
    desk.clock.advance(41)
    desk.fail(desk.claim(), "killed", signature="exit:SIGKILL")
    failure = desk.job(job).failure
    assert failure is not None
    assert failure.reason == "poison"


def test_interruptions_are_counted_apart_from_attempts(desk: Desk) -> None:
    job = desk.submit(max_attempts=1)
    for _ in range(20):
        assert desk.fail(desk.claim(), "stopped", interrupted=True).retry_in_s == 0
    assert (desk.job(job).attempt, desk.job(job).interruptions) == (0, 20)
    assert desk.fail(desk.claim(), "stopped", interrupted=True).state == "failed"


def test_a_lost_job_is_tried_again_until_its_attempts_are_used_up(desk: Desk) -> None:
    job = desk.submit(max_attempts=2)
    for _ in range(2):
        desk.heartbeat(desk.claim())
        desk.clock.advance(61)
        assert desk.reap() == 1
    failure = desk.job(job).failure
    assert failure is not None
    assert (failure.reason, failure.code) == ("attempts_exhausted", "worker-lost")


def test_a_queued_job_is_cancelled_at_once(desk: Desk) -> None:
    job = desk.submit()
    assert desk.cancel(job).state == "cancelled"
    assert desk.cancel(job).state == "cancelled"
    assert desk.claim_many() == []


def test_a_running_job_is_cancelled_when_its_worker_stops(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    assert desk.cancel(job).cancel_requested
    assert desk.heartbeat(lease).cancel_requested
    assert desk.fail(lease, "cancelled").state == "cancelled"
    assert desk.state(job) == "cancelled"


def test_a_worker_that_does_not_stop_loses_a_cancelled_job_after_a_grace(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    desk.cancel(job)
    desk.clock.advance(25)
    desk.heartbeat(lease)
    assert desk.reap() == 0
    desk.clock.advance(10)
    assert desk.reap() == 1
    assert desk.state(job) == "cancelled"
    with pytest.raises(LeaseLostProblem):
        desk.complete(lease)


@pytest.mark.parametrize("in_batch", [False, True])
def test_a_job_whose_cancellation_was_acknowledged_never_succeeds(desk: Desk, in_batch: bool) -> None:
    job = desk.submit(into="results")
    lease = desk.claim()
    desk.stage(lease, "late")
    assert desk.cancel(job).cancel_requested
    for _ in range(2):  # a repeated request gets the same answer
        if in_batch:
            asked = [BatchCompletion(job=job, fence=lease.fence, write_id="write-late")]
            answer = desk.database.write(desk.user, completion.complete_many, asked)[0].answer
        else:
            answer = desk.complete(lease, write_id="write-late")
        assert answer is not None
        assert (answer.state, answer.outputs) == ("cancelled", ())
    assert desk.state(job) == "cancelled"
    assert desk.outputs(job) == []
    assert desk.cancel(job).state == "cancelled"


def test_many_jobs_are_claimed_and_completed_at_once_each_with_its_own_answer(desk: Desk) -> None:
    desk.submit_many(*(JobCreate(kind="errand", params={"number": n}) for n in range(20)))
    leases = desk.claim_many()
    desk.stage(leases[3], "staged")
    desk.complete(leases[5], write_id="completed-alone")
    asked = [BatchCompletion(job=one.job, fence=one.fence, write_id=f"write-{one.job[-8:]}") for one in leases]
    asked.append(BatchCompletion(job="job_unknown", fence=1, write_id="12345678"))
    results = desk.database.write(desk.user, completion.complete_many, asked)

    assert [one.job for one in results] == [one.job for one in asked]
    refused = [index for index, one in enumerate(results) if one.answer is None]
    assert refused == [5, 20]
    assert (results[5].code, results[20].code) == ("lease-lost", "not-found")
    assert results[3].answer is not None
    assert [one.name for one in results[3].answer.outputs] == ["staged"]
    assert desk.database.write(desk.user, completion.complete_many, asked) == results


def test_of_two_completions_of_a_job_in_one_batch_only_the_first_is_accepted(desk: Desk) -> None:
    desk.submit()
    lease = desk.claim()
    first, same, other = (
        BatchCompletion(job=lease.job, fence=lease.fence, write_id=write_id, result={"number": number})
        for write_id, number in (("write-one", 1), ("write-one", 1), ("write-two", 2))
    )
    results = desk.database.write(desk.user, completion.complete_many, [first, same, other])
    assert [one.code for one in results] == [None, None, "lease-lost"]
    assert desk.job(lease.job).result == {"number": 1, "outputs": 0}


def test_many_completions_find_their_attempts_by_index(desk: Desk) -> None:
    if not desk.database.is_sqlite:
        return  # Postgres chooses a plan by the sizes of tables, and small ones it reads whole
    desk.submit_many(*(JobCreate(kind="errand") for _ in range(3)))
    leases = desk.claim_many()
    for number, lease in enumerate(leases):
        desk.stage(lease, f"staged {number}")
    asked = [BatchCompletion(job=one.job, fence=one.fence, write_id="write-many") for one in leases]
    run: list[str] = []

    def complete(tx: Transaction) -> list[str]:
        driver: Any = tx.connection.connection.driver_connection
        driver.set_trace_callback(run.append)
        completion.complete_many(tx, asked)
        driver.set_trace_callback(None)
        read = [text for text in run if text.startswith(("SELECT", "UPDATE", "DELETE"))]
        return [str(step[3]) for text in read for step in driver.execute(f"EXPLAIN QUERY PLAN {text}")]

    plan = desk.database.write(desk.user, complete)
    assert any("SEARCH staged_output" in step for step in plan)
    assert not [step for step in plan if step.startswith(("SCAN staged_output", "SCAN attempt", "SCAN job"))]


def test_one_result_that_names_unknown_bytes_is_refused_and_the_others_are_not(desk: Desk) -> None:
    desk.submit_many(*(JobCreate(kind="errand") for _ in range(3)))
    leases = desk.claim_many()
    asked = [BatchCompletion(job=one.job, fence=one.fence, write_id="write-one") for one in leases]
    archive = {"archive": {"blob": f"sha256:{'0' * 64}"}}
    asked[1] = asked[1].model_copy(update={"result": archive})
    results = desk.database.write(desk.user, completion.complete_many, asked)
    assert [one.code for one in results] == [None, "missing-blobs", None]
    assert [desk.state(one.job) for one in leases] == ["succeeded", "running", "succeeded"]


def test_a_worker_cannot_complete_what_another_token_claimed(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    stranger = Principal("user", desk.user.user_id, "ann", scopes=("work",), token_id="token_other")
    asked = [BatchCompletion(job=job, fence=lease.fence, write_id="12345678")]
    (result,) = desk.database.write(stranger, completion.complete_many, asked)
    assert result.code == "not-found"
    assert desk.state(job) == "running"


def test_an_attempts_token_works_for_its_own_attempt_only(desk: Desk) -> None:
    desk.submit()
    desk.submit()
    mine, other = desk.claim_many()
    me = desk.attempt(mine)
    assert (me.kind, me.job_id, me.fence) == ("attempt", mine.job, mine.fence)
    with pytest.raises(NotFoundProblem):
        desk.database.write(me, completion.complete, other.job, other.fence, CompleteRequest(write_id="12345678"))


def test_only_a_token_with_the_scope_work_may_claim(desk: Desk) -> None:
    desk.submit()
    idle = Principal("user", desk.user.user_id, "ann", scopes=("read", "jobs"))
    with pytest.raises(ForbiddenProblem):
        desk.database.write(idle, queue.claim, ClaimRequest(worker="w", kinds=("errand",)))
    elsewhere = Principal("user", desk.user.user_id, "ann", scopes=("work!project=other",))
    assert desk.database.write(elsewhere, queue.claim, ClaimRequest(worker="w", kinds=("errand",))) == []
    stranger = Principal("user", "user_stranger", "bob", scopes=("work",))
    assert desk.database.write(stranger, queue.claim, ClaimRequest(worker="w", kinds=("errand",))) == []
    everywhere = desk.database.write(SYSTEM, queue.claim, ClaimRequest(worker="w", kinds=("errand",)))
    assert len(everywhere) == 1


def test_another_version_of_the_protocol_is_refused(desk: Desk) -> None:
    with pytest.raises(InvalidProblem, match="protocol"):
        desk.claim_many(protocol=99)
