"""Rules for launchers, and those for Slurm, checked with a real controller and node daemon."""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from tests.support.attached_worker import python_path
from tests.support.launcher_contract import REQUEST, Engine, LauncherContract, processes_of
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.present import present
from tests.support.server_process import ServerProcess
from tests.support.slurm_cluster import CPUS, SlurmCluster, running_cluster

from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobCreate
from marey_server.launchers import slurm
from marey_server.launchers.launcher import EngineError, LaunchContext, Launcher, LauncherUnusable
from marey_server.launchers.slurm import SlurmLauncher


def context_of(folder: Path, **options: object) -> LaunchContext:
    return LaunchContext("crew", "http://127.0.0.1:1", "secret", folder, "text", "info", options)


@pytest.mark.slurm
class TestSlurmLauncher(LauncherContract):
    @pytest.fixture(scope="class")
    @classmethod
    def cluster(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmCluster]:
        folder = tmp_path_factory.mktemp("slurm")
        records = folder / "ended"
        with running_cluster(folder, JobCompType="jobcomp/filetxt", JobCompLoc=str(records)) as cluster:
            yield cluster

    @pytest.fixture
    def make_launcher(
        self, cluster: SlurmCluster, monkeypatch: pytest.MonkeyPatch
    ) -> Callable[[LaunchContext], Launcher]:
        monkeypatch.setenv(slurm.CONFIGURATION, str(cluster.configuration))
        return SlurmLauncher

    def test_resources_and_options_reach_slurm(self, engine: Engine, cluster: SlurmCluster) -> None:
        wanted = {"partition": "night", "constraint": "fast", "arguments": ["--nice=7"]}
        launcher = SlurmLauncher(replace(engine.context, options=wanted))
        request = replace(REQUEST, cpus=2, deadline_s=3601)
        (name,) = engine.do(launcher.start(request, 1, key="k11"))
        shown = cluster.ask("scontrol", "show", "job", "--oneliner")
        (line,) = (line for line in shown.splitlines() if f" JobName={engine.context.pool}-k11 " in line)
        for part in ("Partition=night", "TimeLimit=01:01:00", "NumCPUs=2", "MinMemoryNode=512M", "Requeue=1", "Nice=7"):
            assert part in line
        assert "Features=fast" in line
        engine.do(launcher.stop((name,)))
        engine.until_ended(name)

    @pytest.mark.soak
    def test_a_worker_that_waits_for_a_node_is_starting_and_never_runs_after_a_stop(self, engine: Engine) -> None:
        names = engine.start(CPUS + 1, key="k12")
        engine.until(lambda: sorted(engine.states()[name] for name in names) == ["running"] * CPUS + ["starting"])
        (waiting,) = (name for name in names if engine.states()[name] == "starting")
        engine.do(engine.launcher.stop((waiting,)))
        engine.until_ended(waiting)
        end = engine.end_of(waiting)
        assert (end.reason, processes_of(waiting)) == ("stopped", [])

    def test_a_worker_that_ignores_sigterm_is_cancelled(self, engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(slurm, "STOP_S", 0.0)
        (name,) = engine.start(1, key="k13")
        engine.until_running()
        (worker,) = processes_of(name)
        worker.suspend()
        engine.do(engine.launcher.stop((name,)))
        engine.do(asyncio.sleep(0.1))
        engine.do(engine.launcher.stop((name,)))
        engine.until_ended(name)
        assert engine.end_of(name).reason == "stopped"

    @pytest.mark.soak
    def test_a_task_that_slurm_runs_again_works_under_the_same_name(
        self, engine: Engine, cluster: SlurmCluster, tmp_path: Path
    ) -> None:
        (name,) = engine.start(1, key="k14")
        job = engine.submit("wait", tmp_path / "job")
        engine.until((tmp_path / "job" / "started").exists)
        (first,) = processes_of(name)
        task = cluster.ask("squeue", "--noheader", f"--name={engine.context.pool}-k14", "--format=%i").strip()
        cluster.ask("scontrol", "requeue", task)
        engine.until(lambda: not first.is_running())
        (tmp_path / "job" / "go").touch()
        assert present(engine.marey.jobs.wait(job.id).result)["waited"]
        outcomes = [(attempt.worker, attempt.outcome) for attempt in engine.marey.jobs.attempts(job.id)]
        assert outcomes == [(name, "interrupted"), (name, "succeeded")]

    def test_a_controller_that_is_away_is_an_error_and_its_workers_go_on(
        self, engine: Engine, cluster: SlurmCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (name,) = engine.start(1, key="k15")
        engine.until_running()
        cluster.controller.terminate()
        cluster.controller.wait(30)
        monkeypatch.setattr(slurm, "COMMAND_S", 1.0)
        for call in (engine.launcher.list(), engine.launcher.start(REQUEST, 1, key="k16")):
            with pytest.raises(EngineError, match="squeue"):
                engine.do(call)
        job = engine.submit("wait", tmp_path / "job")
        (tmp_path / "job" / "go").touch()
        assert present(engine.marey.jobs.wait(job.id).result)["waited"]
        monkeypatch.undo()
        os.environ[slurm.CONFIGURATION] = str(cluster.configuration)
        cluster.start_controller()
        assert engine.states()[name] == "running"

    @pytest.mark.soak
    def test_the_workers_of_a_pool_outlive_their_server_and_work_for_the_next(
        self, cluster: SlurmCluster, tmp_path: Path
    ) -> None:
        pool = {
            "name": "night",
            "least": 1,
            "most": 2,
            "kinds": ["add"],
            "memory_mb": 512,
            "options": {"qos": "normal"},
        }
        environment = {"MAREY_POOLS": json.dumps([pool]), "MAREY_LAUNCHER": "slurm", "PYTHONPATH": python_path()}
        server = ServerProcess(tmp_path, SLURM_CONF=str(cluster.configuration), **environment).start()

        def work() -> str:
            with server.client() as marey:
                job = marey.jobs.submit("lab", JobCreate(kind="add", params={"a": 1, "b": 2}, cache="off"))
                assert present(marey.jobs.wait(job.id).result)["sum"] == 3
                (attempt,) = marey.jobs.attempts(job.id)
                return attempt.worker

        try:
            with server.client() as marey:
                marey.create_project(ProjectCreate(name="lab"))
            name = work()
            (worker,) = processes_of(name)
            server.kill()
            assert worker.is_running()
            server.start()
            assert work() == name
            assert processes_of(name) == [worker]
            assert server.stop() == 0
            assert worker.is_running()
            assert server.log.read_text().count("pool night: started 1 workers") == 1
        finally:
            server.kill()
            cluster.ask("scancel", "--me")


@pytest.mark.slurm
def test_a_stopped_cluster_leaves_no_process_though_its_controller_was_killed(tmp_path: Path) -> None:
    (script := tmp_path / "script").write_text("#!/bin/sh\nexec sleep 300\n")
    with running_cluster(tmp_path) as cluster:
        cluster.ask("sbatch", "--output=/dev/null", str(script))
        wait_until(lambda: any(step.children() for step in cluster.steps()))
        left = [process for step in cluster.steps() for process in (step, *step.children())]
        cluster.controller.kill()
        cluster.controller.wait()
    assert len(left) == 2
    _, alive = psutil.wait_procs(left, timeout=PATIENCE_S)
    assert not alive


def test_an_option_that_slurm_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        LauncherUnusable,
        match="options of the launcher slurm: partitoin: there is no field of this name; did you mean 'partition'",
    ):
        SlurmLauncher(context_of(tmp_path, partitoin="gpu"))


def test_a_command_that_is_missing_or_does_not_answer_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    launcher = SlurmLauncher(context_of(tmp_path))
    with pytest.raises(EngineError, match="squeue cannot be run: No such file"):
        asyncio.run(launcher.list())
    silent = tmp_path / "squeue"
    silent.write_text("#!/bin/sh\nexec /bin/sleep 60\n")
    silent.chmod(0o700)
    monkeypatch.setattr(slurm, "COMMAND_S", 0.3)
    begun = time.monotonic()
    with pytest.raises(EngineError, match="squeue did not answer within"):
        asyncio.run(launcher.list())
    assert time.monotonic() - begun < 30


def commands(folder: Path, monkeypatch: pytest.MonkeyPatch, **scripts: str) -> None:
    """Put shell scripts in the place of commands of Slurm."""
    programs = folder / "bin"
    programs.mkdir()
    for name, script in scripts.items():
        (programs / name).write_text(f"#!/bin/sh\n{script}\n")
        (programs / name).chmod(0o700)
    monkeypatch.setenv("PATH", f"{programs}:/bin")


@pytest.mark.parametrize(
    ("record", "reason", "status"),
    [
        ("OUT_OF_MEMORY|0:125", "out-of-memory", -125),
        ("TIMEOUT|0:0", "deadline", 0),
        ("PREEMPTED|0:0", "preempted", 0),
        ("CANCELLED by 1000|0:15", "stopped", -15),
        ("FAILED|143:0", "stopped", 143),
        ("FAILED|0:9", "killed", -9),
        ("FAILED|2:0", "failed", 2),
        ("NODE_FAIL|1:0", "failed", 1),
        ("COMPLETED|0:0", "finished", 0),
        ("SOMETHING_NEW|?", "unknown", None),
    ],
)
def test_when_the_controller_has_forgotten_a_task_the_records_explain_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: str, reason: str, status: int | None
) -> None:
    """A script simulates the accounting records, because real accounting needs a further database server."""
    lines = f"echo '7_1|COMPLETED|0:0'; echo '7_2|{record}'"
    commands(tmp_path, monkeypatch, squeue="exit 0", sacct=lines)
    end = asyncio.run(SlurmLauncher(context_of(tmp_path)).why_ended("crew-k1-2"))
    assert (present(end).reason, present(end).status) == (reason, status)


def test_without_accounting_the_end_of_a_forgotten_task_is_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands(tmp_path, monkeypatch, squeue="exit 0", sacct="echo accounting is disabled >&2; exit 1")
    end = asyncio.run(SlurmLauncher(context_of(tmp_path)).why_ended("crew-k1-2"))
    assert (present(end).reason, present(end).status) == ("unknown", None)


def test_logs_that_cannot_be_kept_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands(tmp_path, monkeypatch, squeue="exit 0", sbatch="exit 0")
    (tmp_path / "worker-logs").touch()
    with pytest.raises(EngineError, match="the logs of workers cannot be kept in the data folder"):
        asyncio.run(SlurmLauncher(context_of(tmp_path)).start(REQUEST, 1, key="b"))


def test_old_logs_of_the_pool_are_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slurm, "MOST_LOGS", 2)
    commands(tmp_path, monkeypatch, squeue="exit 0", sbatch="exit 0")
    logs = tmp_path / "worker-logs"
    logs.mkdir()
    for age, name in enumerate(("crew-a-3.log", "crew-a-2.log", "crew-a-1.log", "other-a-1.log")):
        (logs / name).touch()
        os.utime(logs / name, (1000 - age, 1000 - age))
    asyncio.run(SlurmLauncher(context_of(tmp_path)).start(REQUEST, 1, key="b"))
    assert {file.name for file in logs.iterdir()} == {"crew-a-3.log", "crew-a-2.log", "other-a-1.log"}
