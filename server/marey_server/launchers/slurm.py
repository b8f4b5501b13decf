"""Launcher `slurm`: each start is one array job of Slurm, and each of its tasks is a worker.

The token is read from a private file in the data folder, so the nodes must share this folder with the server. No
command contains shell text. Slurm may run a task again, for example after its node failed; a worker claims its jobs
only after its start, so that a repetition does no harm.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from marey_schemas.processes.environment import clean_environment
from marey_schemas.queue.worker_protocol import INTERRUPTED_STATUS
from marey_schemas.sizes import MIB, batched
from marey_server.launchers.launcher import (
    EndReason,
    EngineError,
    LaunchContext,
    LaunchedWorker,
    WorkerEnd,
    WorkerRequest,
    WorkerState,
    read_options,
    worker_arguments,
)
from marey_server.process.data_folder import WORKER_LOGS

log = logging.getLogger(__name__)

SCRIPT = Path(__file__).with_name("slurm_worker.sh")
CONFIGURATION = "SLURM_CONF"
"""Variable with the path of Slurm's configuration, which is passed on to Slurm's commands."""
COMMAND_S = 25.0
"""Greatest number of seconds that a command of Slurm may take."""
BEFORE_DEADLINE_S = 60
"""Seconds before the deadline at which a worker is asked to return its jobs."""
STOP_S = 60.0
"""Seconds after which a worker that was asked to stop is cancelled."""
MOST_LOGS = 500
"""Greatest number of log files that are kept for a pool; the oldest are deleted."""
MOST_IDS = 200
"""Greatest number of tasks in one command."""
FIELDS = ("ArrayJobID", "ArrayTaskID", "Name", "State", "exit_code", "Reason", "StartTime", "Comment")

STARTING = frozenset({"PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "SPECIAL_EXIT"})
RUNNING = frozenset({"RUNNING", "COMPLETING", "SIGNALING", "STAGE_OUT", "STOPPED", "SUSPENDED", "RESIZING"})
STOPPED_STATUS = (INTERRUPTED_STATUS, -signal.SIGTERM)
"""Exit statuses of a worker that was stopped while it ran a job, or before it could handle the signal."""
END_REASONS: Mapping[str, EndReason] = {
    "COMPLETED": "finished",
    "CANCELLED": "stopped",
    "REVOKED": "stopped",
    "OUT_OF_MEMORY": "out-of-memory",
    "TIMEOUT": "deadline",
    "DEADLINE": "deadline",
    "PREEMPTED": "preempted",
    "FAILED": "failed",
    "NODE_FAIL": "failed",
    "BOOT_FAIL": "failed",
}
"""Reasons why workers ended, by the states of Slurm; other final states have the reason `unknown`."""


class SlurmOptions(BaseModel):
    """Options of the launcher `slurm`; none of them is required."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    partition: str | None = Field(None, description="Partition that runs the workers.")
    account: str | None = Field(None, description="Account that is charged.")
    qos: str | None = Field(None, description="Quality of service.")
    constraint: str | None = Field(None, description="Features that nodes must have, such as `fast&ib`.")
    reservation: str | None = Field(None, description="Reservation in which the workers run.")
    gres: str | None = Field(
        None, description="Generic resources such as `gpu:a100:1`. Absent: `gpu:N` if the pool sets `gpus` to N."
    )
    python: str | None = Field(
        None, description="Python interpreter on the nodes, with Marey installed. Absent: that of the server."
    )
    cache: Path | None = Field(
        None, description="Folder on the nodes for downloaded inputs. Absent: marey/inputs below ~/.cache."
    )
    arguments: tuple[str, ...] = Field(
        (), max_length=50, description="Further options of `sbatch`, such as `--nice=100`."
    )


class _Task(NamedTuple):
    """Task of an array job, as `squeue` shows it."""

    id: str
    name: str
    state: str
    exit_code: str
    reason: str
    started_at: datetime | None

    @property
    def worker_state(self) -> WorkerState:
        """The state of the worker."""
        if self.state in STARTING:
            return "starting"
        return "running" if self.state in RUNNING else "ended"


class SlurmLauncher:
    """Launcher that runs workers as tasks of Slurm array jobs."""

    outlives_server = True

    def __init__(self, context: LaunchContext) -> None:
        self._options = read_options(SlurmOptions, context.options, "slurm")
        self._context = context
        self._comment = f"marey {context.url}"
        self._logs = context.data / WORKER_LOGS
        self._stopping_since: dict[str, float] = {}
        """Times at which running workers were asked to stop, by name."""

    async def start(self, request: WorkerRequest, count: int, *, key: str) -> tuple[str, ...]:
        """Submit an array job, in which each task is a worker.

        The job is named after the pool and `key`. If Slurm has a job with this name already, nothing is submitted.
        """
        job_name = f"{self._context.pool}-{key}"
        names = tuple(f"{job_name}-{number}" for number in range(1, count + 1))
        if not await self._tasks(f"--name={job_name}"):
            try:
                self._prepare_logs()
            except OSError as error:
                raise EngineError(f"the logs of workers cannot be kept in the data folder: {error}") from error
            await self._run("sbatch", *self._submission(request, count, job_name), str(SCRIPT), *self._command(request))
        return names

    async def list(self) -> tuple[LaunchedWorker, ...]:
        """Return the tasks of the array jobs of this pool, which Slurm remembers for some minutes after their end."""
        return tuple(
            LaunchedWorker(task.name, task.worker_state, self._context.labels, task.started_at)
            for task in await self._tasks()
        )

    async def stop(self, names: tuple[str, ...]) -> None:
        """Send SIGTERM to the workers; cancel waiting tasks, and workers that got SIGTERM over `STOP_S` seconds ago."""
        tasks = {task.name: task for task in await self._tasks() if task.name in names}
        alive = {name: task for name, task in tasks.items() if task.worker_state != "ended"}
        now_s = time.monotonic()
        since = self._stopping_since = {
            name: self._stopping_since.get(name, now_s) for name, task in alive.items() if task.state in RUNNING
        }
        asked = [task.id for name, task in alive.items() if since.get(name) == now_s]
        cancelled = [task.id for name, task in alive.items() if name not in since or now_s - since[name] > STOP_S]
        for ids in batched(asked, MOST_IDS):
            await self._run("scancel", "--quiet", "--batch", "--signal=TERM", *ids)
        for ids in batched(cancelled, MOST_IDS):
            await self._run("scancel", "--quiet", *ids)

    async def why_ended(self, name: str) -> WorkerEnd | None:
        """Return why a worker ended, from `squeue`, or from `sacct` if the controller has forgotten the task.

        The result is None if the worker has not ended, and has the reason `unknown` if `sacct` does not know the task.
        """
        job_name = name.rpartition("-")[0]
        task = next((task for task in await self._tasks(f"--name={job_name}") if task.name == name), None)
        if task is None:
            task = await self._accounted(name, job_name)
        if task is None:
            return WorkerEnd("unknown", None, "Slurm has forgotten the task, and sacct has no record of it")
        return None if task.worker_state != "ended" else _end_of(task)

    async def close(self) -> None:
        """Do nothing: the workers continue, and the next server finds them."""

    # -- commands --

    def _submission(self, request: WorkerRequest, count: int, job_name: str) -> Iterator[str]:
        options = self._options
        yield from ("--parsable", f"--array=1-{count}", f"--job-name={job_name}", f"--comment={self._comment}")
        yield from ("--requeue", "--nodes=1", "--ntasks=1", "--export=ALL", "--input=/dev/null")
        folder = str(self._logs).replace("%", "%%")
        yield from ("--open-mode=append", f"--output={folder}/%x-%a.log", f"--chdir={self._logs}")
        if request.cpus is not None:
            yield f"--cpus-per-task={request.cpus}"
        if request.memory_bytes is not None:
            yield f"--mem={-(-request.memory_bytes // MIB)}M"
        if request.deadline_s is not None:
            yield f"--time={-(-request.deadline_s // 60)}"
            yield f"--signal=B:TERM@{BEFORE_DEADLINE_S}"
        if gres := options.gres or (f"gpu:{request.gpus}" if request.gpus else None):
            yield f"--gres={gres}"
        for option in ("partition", "account", "qos", "constraint", "reservation"):
            if (value := getattr(options, option)) is not None:
                yield f"--{option}={value}"
        yield from options.arguments

    def _command(self, request: WorkerRequest) -> Iterator[str]:
        yield from (self._options.python or sys.executable, *worker_arguments(request, self._context.url))
        yield from ("--token-file", str(self._context.token_file))
        if self._options.cache is not None:
            yield from ("--cache", str(self._options.cache))

    @property
    def _job_names(self) -> str:
        """Regular expression that matches only the names of this pool's jobs."""
        return rf"{re.escape(self._context.pool)}-[a-z0-9]+"

    def _prepare_logs(self) -> None:
        self._logs.mkdir(exist_ok=True, mode=0o700)
        ours = re.compile(rf"{self._job_names}-[0-9]+\.log")
        times = {}
        for file in self._logs.iterdir():
            with suppress(FileNotFoundError):  # another server may delete old logs at the same time
                if ours.fullmatch(file.name):
                    times[file] = file.stat().st_mtime
        for file in sorted(times, key=times.__getitem__)[:-MOST_LOGS]:
            file.unlink(missing_ok=True)

    async def _tasks(self, *filters: str) -> tuple[_Task, ...]:
        fields = ",".join(f"{field}:|" for field in FIELDS)
        shown = await self._run(
            "squeue", "--me", "--states=all", "--array", "--noheader", f"--Format={fields}", *filters
        )
        ours = re.compile(self._job_names)
        rows = (line.split("|") for line in shown.splitlines())
        rows = (row for row in rows if len(row) > len(FIELDS) and row[7] == self._comment)
        return tuple(_task_of(row) for row in rows if ours.fullmatch(row[2]) and row[1].isdecimal())

    async def _accounted(self, name: str, job_name: str) -> _Task | None:
        """Return a task from the accounting records; None if there is none, or if Slurm keeps no records."""
        fields = "JobID,State,ExitCode"
        try:
            shown = await self._run(
                "sacct", "--allocations", "--noheader", "--parsable2", "--starttime=now-30days", f"--name={job_name}",
                f"--format={fields}",
            )  # fmt: skip
        except EngineError as error:
            log.info("the end of %s cannot be looked up: %s", name, error)
            return None
        for line in shown.splitlines():
            task_id, state, exit_code = line.split("|")
            if task_id.partition("_")[2] == name.rpartition("-")[2]:
                return _Task(task_id, name, state.partition(" ")[0], exit_code, "", None)
        return None

    async def _run(self, program: str, *arguments: str) -> str:
        """Run a command of Slurm and return its output. Raises `EngineError` if it fails or takes too long."""
        environment = clean_environment() | {
            "MAREY_LOG_FORM": self._context.log_form, "MAREY_LOG_LEVEL": self._context.log_level
        }  # fmt: skip
        if CONFIGURATION in os.environ:
            environment[CONFIGURATION] = os.environ[CONFIGURATION]
        try:
            process = await asyncio.create_subprocess_exec(
                program, *arguments, env=environment, stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip
        except OSError as error:
            raise EngineError(f"{program} cannot be run: {error.strerror}") from error
        try:
            async with asyncio.timeout(COMMAND_S):
                output, complaint = await process.communicate()
        except TimeoutError:
            raise EngineError(f"{program} did not answer within {COMMAND_S:.0f} s") from None
        finally:
            if process.returncode is None:
                with suppress(ProcessLookupError):
                    process.kill()
                await process.wait()
        if process.returncode != 0:
            raise EngineError(f"{program} failed: {_last_line(complaint)}")
        return output.decode(errors="replace")


def _task_of(row: list[str]) -> _Task:
    array_id, number, job_name, state, exit_code, reason, started_at, _ = row[:8]
    return _Task(f"{array_id}_{number}", f"{job_name}-{number}", state, exit_code, reason, _time_of(started_at))


def _time_of(text: str) -> datetime | None:
    """Convert a time that Slurm prints, in the time zone of this machine; return None for `N/A`."""
    with suppress(ValueError):
        return datetime.fromisoformat(text).astimezone(UTC)
    return None


def _end_of(task: _Task) -> WorkerEnd:
    reason = END_REASONS.get(task.state, "unknown")
    number = _status_of(task.exit_code)
    if task.state == "FAILED" and number in STOPPED_STATUS:
        reason = "stopped"
    elif task.state == "FAILED" and number is not None and number < 0:
        reason = "killed"
    detail = task.state if task.reason in ("", "None") else f"{task.state}, {task.reason}"
    return WorkerEnd(reason, number, detail)


def _status_of(exit_code: str) -> int | None:
    """Return the exit status of a task, or the negative number of the signal that ended it; None if it is unknown.

    `squeue` shows the status as `wait` returns it, `sacct` shows exit status and signal, as in `0:15`.
    """
    status, _, number = exit_code.partition(":")
    if not status.isdecimal() or not (number or "0").isdecimal():
        return None
    if not number:
        return os.waitstatus_to_exitcode(int(status))
    return -int(number) if int(number) else int(status)


def _last_line(complaint: bytes) -> str:
    lines = complaint.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "no message"
