"""Jobs that wait for the result of an identical job: for which job, and what they do if they cannot have the result."""

from typing import Any

import pytest
from tests.support.queue_desk import Desk

from marey_schemas.queue.jobs import JobCreate

GPU = {"gpu": "a100"}
BIG_GPU = {"gpu": "a100", "memory": "large"}


def submit(desk: Desk, **fields: Any) -> str:
    """Submit a job of the kind `sum`; all of these jobs are identical."""
    return desk.submit("sum", **fields)


def source(desk: Desk, job: str) -> str | None:
    """Return the job for whose result a job waits, or None if the job is queued."""
    found = desk.job(job)
    assert found.state == ("queued" if found.cached_from is None else "waiting")
    return found.cached_from


# -- which job --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "waits"),
    [
        ({"labels": GPU}, {}, False),
        ({"labels": BIG_GPU}, {"labels": GPU}, False),
        ({"labels": {"gpu": "a10"}}, {"labels": GPU}, False),
        ({"labels": GPU}, {"labels": GPU}, True),
        ({"labels": GPU}, {"labels": BIG_GPU}, True),
        ({}, {"labels": GPU}, True),
        ({"priority": -1}, {}, False),
        ({"priority": 1}, {}, True),
        ({"concurrency_key": "press"}, {}, False),
        ({"concurrency_key": "press"}, {"concurrency_key": "press"}, True),
        ({}, {"concurrency_key": "press"}, True),
    ],
)
@pytest.mark.parametrize("together", [False, True], ids=["separately", "in-one-request"])
def test_a_job_waits_only_for_an_identical_one_that_runs_no_later_than_itself(
    desk: Desk, first: dict[str, Any], second: dict[str, Any], waits: bool, together: bool
) -> None:
    if together:
        one, two = desk.submit_many(JobCreate(kind="sum", **first), JobCreate(kind="sum", **second))
    else:
        one, two = submit(desk, **first), submit(desk, **second)
    assert source(desk, two) == (one if waits else None)


def test_a_job_without_labels_ends_although_no_worker_takes_the_identical_one_with_labels(desk: Desk) -> None:
    idle = submit(desk, labels=GPU)
    desk.complete(desk.claim(job=submit(desk)))
    assert desk.claim_many() == []
    assert desk.state(idle) == "queued"
    assert desk.state(submit(desk, labels=GPU)) == "succeeded"


def test_a_job_waits_for_one_of_lower_priority_that_a_worker_runs_already(desk: Desk) -> None:
    first = submit(desk, priority=-1)
    lease = desk.claim()
    urgent, labelled = submit(desk), submit(desk, labels=GPU)
    assert (source(desk, urgent), source(desk, labelled)) == (first, first)
    desk.complete(lease)
    assert (desk.state(urgent), desk.state(labelled)) == ("succeeded", "succeeded")


def test_a_job_waits_for_none_that_runs_on_a_worker_with_other_labels(desk: Desk) -> None:
    submit(desk, labels=GPU)
    desk.claim(labels=GPU)  # if this worker is lost, no other may come
    assert source(desk, submit(desk)) is None


def test_of_several_identical_jobs_the_next_waits_for_the_one_that_runs_first(desk: Desk) -> None:
    submit(desk, labels=GPU)
    submit(desk)
    urgent = submit(desk, priority=5)
    assert source(desk, submit(desk)) == urgent


def test_the_tasks_of_a_divided_job_are_no_longer_waited_for_than_single_jobs(desk: Desk) -> None:
    desk.things(2)
    fields: dict[str, Any] = {"params": {"number": 2}, "inputs": {"things": {"collection": "raw"}}}
    desk.submit("survey", labels=GPU, **fields)
    plain = desk.submit("survey", **fields)
    assert desk.job(plain).children == {"queued": 2}
    low = desk.submit("survey", priority=-1, **fields)
    assert source(desk, low) == plain


def test_a_job_becomes_ready_and_does_not_wait_for_one_with_labels(desk: Desk) -> None:
    gate = desk.submit()
    behind = submit(desk, after=[gate])
    submit(desk, labels=GPU)
    desk.complete(desk.claim())
    assert source(desk, behind) is None
