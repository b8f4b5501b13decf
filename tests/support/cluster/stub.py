"""The stub cluster as tests use it: in a thread of its own, with a kubeconfig for each caller."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from tests.support.cluster.admission import Rights, shipped_rights
from tests.support.cluster.api import KINDS, NAMESPACE, Api, Faults
from tests.support.cluster.controllers import Controllers
from tests.support.cluster.kubelet import MAREY, Kubelet
from tests.support.cluster.objects import Document, Objects
from tests.support.patience import PATIENCE_S
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets

T = TypeVar("T")

IMAGE = f"registry.example.org/marey-worker@sha256:{'ab' * 32}"
STEP_S = 0.05


class StubCluster:
    """Cluster with one namespace. Its pods are processes of this machine that run the command of their image."""

    instance = "marey"
    """First part of the names of Jobs."""

    def __init__(self, folder: Path, certificate: Path | None = None) -> None:
        self.objects = Objects()
        self.kubelet = Kubelet(self.objects, folder / "pods", {IMAGE: MAREY})
        self.controllers = Controllers(self.objects)
        callers = {"server-token": shipped_rights(), "operator-token": Rights(everything=True)}
        self.api = Api(self.objects, callers, self.kubelet.log_of)
        self.url = ""
        self._folder = folder
        self._certificate = certificate
        self._loop: asyncio.AbstractEventLoop | None = None

    @property
    def faults(self) -> Faults:
        return self.api.faults

    @property
    def kubeconfig(self) -> Path:
        """Kubeconfig with the rights of the shipped role."""
        return self.kubeconfig_of("server")

    @property
    def options(self) -> dict[str, Any]:
        """Options of the launcher for this cluster."""
        return {"image": IMAGE, "kubeconfig": str(self.kubeconfig), "relist_s": 1, "timeout_s": 30.0}

    def kubeconfig_of(self, caller: Literal["server", "operator"]) -> Path:
        """Write and return the kubeconfig of a caller."""
        file = self._folder / f"kubeconfig-{caller}"
        cluster = {"name": "stub", "cluster": {"server": self.url}}
        user = {"name": "server", "user": {"token": f"{caller}-token"}}
        context = {"name": "stub", "context": {"cluster": "stub", "user": "server", "namespace": NAMESPACE}}
        whole = {"apiVersion": "v1", "kind": "Config", "clusters": [cluster], "users": [user], "contexts": [context],
                 "current-context": "stub"}  # fmt: skip
        file.write_text(json.dumps(whole), encoding="utf-8")
        return file

    def run(self, function: Callable[[], T]) -> T:
        """Call a function in the thread of the stub, and return its result."""

        async def call() -> T:
            return function()

        assert self._loop is not None
        return asyncio.run_coroutine_threadsafe(call(), self._loop).result(PATIENCE_S)

    def all(self, kind: str) -> list[Document]:
        """Return all objects of a kind, such as `jobs`."""
        return self.run(lambda: self.objects.select(kind))

    def apply(self, document: Document) -> None:
        """Create an object as an operator does."""
        kind = next(plural for plural, kind in KINDS.items() if kind == document["kind"])
        self.run(lambda: self.objects.create(kind, document))

    def wait_for(self, condition: Callable[[], T], seconds: float = PATIENCE_S) -> T:
        """Wait until a condition holds, and return its value."""
        deadline = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < deadline, self.described()
            time.sleep(0.05)
        return found

    def running_pods(self) -> list[str]:
        """Return the names of the pods that run."""
        return [pod["metadata"]["name"] for pod in self.all("pods") if pod["status"]["phase"] == "Running"]

    def described(self) -> str:
        """Return the objects and the logs of the pods, for the message of a failed test."""
        pods = self.all("pods")
        logs = [f"--- {pod['metadata']['name']}\n{self.kubelet.log_of(pod['metadata']['name'])}" for pod in pods]
        states = [{"name": one["metadata"]["name"], **one.get("status", {})} for one in [*pods, *self.all("jobs")]]
        return "\n".join([yaml.safe_dump(states), *logs])[-6000:]

    async def serve(self, ready: threading.Event, stop: asyncio.Event) -> None:
        """Serve the API and run the controllers until `stop` is set."""
        self._loop = asyncio.get_running_loop()
        secure = None if self._certificate is None else {"certfile": str(self._certificate)}
        server = HTTPServer(self.api.application(), ssl_options=secure)
        sockets = bind_sockets(0, "127.0.0.1")
        server.add_sockets(sockets)
        self.url = f"http{'s' if secure else ''}://127.0.0.1:{sockets[0].getsockname()[1]}"
        ready.set()
        try:
            while not stop.is_set():
                self.controllers.step()
                self.kubelet.step()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(STEP_S):
                        await stop.wait()
        finally:
            await self.kubelet.close()
            server.stop()
            await server.close_all_connections()


@contextlib.contextmanager
def running_cluster(folder: Path, certificate: Path | None = None) -> Iterator[StubCluster]:
    """Run a stub cluster until the `with` block ends; with a file of a certificate and its key, over TLS."""
    (folder / "pods").mkdir(parents=True)
    stub, ready = StubCluster(folder, certificate), threading.Event()
    stops: list[Callable[[], object]] = []

    async def main() -> None:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        stops.append(lambda: loop.call_soon_threadsafe(stop.set))
        await stub.serve(ready, stop)

    thread = threading.Thread(target=lambda: asyncio.run(main()), name="stub-cluster")
    thread.start()
    assert ready.wait(PATIENCE_S), "the stub cluster did not start"
    try:
        yield stub
    finally:
        stops[0]()
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), "the stub cluster did not stop"
