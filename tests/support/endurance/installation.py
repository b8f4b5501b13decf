"""An installation of Marey for a trial: Postgres, an S3 server, two servers and several workers, with proxies between.

Every server reaches Postgres through a proxy of its own, and every worker its server, so that each connection can be
cut or silenced by itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import psutil
from tests.support.attached_worker import python_path
from tests.support.endurance.postgres import PostgresProcess
from tests.support.forked_programs import nursery
from tests.support.s3_servers import KEY_ID, MAKERS, SECRET_KEY, S3Server
from tests.support.server_process import PATIENT, QUICK_LEASES, ServerProcess, WorkerProcess
from tests.support.tcp_proxy import TcpProxy

from marey_client import Marey
from marey_server.app import connect_database
from marey_server.process.settings import Settings
from marey_server.store.fsck import check_store
from marey_worker.scripts.confinement import PR_SET_CHILD_SUBREAPER

SERVERS, WORKERS = 2, 6
SERVE = "marey_client.cli"
WITHOUT_FENCE = "tests.support.endurance.without_fence"
"""Module that runs `marey` without the comparison of fences."""
PREFIX = "marey-trial-"
DYING_S = 3.0
"""Time in which the children of a process that was killed must notice this, in seconds."""


class TrialServer(ServerProcess):
    """`marey serve` with the job kinds of tests and its blobs in S3; `module` is the module of the command `marey`."""

    def __init__(self, folder: Path, database_url: str, module: str, **environment: str) -> None:
        folder.mkdir()
        super().__init__(folder, database_url, PYTHONPATH=python_path(), **environment)
        self._module = module

    def spawn(self, arguments: list[str], environment: dict[str, str], stdin: bytes | None = None) -> None:
        """Start the server from the module that was given to the constructor."""
        super().spawn([self._module, *arguments[1:]], environment, stdin)


class TrialWorker(WorkerProcess):
    """A worker that runs all kinds of jobs, also those that only tests know, and has its own proxy to a server."""

    def __init__(self, folder: Path, token: str, link: TcpProxy) -> None:
        folder.mkdir()
        super().__init__(folder / "worker.log", PYTHONPATH=python_path(), TMPDIR=str(folder))
        self.link = link
        self._token = token

    def begin(self) -> None:
        """Start the worker."""
        folder = self.log.parent
        self.start(f"http://127.0.0.1:{self.link.port}", self._token, folder, name=folder.name)


@dataclass
class Installation:
    """The running processes of a trial."""

    folder: Path
    postgres: PostgresProcess
    s3: S3Server
    settings: dict[str, str]
    servers: list[TrialServer] = field(default_factory=list)
    database_links: list[TcpProxy] = field(default_factory=list)
    workers: list[TrialWorker] = field(default_factory=list)

    def client(self, number: int = 0) -> Marey:
        """Return an administrator's client of one server, whose retries last longer than any fault."""
        return Marey(self.servers[number].url, self.servers[0].token, retries=PATIENT)

    def begin_work(self) -> None:
        """Start the workers."""
        for worker in self.workers:
            worker.begin()

    def check_store(self) -> list[str]:
        """Return what `marey db fsck` finds."""
        given: dict[str, Any] = {name.removeprefix("MAREY_").lower(): text for name, text in self.settings.items()}
        settings = Settings(data=self.servers[0].data, database_url=self.postgres.address(), **given)
        with closing(connect_database(settings)) as database:
            return [str(one) for one in check_store(database)]

    def stop_marey(self) -> list[str]:
        """Stop workers and servers; return the processes that they have left behind, and other faults."""
        faults = []
        for process in (*self.workers, *self.servers):
            status = process.stop()
            if isinstance(process, ServerProcess) and status != 0:
                faults.append(f"{process.log.parent.name} ended with the status {status}")
        faults += left_behind({nursery().pid, self.postgres.pid, self.s3.pid})
        return faults


def left_behind(known: Collection[int]) -> list[str]:
    """Return the children of this process that still run after a moment, except those with the given ids."""
    _, left = psutil.wait_procs([one for one in psutil.Process().children() if one.pid not in known], timeout=DYING_S)
    found = []
    for one in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            if one.status() != psutil.STATUS_ZOMBIE:
                found.append(f"the process {one.pid} is left: {' '.join(one.cmdline())}")
    return found


@contextlib.contextmanager
def installation(
    s3: str,
    *,
    workers: int = WORKERS,
    module: str = SERVE,
    settings: Mapping[str, str] = MappingProxyType({}),
    keep_logs: Path | None = None,
) -> Iterator[Installation]:
    """Run an installation with the S3 server of this name while the `with` block runs; at its end, copy the logs.

    The workers start with `begin_work`. Processes whose parents are killed become children of this process, so that
    `stop_marey` finds them.
    """
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True)))
        postgres = PostgresProcess(folder / "postgres")
        stack.callback(postgres.stop)
        (folder / s3).mkdir()
        storage = MAKERS[s3](folder / s3)
        stack.callback(storage.stop)
        storage.start()
        made = Installation(folder, postgres, storage, _blobs_in(storage, folder))
        environment = {**QUICK_LEASES, **made.settings, **settings}
        if keep_logs is not None:
            stack.callback(_copy_logs, made, keep_logs)
        stack.callback(_kill_all, made)
        for number in range(SERVERS):
            link = stack.enter_context(TcpProxy(postgres.port))
            made.database_links.append(link)
            server = TrialServer(folder / f"server{number}", postgres.address(link.port), module, **environment)
            made.servers.append(server.start())
        for number in range(workers):
            link = stack.enter_context(TcpProxy(made.servers[number % SERVERS].port))
            made.workers.append(TrialWorker(folder / f"worker{number}", made.servers[0].token, link))
        yield made


def _blobs_in(storage: S3Server, folder: Path) -> dict[str, str]:
    secret = folder / "secret-key"
    secret.write_text(f"{SECRET_KEY}\n")
    secret.chmod(0o600)
    return {
        "MAREY_BLOBS": "s3",
        "MAREY_S3_BUCKET": "marey",
        "MAREY_S3_ENDPOINT": storage.endpoint,
        "MAREY_S3_PREFIX": f"trial-{os.getpid()}",
        "MAREY_S3_KEY_ID": KEY_ID,
        "MAREY_S3_SECRET_KEY_FILE": str(secret),
        "MAREY_S3_TIMEOUT_S": "10",
    }


def _kill_all(made: Installation) -> None:
    for process in (*made.workers, *made.servers):
        if process.process is not None and process.process.poll() is None:
            process.kill()


def _copy_logs(made: Installation, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for process in (*made.workers, *made.servers):
        shutil.copyfile(process.log, folder / f"{process.log.parent.name}.log")
    shutil.copyfile(made.postgres.folder / "log", folder / "postgres.log")
