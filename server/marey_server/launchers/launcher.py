"""Protocol between the server and the engines that run workers, such as Slurm.

The queue decides which jobs run; an engine decides where the workers run. An engine may start a worker late, twice, or
not at all. Every worker first claims a job, so each job is still run by one worker at a time.

The settings name a launcher: `local`, `slurm`, `kubernetes`, or an entry point of another package in the group
`marey.launchers`, which is a `MakeLauncher`. The server makes one launcher for each pool of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from pydantic import BaseModel, ValidationError

from marey_schemas.queue.log_lines import LogForm
from marey_schemas.validation.reasons import plain_reason
from marey_server.process.data_folder import worker_token_file

ENTRY_POINTS = "marey.launchers"
"""Group of entry points in which packages register their launchers."""

HEALTHY_AFTER_S = 30.0
"""Run time in seconds after which a worker counts as healthy; only earlier ends delay the next start."""

WorkerState = Literal["starting", "running", "ended"]

EndReason = Literal[
    "finished", "stopped", "failed", "killed", "out-of-memory", "deadline", "preempted", "unknown"
]  # fmt: skip
"""Reason why a worker ended.

- finished: the worker ended by itself with status 0
- stopped: the launcher has stopped it
- failed: it ended by itself with another status, or its machine failed
- killed: a signal ended it that the launcher had not requested
- out-of-memory, deadline, preempted: the engine ended it
- unknown: the engine has forgotten the reason
"""


class EngineError(Exception):
    """Error of an engine that refused a request, or that did not answer in time; the text gives the reason."""


class LauncherUnusable(Exception):
    """Error of a launcher that does not exist, cannot be loaded, or has invalid options; the text gives the reason."""


@dataclass(frozen=True)
class LaunchContext:
    """Facts that the workers of a pool need to reach the server, and the options of the launcher.

    Parameters
    ----------
    pool : name of the pool: lower-case letters, digits and hyphens, at most 20 characters
    url : address of the server, as the workers reach it
    token : token that can do nothing but claim jobs with the labels of the pool. It stays valid when the server starts
        again. It must not appear in argument lists, in environment variables, or in logs.
    data : data folder of the server, which no other user can read
    log_form, log_level : form and level of the logs of workers
    options : settings `launcher_options`, replaced by the `options` of the pool where both have a value
    labels : labels of the workers of the pool
    variables : further environment variables of workers on this machine; they may contain the password of a collector
    """

    pool: str
    url: str
    token: str = field(repr=False)
    data: Path
    log_form: LogForm
    log_level: str
    options: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    variables: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def token_file(self) -> Path:
        """File that contains the token, and that no other user can read."""
        return worker_token_file(self.data, self.pool)


Options = TypeVar("Options", bound=BaseModel)


def read_options(model: type[Options], given: Mapping[str, Any], launcher: str) -> Options:
    """Return the options of a launcher as a model. Raises `LauncherUnusable`, whose text names each invalid option."""
    try:
        return model.model_validate(dict(given))
    except ValidationError as error:
        reasons = {".".join(map(str, one["loc"])): plain_reason(one, model) for one in error.errors()}
        faults = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        raise LauncherUnusable(f"options of the launcher {launcher}: {faults}") from None


@dataclass(frozen=True)
class WorkerRequest:
    """Properties of workers to start; the engine's default replaces a property that is None.

    The engine ends a worker after `deadline_s` seconds. `kinds` are the kinds of jobs that the worker claims; empty:
    all kinds. `slots` is the number of jobs that the worker runs at the same time.
    """

    labels: Mapping[str, str] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()
    slots: int = 1
    cpus: int | None = None
    memory_bytes: int | None = None
    gpus: int = 0
    deadline_s: int | None = None


@dataclass(frozen=True)
class LaunchedWorker:
    """Worker that the engine knows. It claims jobs under the name `name`; `started_at` is None until it runs."""

    name: str
    state: WorkerState
    labels: Mapping[str, str] = field(default_factory=dict)
    started_at: datetime | None = None


@dataclass(frozen=True)
class WorkerEnd:
    """End of a worker.

    `status` is its exit status, or the negative number of the signal that ended it; None if unknown.
    """

    reason: EndReason
    status: int | None = None
    detail: str = ""


class Launcher(Protocol):
    """Engine that runs the workers of one pool. Methods raise `EngineError` if a request to the engine fails."""

    outlives_server: bool
    """True if workers continue when the server ends. If so, only the leader among several servers uses the launcher."""

    async def start(self, request: WorkerRequest, count: int, *, key: str) -> tuple[str, ...]:
        """Start `count` workers, and return their names, which contain `key`.

        `key` consists of lower-case letters and digits, at most 16. If the answer to a start was lost, the caller
        repeats the start with the same key and count. A repeated start returns the same names, and starts only workers
        that the engine does not have yet.
        """
        ...

    async def list(self) -> tuple[LaunchedWorker, ...]:
        """Return the workers of the pool that the engine knows, including those that earlier servers started."""
        ...

    async def stop(self, names: tuple[str, ...]) -> None:
        """Let the workers return their jobs to the queue and end; cancel workers that have not started.

        Names of ended or unknown workers are ignored. This method does not wait until the workers have ended.
        """
        ...

    async def why_ended(self, name: str) -> WorkerEnd | None:
        """Return why a worker ended most recently, or None if it has not ended since its start."""
        ...

    async def close(self) -> None:
        """Release the resources of the launcher; stop its workers unless they outlive the server."""
        ...


MakeLauncher = Callable[[LaunchContext], Launcher]
"""Function that makes the launcher of a pool. Raises `LauncherUnusable`."""


def worker_arguments(request: WorkerRequest, url: str) -> tuple[str, ...]:
    """Return the arguments of a Python interpreter that runs a worker, without the name and token of the worker."""
    kinds = (f"--kind={kind}" for kind in request.kinds)
    labels = (f"--label={name}={value}" for name, value in sorted(request.labels.items()))
    return ("-m", "marey_worker", "--server", url, "--slots", str(request.slots), *kinds, *labels)
