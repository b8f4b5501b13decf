"""Server and worker for a benchmark, each in one process of this machine, with data in temporary folders.

The settings are the defaults: SQLite with every commit on the disk, blobs in the database, and one log line per
request.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import psutil

from benchmarks.material import noisy_clip
from marey_client import Marey
from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_schemas.access import ProjectCreate
from marey_schemas.documents.clips import ClipInfo
from marey_schemas.documents.references import RevisionRef

PROJECT = "bench"
START_S = 60
STOP_S = 40
WORKER_STOP_S = 60
WARM_S = 300


@dataclass(frozen=True)
class LocalServer:
    """Server that runs in a process of this machine."""

    url: str
    data: Path
    pid: int

    @property
    def port(self) -> int:
        """The port on which the server listens."""
        return int(self.url.rpartition(":")[2])

    @property
    def token(self) -> str:
        """The token of the administrator."""
        return (self.data / "admin.token").read_text().strip()

    def processor_s(self) -> float:
        """Return the processor time that the server has used so far, in seconds."""
        times = psutil.Process(self.pid).cpu_times()
        return float(times.user + times.system)

    def client(self) -> Marey:
        """Return a client of this server, with the token of the administrator."""
        return Marey(self.url, self.token)


@contextmanager
def local_server(prepare: Callable[[Path], None] | None = None, **settings: str) -> Iterator[LocalServer]:
    """Run a server while the `with` block runs; `prepare` fills the data folder before the server starts."""
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as folder:
        data = Path(folder, "data")
        if prepare is not None:
            prepare(data)
        with running(data, **settings) as server:
            yield server


@contextmanager
def running(data: Path, **settings: str) -> Iterator[LocalServer]:
    """Run a server with this data folder while the `with` block runs; `settings` are environment variables."""
    port = free_port()
    with Path(data.parent, "server.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "marey_client.cli", "serve", "--workers", "0"],
            env=clean_environment() | {"MAREY_DATA": str(data), "MAREY_PORT": str(port), **settings},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
    server = LocalServer(f"http://127.0.0.1:{port}", data, process.pid)
    try:
        _wait_until_ready(server, process)
        _wait_until_warm(server)
        yield server
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(STOP_S)


@contextmanager
def one_worker(server: LocalServer, *, slots: int = 1) -> Iterator[None]:
    """Run a worker that runs `slots` jobs at the same time, while the `with` block runs."""
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as cache:
        process = subprocess.Popen(
            [sys.executable, "-m", "marey_client.cli", "worker", "--cache", cache, "--slots", str(slots)],
            env=clean_environment() | {"MAREY_SERVER": server.url, "MAREY_TOKEN": server.token},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield
        finally:
            process.terminate()
            process.wait(WORKER_STOP_S)


def clean_environment() -> dict[str, str]:
    """Return the environment variables of this process, without the settings of servers."""
    return {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}


def _wait_until_ready(server: LocalServer, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        try:
            if httpx.get(f"{server.url}/readyz").status_code == 200:
                return
        except httpx.TransportError:
            time.sleep(0.05)
    raise RuntimeError(f"the server did not start:\n{Path(server.data.parent, 'server.log').read_text()[-3000:]}")


def _wait_until_warm(server: LocalServer) -> None:
    """Wait until a new server has compiled its kernels in a child process, because compiling would distort times."""
    compiling = [one for one in psutil.Process(server.pid).children() if "marey_motion.warm_up" in one.cmdline()]
    _, running = psutil.wait_procs(compiling, timeout=WARM_S)
    if running:
        raise RuntimeError(f"after {WARM_S} s the server still compiles its kernels; run `make installed` first")


def free_port() -> int:
    """Return a port of this machine on which no program listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@dataclass(frozen=True)
class Seeded:
    """A clip and the clip's skeleton, which `seed` has created in a project."""

    clip: str
    stored_bytes: int
    skeleton: RevisionRef


def seed(server: LocalServer, frames: int, joints: int) -> Seeded:
    """Create a project, a skeleton and one clip with the client; return the clip and the skeleton."""
    clip = noisy_clip(frames, joints)
    with server.client() as marey:
        project = marey.create_project(ProjectCreate(name=PROJECT))
        hierarchy = skeleton_to_document(clip.skeleton).model_dump(by_alias=True)
        made = project.skeletons.create("rig", {"hierarchy": hierarchy})
        skeleton = RevisionRef(item=made.id, revision=1)
        item = project.clips.create("clip", clip_parts(clip, skeleton)).item
    return Seeded(item.id, item.parts["motion"].size_bytes, skeleton)


def clip_parts(clip: Clip, skeleton: RevisionRef) -> dict[str, dict[str, object]]:
    """Return the documents of a clip that uses a stored skeleton."""
    return {
        "motion": clip_to_document(clip, skeleton).model_dump(by_alias=True),
        "info": ClipInfo().model_dump(mode="json", by_alias=True),
    }
