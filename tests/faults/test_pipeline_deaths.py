"""Servers and workers that are killed during a pipeline: the pipeline continues, and has the same results."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.rest_server import stored_file
from tests.support.server_process import QUICK_LEASES, ServerProcess, WorkerProcess
from tests.support.short_walks import write_short_walks
from tests.support.tiers import is_soak

from marey_client.handles.pipelines import PipelineRun
from marey_client.imports import LocalFile, find_files
from marey_client.project import ProjectHandle
from marey_motion.clip import Clip
from marey_motion.formats import write_motion
from marey_motion.gait import game_skeleton
from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobState
from marey_schemas.queue.pipelines import PipelineCreate
from marey_server.store.jobs.propagation import MOST_AT_ONCE

pytestmark = pytest.mark.timeout(900)


StartWorker = Callable[..., WorkerProcess]


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[LocalFile]:
    """Different short walks as BVH files: 40, or 17 in the tier `test`; 16 clips make a task."""
    return write_short_walks(tmp_path_factory.mktemp("takes"), 40 if is_soak() else 17)


@pytest.fixture
def few_takes(takes: list[LocalFile]) -> list[LocalFile]:
    """Takes for a test in which the number of tasks does not matter: two, or all in the tier `soak`."""
    return takes if is_soak() else takes[:2]


@pytest.fixture
def server(tmp_path: Path, database_url: str) -> Iterator[ServerProcess]:
    process = ServerProcess(tmp_path, database_url, **QUICK_LEASES)
    yield process
    process.stop()


@pytest.fixture
def start_worker(tmp_path: Path, server: ServerProcess) -> Iterator[StartWorker]:
    workers: list[WorkerProcess] = []

    def start(name: str, *, fault: str | None = None) -> WorkerProcess:
        worker = WorkerProcess(tmp_path / f"{name}.log")
        workers.append(worker)
        return worker.start(server.url, server.token, tmp_path, name=name, fault=fault)

    yield start
    for worker in workers:
        worker.stop()


def game_rig(lab: ProjectHandle, folder: Path) -> str:
    """Import a clip on another skeleton, the target of retargeting; return the id of this skeleton."""
    skeleton = game_skeleton()
    at_rest = np.concatenate([skeleton.offsets[0], skeleton.rest_rotations.ravel()]).astype(np.float32)
    file = folder / "game.bvh"
    file.write_bytes(write_motion(Clip(skeleton, 30.0, np.tile(at_rest, (5, 1)), None, ()), "bvh"))
    [entry] = lab.imports.upload(list(find_files([file]).files))
    assert entry.skeleton is not None, entry
    return entry.skeleton


def game_twice(lab: ProjectHandle, takes: list[LocalFile], folder: Path) -> PipelineCreate:
    """Return a pipeline that imports the takes, retargets them to another skeleton, and retargets the results again."""
    files = [file.model_dump() for file in lab.imports.send(takes)]
    skeleton = {"item": game_rig(lab, folder)}
    steps: dict[str, Any] = {
        "import": {"kind": "import", "params": {"files": files}, "into": "raw"},
        "game": {"kind": "retarget", "inputs": {"clips": {"step": "import"}, "skeleton": skeleton}, "into": "game"},
        "again": {"kind": "retarget", "inputs": {"clips": {"step": "game"}, "skeleton": skeleton}, "into": "again"},
    }
    return PipelineCreate.model_validate({"steps": steps})


def assert_made_once(lab: ProjectHandle, run: PipelineRun, takes: list[LocalFile]) -> None:
    """Check that every step has succeeded, and that every clip exists once, at its first revision, with its sources."""
    assert {job.state for job in run.refresh().values()} == {JobState.SUCCEEDED}, run
    for folder, inputs in (("raw", 0), ("game", 2), ("again", 2)):
        clips = list(lab.clips.list(collection=folder))
        assert [clip.item.revision for clip in clips] == [1] * len(takes), folder
        assert len({clip.path for clip in clips}) == len(takes), folder
        assert len(clips[0].lineage().inputs) >= inputs
    assert all(not clip.staleness().stale for clip in lab.clips.list(collection="again"))


@pytest.mark.every_nth(4)
@pytest.mark.parametrize("nth", ["@1", "@2"])
@pytest.mark.parametrize("place", ["late_inputs.before_commit", "late_inputs.after_commit"])
def test_a_server_killed_where_a_job_gets_its_inputs_goes_on_with_all_of_them_or_none(
    server: ServerProcess,
    takes: list[LocalFile],
    few_takes: list[LocalFile],
    tmp_path: Path,
    start_worker: StartWorker,
    place: str,
    nth: str,
) -> None:
    takes = takes if nth == "@1" else few_takes
    server.start(fault=f"{place}{nth}:kill")
    with server.client() as marey:
        lab = marey.create_project(ProjectCreate(name="lab"))
        run = lab.pipeline(game_twice(lab, takes, tmp_path))
        start_worker("steady")
        assert server.wait_until_dead() == -signal.SIGKILL
        server.start()
        run.wait(timeout_s=PATIENCE_S)
        assert_made_once(marey.project("lab"), run, takes)
    server.check_database()


@pytest.mark.parametrize("place", ["submit.before_commit", "submit.after_commit"])
def test_a_server_killed_where_a_pipeline_is_handed_in_has_all_of_it_or_nothing(
    server: ServerProcess,
    few_takes: list[LocalFile],
    tmp_path: Path,
    start_worker: StartWorker,
    place: str,
) -> None:
    server.start(fault=f"{place}:kill")
    with server.client() as marey, ThreadPoolExecutor(1) as pool:
        lab = marey.create_project(ProjectCreate(name="lab"))
        handing_in = pool.submit(lab.pipeline, game_twice(lab, few_takes, tmp_path))
        assert server.wait_until_dead() == -signal.SIGKILL
        server.start()
        run = handing_in.result(PATIENCE_S)  # the client asks again, with the same Idempotency-Key
        assert len(list(marey.project("lab").jobs())) == 3
        start_worker("steady")
        run.wait(timeout_s=PATIENCE_S)
        assert_made_once(marey.project("lab"), run, few_takes)
    server.check_database()


@pytest.mark.parametrize("place", ["propagation.before_commit@2", "propagation.after_commit@2"])
def test_a_server_killed_while_the_dependants_of_a_cancelled_job_end_goes_on_with_the_others(
    server: ServerProcess, place: str
) -> None:
    server.start(fault=f"{place}:kill")
    api = {"base_url": f"{server.url}/api/v1", "headers": {"Authorization": f"Bearer {server.token}"}}
    with httpx.Client(**api, timeout=PATIENCE_S) as client:
        assert client.post("/projects", json={"name": "lab"}).is_success
        file = {"name": "take.bvh", "blob": stored_file(client, b"HIERARCHY")["blob"]}
        request = {"kind": "import", "params": {"files": [file]}}
        root = client.post("/projects/lab/jobs", json=request).raise_for_status().json()["id"]
        dependants = [{**request, "after": [root]}] * (4 * MOST_AT_ONCE)
        client.post("/projects/lab/jobs/batch", json={"jobs": dependants}).raise_for_status()
        last = client.post("/projects/lab/jobs", json={**request, "after": [root]}).raise_for_status().json()["id"]
        assert client.post(f"/jobs/{root}/cancel").raise_for_status().json()["state"] == "cancelled"
        assert server.wait_until_dead() == -signal.SIGKILL
        server.start()
        wait_until(lambda: client.get(f"/jobs/{last}").json()["state"] == "failed")
    with server.client() as marey:
        jobs = list(marey.jobs.list("lab", limit=1000))
        assert Counter(job.state for job in jobs) == {JobState.CANCELLED: 1, JobState.FAILED: len(dependants) + 1}
    server.check_database()


@pytest.mark.every_nth(4)
@pytest.mark.parametrize("place", ["after_claim", "after_blob", "before_complete", "after_complete"])
def test_a_worker_killed_under_a_pipeline_is_replaced_and_nothing_is_there_twice(
    server: ServerProcess,
    takes: list[LocalFile],
    few_takes: list[LocalFile],
    tmp_path: Path,
    start_worker: StartWorker,
    place: str,
) -> None:
    deaths = (1, 3)
    if place in ("after_claim", "after_complete") and not is_soak():  # a pipeline of three jobs without tasks
        takes, deaths = few_takes, (1, 2)
    server.start()
    with server.client() as marey:
        lab = marey.create_project(ProjectCreate(name="lab"))
        wanted = game_twice(lab, takes, tmp_path)
        dying = [start_worker(f"dying-{n}", fault=f"worker.{place}@{n}:kill") for n in deaths]
        run = lab.pipeline(wanted)
        for worker in dying:
            assert worker.wait_until_dead() == -signal.SIGKILL
        start_worker("healthy")
        run.wait(timeout_s=PATIENCE_S)
        assert_made_once(lab, run, takes)
    server.check_database()
