"""Servers and workers that are killed again and again under load: no confirmed write is lost or stored twice.

The tier `test` runs short forms. In the tier `soak`, a server is killed 77 times while 8 clients write. Two servers and
four workers are killed or stopped 206 times while 1,800 jobs run. 10,000 jobs are cancelled at the moment at which they
complete.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import secrets
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import Desk
from tests.support.server_process import PATIENT, QUICK_LEASES, MareyProcess, ServerProcess, WorkerProcess
from tests.support.short_walks import write_short_walks
from tests.support.tiers import is_soak

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.address import API
from marey_schemas.queue.jobs import Job, JobCreate, JobState
from marey_schemas.queue.worker_protocol import Lease
from marey_server.errors import ConflictProblem
from marey_server.store.database.connections import Database

pytestmark = pytest.mark.timeout(7200)

LONG = is_soak()
WRITERS = 8
WRITER_KILLS = 77 if LONG else 2
JOBS, JOB_KILLS, WORKERS = (1_800, 206, 4) if LONG else (12, 2, 1)
CANCELS = 10_000 if LONG else 128
CANCELS_AT_ONCE = 64
TAKES = 20 if LONG else 6
SLEEP_S = 4.0
"""Time for which a process is suspended; longer than a lease."""


@dataclass
class Writer:
    """Client that creates items and tags them, and repeats each request until the server has answered."""

    url: str
    token: str
    name: str
    created: dict[str, str] = field(default_factory=dict)
    """Ids of the items that the server acknowledged, by name."""
    repeated: int = 0

    def run(self, stopping: threading.Event) -> None:
        """Write until the event is set."""
        with _client(self.url, self.token) as client:
            for number in itertools.count():
                if stopping.is_set():
                    return
                self._write(client, f"{self.name}-{number}")

    def _write(self, client: httpx.Client, name: str) -> None:
        body = {"name": name, "parts": {"character": {"schema": "marey/document@1", "data": {"name": name}}}}
        made = self._send(client, "POST", "/projects/lab/characters", json=body, headers={"Idempotency-Key": name})
        assert made.status_code == 201, made.text
        self.created[name] = made.json()["id"]
        place = f"/projects/lab/characters/{self.created[name]}"
        tagged = self._send(client, "PATCH", place, json={"tags": ["done"]}, headers={"If-Match": made.headers["ETag"]})
        if tagged.status_code == 412:  # an earlier try was carried out, but its answer was lost
            tagged = self._send(client, "GET", place)
        assert tagged.status_code == 200, tagged.text
        assert tagged.json()["tags"] == ["done"]

    def _send(self, client: httpx.Client, method: str, path: str, **given: Any) -> httpx.Response:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(httpx.TransportError):
                answer = client.request(method, path, **given)
                if answer.status_code != 503:
                    return answer
            assert time.monotonic() < deadline, f"{method} {path} was not answered for {PATIENCE_S:.0f} s"
            self.repeated += 1
            time.sleep(0.05)


def test_a_server_that_is_killed_under_writers_keeps_each_acknowledged_write_once(
    tmp_path: Path, database_url: str
) -> None:
    chance = _seeded("kills")
    server = ServerProcess(tmp_path, database_url).start()
    try:
        with server.client() as marey:
            marey.create_project(ProjectCreate(name="lab"))
        writers = [Writer(server.url, server.token, f"writer{number}") for number in range(WRITERS)]
        stopping = threading.Event()
        with ThreadPoolExecutor(WRITERS) as pool:
            running = [pool.submit(writer.run, stopping) for writer in writers]
            try:
                for _ in range(WRITER_KILLS):
                    time.sleep(chance.uniform(0.05, 1.0))
                    server.kill()
                    server.start()
            finally:
                stopping.set()
        for each in running:
            each.result()
        created = {name: item for writer in writers for name, item in writer.created.items()}
        assert len(created) >= WRITERS
        with _client(server.url, server.token) as client:
            _assert_created_once(client, created)
    finally:
        server.stop()
    server.check_database()
    repeated = sum(writer.repeated for writer in writers)
    print(f"{WRITER_KILLS} kills, {2 * len(created)} acknowledged writes, {repeated} requests repeated")


def _assert_created_once(client: httpx.Client, created: dict[str, str]) -> None:
    """Check that the items exist once in the project, with their tags, and that one event reports each creation."""
    found = list(_characters(client))
    assert len(found) == len(created)
    assert {item["name"]: item["id"] for item in found} == created
    assert all(item["tags"] == ["done"] and item["revision"] == 1 for item in found)
    assert _creations(client, "character") == Counter(created.values())


def _client(url: str, token: str) -> httpx.Client:
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.Client(base_url=url + API, headers=headers, timeout=60, verify=False)


def _characters(client: httpx.Client) -> Iterator[dict[str, Any]]:
    params: dict[str, str] = {}
    while True:
        page = client.get("/projects/lab/characters", params=params).raise_for_status().json()
        yield from page["items"]
        if not page.get("next_cursor"):
            return
        params["cursor"] = page["next_cursor"]


def _creations(client: httpx.Client, kind: str) -> Counter[str]:
    """Return the number of events that report the creation of items of a kind, by item."""
    found: Counter[str] = Counter()
    after = 0
    while events := client.get("/projects/lab/events", params={"after": after}).raise_for_status().json()["items"]:
        found.update(
            event["subject"]
            for event in events
            if event["kind"] == "item.created" and event["body"]["item_kind"] == kind
        )
        after = events[-1]["seq"]
    return found


@pytest.fixture
def processes(tmp_path: Path, database_url: str) -> Iterator[tuple[list[ServerProcess], list[WorkerProcess]]]:
    """Two servers with the same database, and workers; nothing is started yet."""
    servers = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        servers.append(ServerProcess(tmp_path / name, database_url, **QUICK_LEASES))
    workers = [WorkerProcess(tmp_path / f"worker{number}.log") for number in range(WORKERS)]
    yield servers, workers
    for process in (*workers, *servers):
        process.stop()


@pytest.mark.soak
def test_two_servers_and_workers_that_are_killed_and_stopped_publish_each_job_once(
    tmp_path: Path, processes: tuple[list[ServerProcess], list[WorkerProcess]]
) -> None:
    chance = _seeded("kills and stops")
    servers, workers = processes
    for server in servers:
        server.start()
    token = servers[0].token
    starts = _starts(tmp_path, servers, workers, token)
    for start in starts[len(servers) :]:
        start()
    with Marey(servers[0].url, token, retries=PATIENT) as marey:
        lab = marey.create_project(ProjectCreate(name="lab"))
        clips, skeleton = _import_walks(lab, tmp_path)
        jobs: list[Job] = []
        submitting = threading.Thread(target=_submit_slowly, args=(lab, clips, skeleton, jobs))
        submitting.start()
        for _ in range(JOB_KILLS):
            time.sleep(chance.uniform(0.05, 0.8))
            number = chance.randrange(len(starts))
            _kill_or_stop((*servers, *workers)[number], starts[number], stops=chance.random() < 0.2)
        submitting.join()
        assert len(jobs) == JOBS
        ended = [_ended(marey, job) for job in jobs]
        assert Counter(job.state for job in ended) == {JobState.SUCCEEDED: JOBS}
        results = [output for job in ended for output in marey.jobs.outputs(job.id)]
        assert len(results) == len({output.item for output in results}) == JOBS
        assert {output.revision for output in results} == {1}
        with _client(servers[0].url, token) as client:
            made = _creations(client, "clip")
        assert all(made.pop(output.item) == 1 for output in results)
        assert set(made) == set(clips)
        attempts = sum(len(list(marey.jobs.attempts(job.id))) for job in ended)
    servers[0].check_database()
    print(f"{JOB_KILLS} kills and stops, {JOBS} jobs published once each, {attempts} attempts")


def _starts(
    folder: Path, servers: list[ServerProcess], workers: list[WorkerProcess], token: str
) -> list[Callable[[], object]]:
    """Return, for each server and worker, a function that starts it; each server gets half of the workers."""

    def start_worker(number: int) -> Callable[[], object]:
        cache, url = folder / f"cache{number}", servers[number % len(servers)].url
        cache.mkdir()
        return lambda: workers[number].start(url, token, cache, name=f"worker{number}")

    return [*(server.start for server in servers), *map(start_worker, range(len(workers)))]


def _kill_or_stop(process: MareyProcess, start: Callable[[], object], *, stops: bool) -> None:
    """Suspend a process for longer than a lease lasts, or kill it and start it again."""
    if stops and isinstance(process, WorkerProcess):
        process.send(signal.SIGSTOP)
        time.sleep(SLEEP_S)
        process.send(signal.SIGCONT)
    else:
        process.kill()
        start()


def _import_walks(lab: ProjectHandle, folder: Path) -> tuple[list[str], str]:
    """Import walks; return the ids of the clips, and of their skeleton."""
    takes = folder / "takes"
    takes.mkdir()
    entries = lab.imports.upload(write_short_walks(takes, TAKES))
    skeleton = entries[0].skeleton
    assert skeleton is not None
    return [entry.item or "" for entry in entries], skeleton


def _submit_slowly(lab: ProjectHandle, clips: list[str], skeleton: str, jobs: list[Job]) -> None:
    """Submit jobs a few at a time, so that jobs are waiting until the last kill."""
    for number in range(JOBS):
        request: dict[str, Any] = {
            "kind": "retarget",
            "inputs": {"clips": [{"item": clips[number % len(clips)]}], "skeleton": {"item": skeleton}},
            "into": f"results/{number}",
            "cache": "off",
            "max_attempts": 20,
        }
        jobs.append(lab.submit(JobCreate.model_validate(request)))
        time.sleep(JOB_KILLS / JOBS / 2)


def _ended(marey: Marey, job: Job) -> Job:
    deadline = time.monotonic() + PATIENCE_S
    while not (found := marey.jobs.get(job.id)).state.terminal:
        assert time.monotonic() < deadline, f"{job.id} is still {found.state}"
        time.sleep(0.1)
    return found


def test_a_job_whose_cancellation_is_acknowledged_never_succeeds(
    desk: Desk, open_database: Callable[[], Database]
) -> None:
    outcomes: Counter[str] = Counter()

    def cancel(job_id: str) -> bool:
        """Cancel the job; return whether the server confirmed the cancellation."""
        try:
            desk.cancel(job_id)
        except ConflictProblem:
            return False
        return True

    def complete(lease: Lease) -> bool:
        """Complete the job if it was not cancelled; return False, because this call cancels nothing."""
        with contextlib.suppress(ConflictProblem):
            worker.complete(lease)
        return False

    worker = replace(desk, database=open_database())
    with ThreadPoolExecutor(2) as pool:
        for _ in range(0, CANCELS, CANCELS_AT_ONCE):
            desk.submit_many(*[JobCreate(kind="errand")] * CANCELS_AT_ONCE)
            for number, lease in enumerate(desk.claim_many()):
                calls = [partial(cancel, lease.job), partial(complete, lease)]
                ends = list(pool.map(lambda call: call(), reversed(calls) if number % 2 else calls))
                state = desk.state(lease.job)
                assert (state == "cancelled") == any(ends), lease.job
                outcomes[state] += 1
    print(f"{CANCELS} jobs: {dict(outcomes)}")


def _seeded(what: str) -> random.Random:
    """Return a random generator with a new seed, which is printed if the test fails."""
    seed = secrets.randbelow(2**32)
    print(f"{what} with the seed {seed}")
    return random.Random(seed)
