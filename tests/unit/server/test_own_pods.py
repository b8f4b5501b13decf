"""Pods that run one job each: which jobs get such a pod, the rights of its token, and the pods that are started."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError
from tests.support.cluster.dispatching import OWN_IMAGE
from tests.support.queue_desk import KINDS, Desk

from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobCreate, Resources
from marey_schemas.queue.own_pods import GPUS_LABEL, OWN_POD_LABEL, is_allowed_image
from marey_schemas.queue.scripts import ScriptCreate, ScriptRunCreate
from marey_schemas.queue.worker_protocol import ClaimRequest, Lease
from marey_server.access.own_pods import PodRules, labels_of_job
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ForbiddenProblem, InvalidProblem, UnauthenticatedProblem
from marey_server.launchers.kubernetes.dispatch_plan import DispatchPlan
from marey_server.launchers.kubernetes.manifests import Manifest, Pool
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.kubernetes.own_pod_jobs import Dispatch, own_pod_job
from marey_server.launchers.kubernetes.states import stuck_jobs
from marey_server.process.settings import Settings
from marey_server.store import projects
from marey_server.store.credentials import tokens
from marey_server.store.jobs import queue
from marey_server.store.jobs.claiming import own_pods, rights
from marey_server.store.jobs.claiming.own_pods import WaitingJob
from marey_server.store.jobs.reaper import StartGrace
from marey_server.store.monitoring.workers import WorkerMemory, claim_and_remember
from marey_server.store.scripts import registry, runs

RULES = PodRules(4096, 60, frozenset({"gpu=a100"}), ("registry.example.org/motion/",))
LARGE = Resources(memory_limit_mb=8000)
YES = {OWN_POD_LABEL: "yes"}
SCRIPT: dict[str, Any] = {
    "name": "train", "repository": "https://git.invalid/motion", "commit": "a" * 40,
    "argv": ["python", "train.py", "{output:fields}"], "outputs": {"fields": {"kind": "fields"}}, "image": OWN_IMAGE,
}  # fmt: skip


def labels(rules: PodRules | None = RULES, image: str | None = None, **fields: Any) -> dict[str, str]:
    return labels_of_job(JobCreate(kind="errand", **fields), image, rules, "")


# -- which jobs get a pod of their own --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, {}),
        ({"resources": {"memory_limit_mb": 4096, "expected_s": 60}}, {}),
        ({"resources": {"memory_limit_mb": 4097}}, YES),
        ({"resources": {"expected_s": 61}}, YES),
        ({"resources": {"gpus": 2}}, {GPUS_LABEL: "2", **YES}),
        ({"labels": {GPUS_LABEL: "1"}}, {GPUS_LABEL: "1", **YES}),
        ({"labels": YES}, YES),
        ({"labels": {"gpu": "a100"}, "resources": {"gpus": 1}}, {"gpu": "a100", GPUS_LABEL: "1", **YES}),
        ({"labels": {"site": "lyon"}, "resources": {"memory_limit_mb": 9000}}, {"site": "lyon"}),
    ],
)
def test_a_job_gets_a_pod_of_its_own_for_what_it_declares(fields: dict[str, Any], expected: dict[str, str]) -> None:
    assert labels(**fields) == expected


def test_without_own_pods_a_job_runs_on_workers_of_pools() -> None:
    assert labels(None, labels=YES, resources=Resources(memory_limit_mb=9000, gpus=1)) == {GPUS_LABEL: "1"}


@pytest.mark.parametrize(
    ("rules", "fields", "code"),
    [
        (None, {}, "no-own-pods"),
        (PodRules(4096, 60), {}, "image-not-allowed"),
        (RULES, {"labels": {"site": "lyon"}}, "no-own-pods"),
        (RULES, {"labels": {GPUS_LABEL: "two"}}, "bad-gpus"),
    ],
)
def test_a_script_with_an_image_that_cannot_run_is_refused(
    rules: PodRules | None, fields: dict[str, Any], code: str
) -> None:
    with pytest.raises(InvalidProblem) as refused:
        labels(rules, OWN_IMAGE, **fields)
    assert [error.code for error in refused.value.errors] == [code]


def test_images_are_allowed_by_digest_by_repository_or_by_prefix() -> None:
    repository = OWN_IMAGE.partition("@")[0]
    assert all(is_allowed_image(OWN_IMAGE, (one,)) for one in (OWN_IMAGE, repository, "registry.example.org/motion/"))
    others = (
        "",
        "registry.example.org/motion",
        f"{repository}x",
        "registry.example.org/mot",
        f"{repository}@sha256:ee",
    )
    assert not any(is_allowed_image(OWN_IMAGE, (one,)) for one in others)


@pytest.mark.parametrize(
    "image", ["torch", "torch:latest", f"torch@sha256:{'a' * 63}", f"-x@sha256:{'a' * 64}", "a b@c"]
)
def test_an_image_without_a_digest_is_refused(image: str) -> None:
    with pytest.raises(ValidationError, match="named by its digest"):
        ScriptCreate.model_validate(SCRIPT | {"image": image})


def test_own_pods_need_the_launcher_kubernetes() -> None:
    with pytest.raises(ValidationError, match="only the launcher kubernetes starts pods"):
        Settings(own_pods={"most": 1})
    assert Settings(launcher="kubernetes", own_pods={"labels": {"gpu=a100": {}}}).own_pods is not None


# -- claims -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def desk(desk: Desk) -> Desk:
    desk.database.pod_rules = RULES
    return desk


def pod_of(desk: Desk, job_id: str) -> Principal:
    token = rights.pod_token(desk.database.read(SYSTEM, rights.read_pod_key), job_id)
    return desk.database.read(SYSTEM, tokens.resolve_token, token)


def claim(desk: Desk, caller: Principal, **fields: Any) -> list[Lease]:
    request = ClaimRequest(**dict[str, Any](worker="pod", kinds=tuple(KINDS), labels=YES) | fields)
    return desk.database.write(caller, queue.claim, request, desk.policy)


def test_only_the_pod_of_a_job_claims_it(desk: Desk) -> None:
    large, small, other = desk.submit(resources=LARGE), desk.submit(), desk.submit(resources=LARGE)
    assert [lease.job for lease in desk.claim_many()] == [small]
    assert desk.claim_many(job=large) == []
    for caller in (desk.user, SYSTEM):
        with pytest.raises(ForbiddenProblem, match="reserved for pods"):
            claim(desk, caller, job=large)
    pod = pod_of(desk, large)
    for fields in ({}, {"job": other}, {"job": small}):
        with pytest.raises(ForbiddenProblem, match="only the job for which"):
            claim(desk, pod, **fields)
    claim_id = "c" * 16
    (lease,) = claim(desk, pod, job=large, claim_id=claim_id)
    (again,) = claim(desk, pod, job=large, claim_id=claim_id)
    assert (lease.job, again.attempt_token, again.fence) == (large, lease.attempt_token, lease.fence)
    assert claim(desk, pod, job=large) == []
    request = ClaimRequest(worker="pod", kinds=("errand",), job=large)
    state = desk.database.read(pod, rights.state_of_named, request)
    desk.complete(lease)
    assert (state, desk.database.read(pod, rights.state_of_named, request)) == ("running", "succeeded")
    assert desk.database.read(desk.user, rights.state_of_named, request) is None


def test_the_token_of_a_pod_is_bound_to_its_job(desk: Desk) -> None:
    large, other = desk.submit(resources=LARGE), desk.submit(resources=LARGE)
    key = desk.database.read(SYSTEM, rights.read_pod_key)
    forged = rights.pod_token(key, large).replace(large, other)
    gone = rights.pod_token(key, "job_" + "0" * 26)
    for text in (forged, gone, "mareypod_", f"mareypod_{large}.", f"mareypod_{large}.\u00e9"):
        with pytest.raises(UnauthenticatedProblem):
            desk.database.read(SYSTEM, tokens.resolve_token, text)
    assert pod_of(desk, large).scopes == ("work",)


def test_a_label_that_only_looks_like_that_of_pods_starts_no_pod(desk: Desk) -> None:
    forged = {f"x{OWN_POD_LABEL}": "yes"}
    desk.submit(labels={**forged, "site": "lyon"})
    desk.submit(labels={OWN_POD_LABEL.upper(): "yes", "site": f",{OWN_POD_LABEL}=yes"})
    own = [desk.submit(labels=YES), desk.submit(labels={"gpu": "a100"}, resources=LARGE)]
    assert [one.id for one in desk.database.read(SYSTEM, own_pods.read_waiting, 10)] == own


def test_pods_do_not_count_as_workers_of_one_user(desk: Desk) -> None:
    memory, grace = WorkerMemory(most_of_user=1), StartGrace(desk.policy)
    for number in range(3):
        job = desk.submit(resources=LARGE)
        request = ClaimRequest(worker=f"pod-{number}", kinds=tuple(KINDS), labels=YES, job=job)
        leases = desk.database.write(pod_of(desk, job), claim_and_remember, request, memory, grace, desk.policy)
        assert [lease.job for lease in leases] == [job]


def test_the_pods_of_tasks_claim_the_task_at_their_index(desk: Desk) -> None:
    given = {"things": [{"item": desk.things(1)[0]}]}
    parent = desk.submit("survey", params={"number": 3}, inputs=given, resources=LARGE)
    pod = pod_of(desk, parent)
    assert [claim(desk, pod, job=parent, task=index)[0].position for index in (2, 0)] == [2, 0]
    assert claim(desk, pod, job=parent, task=3) == []
    assert claim(desk, pod, job=parent) == []
    waiting = desk.database.read(SYSTEM, own_pods.read_waiting, 10)
    assert [(one.parent, one.position, one.siblings) for one in waiting] == [(parent, 1, 3)]


def test_a_script_with_an_image_waits_for_a_pod_with_this_image(desk: Desk) -> None:
    allowed = ("https://git.invalid/",)
    desk.database.write(desk.user, registry.register_script, "lab", ScriptCreate.model_validate(SCRIPT), allowed)
    job = desk.database.write(desk.user, runs.run_script, "lab", "train", ScriptRunCreate())
    assert job.labels == YES
    assert desk.claim_many() == []
    (waiting,) = desk.database.read(SYSTEM, own_pods.read_waiting, 10)
    assert (waiting.id, waiting.image) == (job.id, OWN_IMAGE)
    desk.database.pod_rules = None
    for act in (
        lambda: desk.database.write(desk.user, runs.run_script, "lab", "train", ScriptRunCreate()),
        lambda: desk.database.write(
            desk.user, registry.register_script, "lab", ScriptCreate.model_validate(SCRIPT | {"name": "b"}), allowed
        ),
    ):
        with pytest.raises(InvalidProblem, match=r"no pods for single jobs|does not allow the image"):
            act()


def test_jobs_that_cannot_start_now_do_not_wait_for_a_pod(desk: Desk) -> None:
    def waiting(**fields: Any) -> list[str]:
        return [one.id for one in desk.database.read(SYSTEM, own_pods.read_waiting, 10, **fields)]

    desk.submit()
    first, second = (desk.submit(resources=LARGE, concurrency_key="k") for _ in range(2))
    third = desk.submit(resources=LARGE)
    after = desk.submit(resources=LARGE, after=(third,))
    assert waiting() == [first, third]
    assert waiting(served=[third]) == [first]
    (lease,) = claim(desk, pod_of(desk, first), job=first)
    assert waiting() == [third]
    desk.limit_running(1)
    assert waiting() == []
    desk.limit_running(2)
    assert waiting() == [third]
    desk.complete(lease)
    assert waiting() == [second, third]
    desk.limit_running(1)
    assert waiting() == [second]
    assert after not in waiting()
    assert desk.database.read(SYSTEM, own_pods.read_unfinished, [first, second, "job_gone"]) == {second}


def test_no_pod_is_started_for_a_job_that_must_wait_for_another_pod(desk: Desk) -> None:
    first, second = (desk.submit(resources=LARGE, concurrency_key="k") for _ in range(2))
    third = desk.submit(resources=LARGE)

    def waiting(*served: str) -> list[str]:
        return [one.id for one in desk.database.read(SYSTEM, own_pods.read_waiting, 10, served)]

    assert waiting(first) == [third], "the pod of the first has not claimed it yet"
    assert waiting(first, third) == []
    desk.limit_running(1)
    assert waiting(first) == []
    desk.limit_running(2)
    (lease,) = claim(desk, pod_of(desk, first), job=first)
    assert waiting(first) == [third]
    desk.complete(lease)
    assert waiting(first, third) == [second]


def test_projects_take_turns_for_pods(desk: Desk) -> None:
    first = [desk.submit(resources=LARGE) for _ in range(3)]
    desk.project = "other"
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="other"))
    second = [desk.submit(resources=LARGE) for _ in range(2)]
    waiting = desk.database.read(SYSTEM, own_pods.read_waiting, 4)
    assert [one.id for one in waiting] == [first[0], second[0], first[1], second[1]]
    assert len({one.project for one in waiting}) == 2


def test_pods_of_tasks_that_have_claimed_nothing_count_against_the_limit_of_their_project(desk: Desk) -> None:
    given = {"things": [{"item": desk.things(1)[0]}]}
    parent = desk.submit("survey", params={"number": 3}, inputs=given, resources=LARGE)
    other = desk.submit(resources=LARGE)
    desk.limit_running(3)

    def waiting(pods: int) -> list[str]:
        return [one.id for one in desk.database.read(SYSTEM, own_pods.read_waiting, 10, (), {parent: pods})]

    assert (waiting(2), waiting(3)) == ([other], [])
    claim(desk, pod_of(desk, parent), job=parent, task=0)
    assert (waiting(2), waiting(3)) == ([other], [])


def test_a_job_that_makes_place_waits_and_says_why(desk: Desk) -> None:
    given = {"things": [{"item": desk.things(1)[0]}]}
    parent = desk.submit("survey", params={"number": 2}, inputs=given, resources=LARGE)
    single, running = (desk.submit(resources=LARGE) for _ in range(2))
    claim(desk, pod_of(desk, running), job=running)

    def postpone(job: str, *, tasks: bool) -> bool:
        return desk.database.write(SYSTEM, own_pods.postpone, job, "no node: " + "x" * 999, 60.0, tasks=tasks)

    assert (postpone(single, tasks=False), postpone(parent, tasks=True), postpone(running, tasks=False)) == (
        True,
        True,
        False,
    )
    told = desk.job(single).progress
    assert told is not None
    assert told.note.startswith("no node: xx")
    assert desk.database.read(SYSTEM, own_pods.read_waiting, 10) == []
    desk.clock.advance(61)
    assert len(desk.database.read(SYSTEM, own_pods.read_waiting, 10)) == 3
    claim(desk, pod_of(desk, single), job=single)
    assert desk.job(single).progress is None


# -- which pods are started -------------------------------------------------------------------------------------------

POOL = Pool("OWN-PODS", "http://marey:8460", ClusterOptions(image=OWN_IMAGE))


def a_job(
    name: str, fence: int = 0, parent: str | None = None, position: int | None = None, of: int = 0, **fields: Any
) -> WaitingJob:
    return WaitingJob(name, "errand", fence, 60, 512, YES, None, parent, position, of, **fields)


def in_cluster(dispatch: Dispatch, **status: Any) -> dict[str, Manifest]:
    job = own_pod_job(POOL, dispatch, time_limit_s=60)
    return {job["metadata"]["name"]: {**job, "status": status}}


FAILED = {"conditions": [{"type": "Failed", "status": "True"}]}


def test_a_job_is_started_once_and_again_after_its_pod_has_ended() -> None:
    plan = DispatchPlan(most=2)
    (start,) = plan.decide(0, [a_job("job_a")], {})
    assert start.dispatch == Dispatch("job_a", 1)
    assert plan.decide(0, [a_job("job_a")], in_cluster(start.dispatch)) == []
    claimed = plan.decide(0, [a_job("job_a", fence=2)], in_cluster(start.dispatch, **FAILED))
    assert [one.dispatch.number for one in claimed] == [2]
    unclaimed = in_cluster(start.dispatch, **FAILED)
    assert plan.decide(1, [a_job("job_a")], unclaimed) == []
    assert [one.dispatch.number for one in plan.decide(8, [a_job("job_a")], unclaimed)] == [2]


def test_no_more_pods_are_started_than_allowed() -> None:
    plan = DispatchPlan(most=3)
    waiting = [a_job(f"job_{letter}") for letter in "abcd"]
    assert [one.job.id for one in plan.decide(0, waiting, in_cluster(Dispatch("job_x", 1)))] == ["job_a", "job_b"]
    tasks = [a_job(f"job_{n}", parent="job_p", position=n, of=9) for n in range(9)]
    (start,) = plan.decide(0, tasks, in_cluster(Dispatch("job_x", 1)))
    assert start.dispatch == Dispatch("job_p", 1, 0, 9, 2)
    jobs = in_cluster(start.dispatch, completedIndexes="0-6")
    assert plan.decide(0, tasks[7:], jobs) == []
    assert [one.dispatch for one in plan.decide(0, [a_job("job_6", 2, "job_p", 6, 9)], jobs)] == [
        Dispatch("job_6", 3, 2)
    ]


def test_the_project_with_the_fewest_pods_gets_the_next_one() -> None:
    waiting = [a_job(f"job_{n}", parent="job_p", position=n, of=9, project="a") for n in range(9)]
    waiting += [a_job(f"job_{letter}", project="b") for letter in "xyz"]
    jobs = in_cluster(Dispatch("job_w", 1, project="b"))
    starts = DispatchPlan(most=6).decide(0, waiting, jobs)
    assert [(one.dispatch.job, one.dispatch.parallel) for one in starts] == [("job_p", 3), ("job_x", 1), ("job_y", 1)]
    starts = DispatchPlan(most=6, most_of_project=2).decide(0, waiting, jobs)
    assert [(one.dispatch.job, one.dispatch.parallel) for one in starts] == [("job_p", 2), ("job_x", 1)]


def test_no_more_tasks_get_pods_than_the_limit_of_their_project_allows() -> None:
    tasks = [a_job(f"job_{n}", parent="job_p", position=n, of=9, limited=True) for n in range(3)]
    (start,) = DispatchPlan(most=20).decide(0, tasks, {})
    assert (start.dispatch.size, start.dispatch.parallel) == (9, 3)


def test_pods_that_no_node_runs_make_place_only_if_other_jobs_need_it() -> None:
    plan = DispatchPlan(most=2, patience_s=100)
    jobs = in_cluster(Dispatch("job_a", 1)) | in_cluster(Dispatch("job_b", 1))
    assert stuck_jobs(jobs, []).keys() == jobs.keys()
    old, new = sorted(jobs)
    for now_s, waiting, stuck, expected in (
        (0, [], [old], []), (50, [], [old, new], []), (100, [], [old, new], []),
        (120, [a_job("job_c")], [old, new], [old]), (160, [a_job("job_c"), a_job("job_d")], [old, new], [old, new]),
        (170, [a_job("job_c")], [new], [new]), (180, [a_job("job_c")], [], []), (190, [a_job("job_c")], [new], []),
    ):  # fmt: skip
        assert plan.decide(now_s, waiting, jobs) == []
        assert plan.step_back(now_s, {name: jobs[name] for name in stuck}) == expected
    full = DispatchPlan(most=9, most_of_project=1, patience_s=0)
    jobs = in_cluster(Dispatch("job_a", 1, project="a")) | in_cluster(Dispatch("job_b", 1, project="b"))
    assert full.decide(0, [a_job("job_c", project="b")], jobs) == []
    assert full.step_back(0, jobs) == [name for name in jobs if "job-b" in name]


def test_one_task_and_the_tasks_of_huge_jobs_get_jobs_of_their_own() -> None:
    plan = DispatchPlan(most=9)
    single = [a_job("job_0", parent="job_p", position=0, of=2)]
    huge = [a_job(f"job_{n}", parent="job_q", position=n, of=20_000) for n in (1, 2)]
    assert [one.dispatch.job for one in plan.decide(0, single + huge, {})] == ["job_0", "job_1", "job_2"]
