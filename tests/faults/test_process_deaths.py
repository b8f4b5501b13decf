"""Processes that are killed at every fault point: nothing is lost or stored twice, and the store is consistent."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest
import sqlalchemy
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.server_process import QUICK_LEASES, ServerProcess, WorkerProcess
from tests.support.short_walks import write_short_walks
from tests.support.tcp_proxy import TcpProxy
from tests.support.tiers import is_soak

from marey_client import Marey
from marey_client.errors import MareyError
from marey_client.imports import LocalFile, find_files
from marey_client.project import ProjectHandle
from marey_motion.clip import Clip
from marey_motion.formats import write_motion
from marey_motion.gait import game_skeleton
from marey_schemas.access import ProjectCreate
from marey_schemas.encoding.digests import digest_of
from marey_schemas.imports import ImportEntry
from marey_schemas.queue.jobs import Job, JobCreate, JobState

pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="session")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[LocalFile]:
    """Different short walks as BVH files: 24, or 200 in the tier `soak`."""
    return write_short_walks(tmp_path_factory.mktemp("takes"), 200 if is_soak() else 24)


@pytest.fixture
def server(tmp_path: Path, database_url: str) -> Iterator[ServerProcess]:
    process = ServerProcess(tmp_path, database_url, **QUICK_LEASES)
    yield process
    process.stop()


@pytest.fixture
def start_worker(tmp_path: Path, server: ServerProcess) -> Iterator[Callable[..., WorkerProcess]]:
    workers: list[WorkerProcess] = []

    def start(name: str, *, fault: str | None = None, port: int | None = None) -> WorkerProcess:
        url = f"http://127.0.0.1:{port}" if port else server.url
        worker = WorkerProcess(tmp_path / f"{name}.log")
        workers.append(worker)
        return worker.start(url, server.token, tmp_path, name=name, fault=fault, kinds=["retarget"])

    yield start
    for worker in workers:
        worker.stop()


def make_lab(marey: Marey) -> ProjectHandle:
    return marey.create_project(ProjectCreate(name="lab"))


def import_game_skeleton(lab: ProjectHandle, folder: Path) -> str:
    """Import a clip on another skeleton; return the id of this skeleton."""
    skeleton = game_skeleton()
    at_rest = np.concatenate([skeleton.offsets[0], skeleton.rest_rotations.ravel()]).astype(np.float32)
    file = folder / "game.bvh"
    file.write_bytes(write_motion(Clip(skeleton, 30.0, np.tile(at_rest, (5, 1)), None, ()), "bvh"))
    [entry] = lab.imports.upload(list(find_files([file]).files))
    assert entry.skeleton is not None, entry
    return entry.skeleton


def children_of(server: ServerProcess) -> list[str]:
    """Return the names of the Python modules that run as child processes of a server."""
    assert server.process is not None
    return [child.cmdline()[2] for child in psutil.Process(server.process.pid).children()]


def test_a_server_that_does_not_warm_up_starts_children_when_a_request_needs_them(tmp_path: Path) -> None:
    server = ServerProcess(tmp_path)
    server.own_children = True
    server.start()
    try:
        assert children_of(server) == []
        with server.client() as marey:
            import_game_skeleton(make_lab(marey), tmp_path)
        assert children_of(server) == ["marey_server.motions.child"]
    finally:
        server.stop()


def clips_by_name(lab: ProjectHandle) -> dict[str, tuple[str, int]]:
    """Return id and newest revision of every clip by path; fail if two clips have the same path."""
    found: dict[str, tuple[str, int]] = {}
    for clip in lab.clips.list():
        assert clip.path not in found, f"{clip.path} is there twice"
        found[clip.path] = (clip.id, clip.item.revision)
    return found


def submit_retargets(lab: ProjectHandle, entries: list[ImportEntry], skeleton: str, *, into: str) -> list[Job]:
    return [
        lab.submit(
            JobCreate.model_validate(
                {
                    "kind": "retarget",
                    "inputs": {"clips": [{"item": entry.item}], "skeleton": {"item": skeleton}},
                    "into": into,
                }
            )
        )
        for entry in entries
    ]


def assert_published_once(lab: ProjectHandle, jobs: list[Job]) -> None:
    """Check that every job succeeded, and that its only clip exists at its first revision."""
    assert {job.state for job in jobs} == {JobState.SUCCEEDED}, [job.failure for job in jobs]
    results = [revision for path, (_, revision) in clips_by_name(lab).items() if path.startswith("game/")]
    assert results == [1] * len(jobs)


def assert_made_from_their_clips(marey: Marey, jobs: list[Job]) -> None:
    """Check that every job has one result, which was made from the input clip of this job."""
    for job in jobs:
        [output] = marey.jobs.outputs(job.id)
        [clip] = job.inputs["clips"]
        assert clip["item"] in {edge.item for edge in marey.project("lab").clips.get(output.item).lineage().inputs}


def ended(marey: Marey, jobs: list[Job], seconds: float = PATIENCE_S) -> list[Job]:
    deadline = time.monotonic() + seconds
    found = []
    for each in jobs:
        job = marey.jobs.get(each.id)
        while not job.state.terminal:
            assert time.monotonic() < deadline, f"{job.id} is still {job.state}"
            time.sleep(0.1)
            job = marey.jobs.get(each.id)
        found.append(job)
    return found


# -- the server dies ---------------------------------------------------------------------------------------------------


def test_a_server_killed_among_many_uploads_keeps_what_it_acknowledged(
    server: ServerProcess, takes: list[LocalFile]
) -> None:
    acknowledged: dict[str, str] = {}
    killed = threading.Event()

    def upload_until_the_server_dies() -> None:
        with server.client(patient=False) as marey:
            for take in takes:
                if take is takes[-1]:
                    killed.wait(PATIENCE_S)
                try:
                    [entry] = marey.project("lab").imports.upload([take])
                except MareyError:
                    return
                acknowledged[take.name] = entry.item or ""

    server.start()
    with server.client() as marey:
        make_lab(marey)
    uploading = threading.Thread(target=upload_until_the_server_dies)
    uploading.start()
    few = len(takes) // 3
    wait_until(lambda: len(acknowledged) >= few)
    server.kill()
    killed.set()
    uploading.join(PATIENCE_S)
    assert few <= len(acknowledged) < len(takes)

    server.start()
    with server.client() as marey:
        lab = marey.project("lab")
        before = clips_by_name(lab)
        assert set(acknowledged.values()) <= {item for item, _ in before.values()}
        entries = lab.imports.upload(takes)
        assert {
            entry.name: entry.item for entry in entries if entry.status == "unchanged"
        }.items() >= acknowledged.items()
        after = clips_by_name(lab)
        assert len(after) == len(takes)
        assert {revision for _, revision in after.values()} == {1}
    server.check_database()


@pytest.mark.parametrize("place", ["publish.before_commit", "publish.after_commit", "blob.put.before_commit"])
def test_a_server_killed_at_a_write_leaves_it_whole_or_not_at_all(
    server: ServerProcess, takes: list[LocalFile], place: str
) -> None:
    server.start(fault=f"{place}@3:kill")
    with server.client(patient=False) as marey:
        make_lab(marey)
        with pytest.raises(MareyError):
            _upload_one_by_one(marey, takes[:5])
    assert server.wait_until_dead() == -signal.SIGKILL

    server.start()
    with server.client() as marey:
        lab = marey.project("lab")
        entries = lab.imports.upload(takes[:5])
        assert {entry.status for entry in entries} <= {"created", "unchanged"}
        assert sorted(revision for _, revision in clips_by_name(lab).values()) == [1] * 5
    server.check_database()


@pytest.mark.parametrize("place", ["complete.before_commit@3", "complete.after_commit@6"])
def test_a_server_killed_among_many_completes_publishes_each_result_once(
    server: ServerProcess,
    takes: list[LocalFile],
    tmp_path: Path,
    start_worker: Callable[..., WorkerProcess],
    place: str,
) -> None:
    server.start(fault=f"{place}:kill")
    with server.client() as marey:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[: len(takes) // 3])
        skeleton = import_game_skeleton(lab, tmp_path)
        jobs = submit_retargets(lab, entries, skeleton, into="game")
    start_worker("steady")
    assert server.wait_until_dead() == -signal.SIGKILL

    server.start()
    with server.client() as marey:
        finished = ended(marey, jobs)
        assert {job.state for job in finished} == {JobState.SUCCEEDED}, [job.failure for job in finished]
        results = {
            path: place for path, place in clips_by_name(marey.project("lab")).items() if path.startswith("game/")
        }
        assert len(results) == len(jobs)
        assert {revision for _, revision in results.values()} == {1}
        for job in finished:
            outputs = list(marey.jobs.outputs(job.id))
            assert len(outputs) == 1
            made = marey.project("lab").clips.get(outputs[0].item)
            assert {edge.item for edge in made.lineage().inputs} >= {skeleton}
    server.check_database()


# -- the worker dies, sleeps, or is cut off ----------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["after_claim", "after_blob", "before_complete", "after_complete"])
def test_a_job_of_a_killed_worker_is_finished_by_another_with_one_result(
    server: ServerProcess,
    takes: list[LocalFile],
    tmp_path: Path,
    start_worker: Callable[..., WorkerProcess],
    place: str,
) -> None:
    server.start()
    with server.client() as marey:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:1])
        skeleton = import_game_skeleton(lab, tmp_path)
        dying = start_worker("dying", fault=f"worker.{place}:kill")
        [job] = submit_retargets(lab, entries, skeleton, into="game")
        assert dying.wait_until_dead() == -signal.SIGKILL
        start_worker("healthy")
        [job] = ended(marey, [job])
        assert job.state is JobState.SUCCEEDED, job.failure
        outcomes = [attempt.outcome for attempt in marey.jobs.attempts(job.id)]
        assert sorted(filter(None, outcomes)) == (["succeeded"] if place == "after_complete" else ["lost", "succeeded"])
        assert [revision for path, (_, revision) in clips_by_name(lab).items() if path.startswith("game/")] == [1]
    server.check_database()


@pytest.mark.soak
@pytest.mark.parametrize("place", ["after_claim@2", "before_complete@2"])
def test_jobs_of_a_worker_killed_while_it_stores_one_and_runs_another_are_published_once(
    server: ServerProcess,
    takes: list[LocalFile],
    tmp_path: Path,
    start_worker: Callable[..., WorkerProcess],
    place: str,
) -> None:
    server.start()
    with server.client() as marey:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:4])
        skeleton = import_game_skeleton(lab, tmp_path)
        jobs = submit_retargets(lab, entries, skeleton, into="game")
        dying = start_worker("dying", fault=f"worker.{place}:kill")
        assert dying.wait_until_dead() == -signal.SIGKILL
        start_worker("healthy")
        finished = ended(marey, jobs)
        assert_published_once(lab, finished)
        assert_made_from_their_clips(marey, finished)
    server.check_database()


@pytest.mark.soak
def test_a_server_killed_while_a_worker_stores_one_job_and_runs_another_publishes_each_once(
    server: ServerProcess, takes: list[LocalFile], tmp_path: Path, start_worker: Callable[..., WorkerProcess]
) -> None:
    server.start(fault="stage.before_commit@2:kill")
    with server.client() as marey:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:4])
        jobs = submit_retargets(lab, entries, import_game_skeleton(lab, tmp_path), into="game")
    start_worker("steady")
    assert server.wait_until_dead() == -signal.SIGKILL
    server.start()
    with server.client() as marey:
        finished = ended(marey, jobs)
        assert_published_once(marey.project("lab"), finished)
        assert_made_from_their_clips(marey, finished)
    server.check_database()


@pytest.mark.soak
def test_a_worker_that_slept_with_one_job_stored_and_another_running_publishes_neither_again(
    server: ServerProcess, takes: list[LocalFile], tmp_path: Path, start_worker: Callable[..., WorkerProcess]
) -> None:
    server.start()
    with server.client() as marey:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:4])
        skeleton = import_game_skeleton(lab, tmp_path)
        jobs = submit_retargets(lab, entries, skeleton, into="game")
        sleeper = start_worker("sleeper", fault="worker.after_blob@2:stop")
        wait_until(lambda: sleeper.process is not None and _is_stopped(sleeper.process.pid))
        start_worker("awake")
        finished = ended(marey, jobs)
        assert_published_once(lab, finished)
        before = clips_by_name(lab)
        sleeper.send(signal.SIGCONT)
        wait_until(lambda: any(text in sleeper.log.read_text() for text in ("attempt abandoned", "the lease was lost")))
        assert clips_by_name(lab) == before
        assert_made_from_their_clips(marey, finished)
    server.check_database()


def test_a_worker_that_slept_through_its_lease_is_refused_and_the_second_result_stays(
    server: ServerProcess, takes: list[LocalFile], tmp_path: Path, start_worker: Callable[..., WorkerProcess]
) -> None:
    server.start()
    with server.client() as marey:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:1])
        skeleton = import_game_skeleton(lab, tmp_path)
        sleeper = start_worker("sleeper", fault="worker.before_complete:stop")
        [job] = submit_retargets(lab, entries, skeleton, into="game")
        wait_until(lambda: sleeper.process is not None and _is_stopped(sleeper.process.pid))
        start_worker("awake")
        [job] = ended(marey, [job])
        assert job.state is JobState.SUCCEEDED
        assert job.fence >= 2
        before = clips_by_name(lab)
        sleeper.send(signal.SIGCONT)
        wait_until(lambda: "attempt abandoned" in sleeper.log.read_text())
        assert clips_by_name(lab) == before
        assert marey.jobs.get(job.id).fence == job.fence
    server.check_database()


def test_a_lost_answer_to_complete_is_asked_for_again(
    server: ServerProcess, takes: list[LocalFile], tmp_path: Path, start_worker: Callable[..., WorkerProcess]
) -> None:
    server.start()
    with server.client() as marey, TcpProxy(server.port) as proxy:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:5])
        skeleton = import_game_skeleton(lab, tmp_path)
        proxy.lose_answers(b"/complete ", 3)
        start_worker("behind-proxy", port=proxy.port)
        finished = ended(marey, submit_retargets(lab, entries, skeleton, into="game"))
        assert proxy.lost == 3
        assert_published_once(lab, finished)
    server.check_database()


def test_a_lost_answer_to_a_claim_is_asked_for_again(
    server: ServerProcess, takes: list[LocalFile], tmp_path: Path, start_worker: Callable[..., WorkerProcess]
) -> None:
    server.start()
    with server.client() as marey, TcpProxy(server.port) as proxy:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:3])
        skeleton = import_game_skeleton(lab, tmp_path)
        jobs = submit_retargets(lab, entries, skeleton, into="game")
        proxy.lose_answers(b"/leases ", 2)
        start_worker("behind-proxy", port=proxy.port)
        finished = ended(marey, jobs)
        assert proxy.lost == 2
        assert_published_once(lab, finished)
    server.check_database()


@pytest.mark.soak
def test_a_worker_cut_off_from_the_server_loses_its_job_to_another(
    server: ServerProcess, takes: list[LocalFile], tmp_path: Path, start_worker: Callable[..., WorkerProcess]
) -> None:
    server.start()
    with server.client() as marey, TcpProxy(server.port) as proxy:
        lab = make_lab(marey)
        entries = lab.imports.upload(takes[:3])
        skeleton = import_game_skeleton(lab, tmp_path)
        start_worker("cut-off", port=proxy.port)
        jobs = submit_retargets(lab, entries, skeleton, into="game")
        wait_until(lambda: any(marey.jobs.get(job.id).state is not JobState.QUEUED for job in jobs), pause_s=0.1)
        proxy.drop_answers.set()
        start_worker("connected")
        finished = ended(marey, jobs)
        proxy.drop_answers.clear()
        assert_published_once(lab, finished)
    server.check_database()


# -- the store fails ---------------------------------------------------------------------------------------------------


def test_a_full_disk_is_a_507_and_leaves_nothing_behind(server: ServerProcess, takes: list[LocalFile]) -> None:
    server.start(fault="blob.put.before_commit:error")
    with server.client(patient=False) as marey:
        make_lab(marey)
        content = takes[0].path.read_bytes()
        answer = httpx.put(
            f"{server.url}/api/v1/blobs/{digest_of(content)}",
            content=content,
            headers={"Authorization": f"Bearer {server.token}"},
        )
        assert answer.status_code == 507
        assert answer.json()["code"] == "storage-full"
    server.stop()
    server.start()
    with server.client() as marey:
        [entry] = marey.project("lab").imports.upload(takes[:1])
        assert entry.status == "created"
    server.check_database()


@pytest.mark.every_database
def test_a_database_that_is_away_for_a_while_delays_work_and_loses_none(
    server: ServerProcess, database_url: str, takes: list[LocalFile]
) -> None:
    server.start()
    with server.client() as marey:
        lab = make_lab(marey)
        uploaded: list[ImportEntry] = []
        sent = takes[:40]
        uploading = threading.Thread(target=lambda: uploaded.extend(lab.imports.upload(sent)))
        uploading.start()
        _disturb(database_url, seconds=5)
        uploading.join(PATIENCE_S)
        # an import that was cut short and sent again finds what went in before
        assert len(uploaded) == len(sent)
        assert {entry.status for entry in uploaded} <= {"created", "unchanged"}
        assert sorted(revision for _, revision in clips_by_name(lab).values()) == [1] * len(sent)
    server.check_database()


def _disturb(database_url: str, seconds: float) -> None:
    """Hold SQLite's write lock, or close all connections to the Postgres database, again and again."""
    engine = sqlalchemy.create_engine(database_url, isolation_level="AUTOCOMMIT", poolclass=sqlalchemy.NullPool)
    deadline = time.monotonic() + seconds
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            connection.exec_driver_sql("BEGIN EXCLUSIVE")
            time.sleep(seconds)
            connection.exec_driver_sql("ROLLBACK")
            return
        while time.monotonic() < deadline:
            connection.exec_driver_sql(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
                " WHERE datname = current_database() AND pid <> pg_backend_pid()"
            )
            time.sleep(0.3)


def _upload_one_by_one(marey: Marey, takes: list[LocalFile]) -> None:
    for take in takes:
        marey.project("lab").imports.upload([take])


def _is_stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def test_a_rotation_whose_server_dies_before_the_answer_gets_the_same_token_later(server: ServerProcess) -> None:
    rotation_id = "r" * 32
    server.start(fault="rotate.after_commit:kill")
    with server.client(patient=False) as marey, pytest.raises(MareyError):
        marey.tokens.rotate(rotation_id)
    assert server.wait_until_dead() == -signal.SIGKILL
    server.start()
    with server.client() as marey:
        new, again = (marey.tokens.rotate(rotation_id) for _ in range(2))
        assert [one.id for one in marey.tokens.list() if one.successor_of] == [new.id]
    assert new == again
    with Marey(server.url, new.secret) as marey:
        assert marey.me().token == new.id
    server.check_database()
