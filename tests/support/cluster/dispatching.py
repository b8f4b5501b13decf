"""Dispatcher in the process of a test, with a stub cluster whose pods run small programs, and the queue of a desk."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, Protocol, TypeVar

from tests.support.cluster.kubelet import SCRIPT
from tests.support.cluster.objects import Document
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import KINDS, Desk

from marey_schemas.queue.jobs import Resources
from marey_schemas.queue.worker_protocol import ClaimRequest, Lease
from marey_server.access.principal import SYSTEM, Principal
from marey_server.launchers.kubernetes.dispatcher import Dispatcher
from marey_server.process.settings import Settings
from marey_server.store.credentials import tokens
from marey_server.store.jobs import queue
from marey_server.store.jobs.claiming.rights import pod_token, read_pod_key

T = TypeVar("T")

WAITS = (*SCRIPT, "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(143)); time.sleep(600)")
ENDS = (*SCRIPT, "pass")
REFUSED = (*SCRIPT, "import sys; sys.exit(42)")
LARGE = Resources(memory_limit_mb=8000)
OWN_IMAGE = f"registry.example.org/motion/torch@sha256:{'cd' * 32}"


class Seconds:
    """Clock that tests set."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


class WatchedCluster(Protocol):
    """Cluster in which a dispatcher starts pods: the functions with which tests examine it."""

    @property
    def instance(self) -> str: ...

    @property
    def options(self) -> dict[str, Any]: ...

    def all(self, kind: str) -> list[Document]: ...

    def running_pods(self) -> list[str]: ...

    def described(self) -> str: ...


class DispatchBench:
    """A dispatcher whose rounds a test calls, with a short pause between lists of the cluster."""

    def __init__(self, desk: Desk, cluster: WatchedCluster, folder: Path) -> None:
        self.desk = desk
        self.cluster = cluster
        self.clock = Seconds()
        self._folder = folder
        self._runner = asyncio.Runner()
        self._opened: list[Dispatcher] = []
        self.dispatcher = self.open()

    def open(self, **rules: Any) -> Dispatcher:
        """Return a new dispatcher, as if the server had died and the next server had started its own."""
        labels = {"gpu=a100": {"accelerator": "a100"}}
        own_pods = {"most": 5, "memory_mb": 4096, "labels": labels, "images": ["registry.example.org/motion/"], **rules}
        settings = Settings(
            data=self._folder, launcher="kubernetes", launcher_options=self.cluster.options, own_pods=own_pods
        )
        assert settings.own_pods is not None
        self.desk.database.pod_rules = settings.own_pods.rules
        self.dispatcher = Dispatcher(settings, self.desk.database, "http://marey:8460", clock_s=self.clock)
        self._opened.append(self.dispatcher)
        return self.dispatcher

    def do(self, call: Coroutine[Any, Any, T]) -> T:
        """Await the result of a call."""
        return self._runner.run(call)

    def round(self, seconds: float = 0.0) -> None:
        """Let the dispatcher adjust the pods once, `seconds` after the round before."""
        self.clock.now += seconds
        self.do(self.dispatcher.adjust())

    def rounds_until(self, found: Callable[[], T], step_s: float = 0.0) -> T:
        """Let the dispatcher adjust the pods, every `step_s` seconds, until `found` is true; return its value."""

        async def adjust() -> T:
            deadline = asyncio.get_running_loop().time() + PATIENCE_S
            while not (value := found()):
                assert asyncio.get_running_loop().time() < deadline, self.cluster.described()
                self.clock.now += step_s
                await self.dispatcher.adjust()
                await asyncio.sleep(0.1)
            return value

        return self.do(adjust())

    def jobs(self) -> list[str]:
        """Return the names of the Jobs in the cluster, sorted."""
        return sorted(job["metadata"]["name"] for job in self.cluster.all("jobs"))

    def pods(self) -> list[str]:
        """Return the names of the pods that run."""
        return self.cluster.running_pods()

    def pod_of(self, job_id: str) -> Principal:
        """Return the principal that the server finds for the token of the pods of a job."""
        key = self.desk.database.read(SYSTEM, read_pod_key)
        return self.desk.database.read(SYSTEM, tokens.resolve_token, pod_token(key, job_id))

    def claim(self, job_id: str, **fields: Any) -> list[Lease]:
        """Claim a job as its pod does."""
        labels = self.desk.job(job_id).labels
        request = ClaimRequest(**dict[str, Any](worker="pod", kinds=tuple(KINDS), labels=labels, job=job_id) | fields)
        return self.desk.database.write(self.pod_of(job_id), queue.claim, request, self.desk.policy)

    def close(self) -> None:
        for one in self._opened:
            self.do(one.close())
        self._runner.close()


def name_of(job_id: str, number: int, instance: str = "marey") -> str:
    """Return the name of the Job of a start."""
    return f"{instance}-{job_id.replace('_', '-')}-{number}"
