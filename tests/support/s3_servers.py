"""S3 servers for tests: SeaweedFS and moto, each a process that listens on the loopback address."""

from __future__ import annotations

import contextlib
import json
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from marey_server.store.blob_backings import DatabaseBlobs
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_storage.client import Bucket, ObjectStorage, ObjectStorageProblem

KEY_ID, SECRET_KEY = "marey-tests", "secret-of-tests"
START_S = 60.0
"""Longest time in seconds that a server may take to start."""


def free_ports(count: int) -> list[int]:
    """Return ports on which nothing listens."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]


@dataclass
class S3Server:
    """An S3 server that can be killed, stopped and started again with the same data, if it keeps data on disk."""

    name: str
    port: int
    command: list[str]
    folder: Path
    creates_bucket: bool = False
    """Whether the bucket must be created, because the server does not create it with the first object."""
    _process: subprocess.Popen[bytes] | None = field(default=None, init=False)

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def pid(self) -> int:
        """The id of the running process."""
        assert self._process is not None
        return self._process.pid

    def bucket(self, prefix: str, **changes: Any) -> Bucket:
        """Return the settings of a bucket on this server; tests use one bucket with different prefixes."""
        settings = Bucket(
            "marey", endpoint=self.endpoint, prefix=prefix, key_id=KEY_ID, secret_key=SECRET_KEY, timeout_s=20
        )
        return replace(settings, **changes)

    def start(self, bucket: Bucket | None = None) -> None:
        """Start the process, wait until it stores objects in `bucket`, and create the bucket unless it exists."""
        bucket = replace(bucket or self.bucket("first"), timeout_s=5)
        with open(self.folder / "log", "ab") as log:
            self._process = subprocess.Popen(
                self.command,
                cwd=self.folder,
                stdout=log,
                stderr=log,
                env={"AWS_ACCESS_KEY_ID": KEY_ID, "AWS_SECRET_ACCESS_KEY": SECRET_KEY, "HOME": str(self.folder)},
            )
        deadline = time.monotonic() + START_S
        while not self._stores_in(bucket):
            if self._process.poll() is not None or time.monotonic() > deadline:
                log_text = (self.folder / "log").read_text(errors="replace")
                raise RuntimeError(f"{self.name} did not start: {log_text[-2000:]}")
            time.sleep(0.1)

    def _stores_in(self, bucket: Bucket) -> bool:
        """Create the bucket unless it exists, and return whether objects can be stored in it."""
        try:
            if self.creates_bucket:
                httpx.put(f"{self.endpoint}/marey", timeout=5)
            storage = ObjectStorage(bucket)
            storage.put("first", [b"first"])
            return storage.read("first", 0, 5) == b"first"
        except (httpx.HTTPError, ObjectStorageProblem):
            return False

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process."""
        assert self._process is not None
        self._process.send_signal(number)

    def stop(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)
            self._process.kill()
            self._process.wait()
            self._process = None


def moto(folder: Path) -> S3Server:
    """Return a server that keeps objects in memory and does not check signatures."""
    (port,) = free_ports(1)
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    return S3Server("moto", port, command, folder, creates_bucket=True)


def seaweedfs(folder: Path, command: Sequence[str] = ()) -> S3Server:
    """Return a server that keeps objects on disk and checks signatures; `command` replaces the usual command."""
    ports = free_ports(10)
    names = (
        "s3.port", "s3.port.grpc", "master.port", "master.port.grpc", "volume.port", "volume.port.grpc", "filer.port",
        "filer.port.grpc", "s3.port.iceberg", "s3.port.lance",
    )  # fmt: skip
    options = [f"-{name}={port}" for name, port in zip(names, ports, strict=True)]
    options += [f"-filer.localSocket={folder / 'filer.sock'}", f"-s3.localSocket={folder / 's3.sock'}"]
    program = Path(sys.executable).with_name("weed")
    return S3Server("seaweedfs", ports[0], [str(program), *(command or _usual(folder)), *options], folder)


def _usual(folder: Path) -> list[str]:
    """Return the command of a server with one access key, and write the file of access keys."""
    identity = {
        "name": "marey",
        "credentials": [{"accessKey": KEY_ID, "secretKey": SECRET_KEY}],
        "actions": ["Admin", "Read", "Write", "List"],
    }
    (folder / "s3.json").write_text(json.dumps({"identities": [identity]}))
    (folder / "data").mkdir(exist_ok=True)
    words = ["server", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", f"-dir={folder / 'data'}", "-s3", "-iam=false"]
    return [*words, f"-s3.config={folder / 's3.json'}", "-master.volumeSizeLimitMB=64", "-master.telemetry=false"]


MAKERS = {"moto": moto, "seaweedfs": seaweedfs}


@pytest.fixture(scope="session")
def s3_servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], S3Server]]:
    """Function that returns the running server with a name, which all tests of this process share."""
    running: dict[str, S3Server] = {}

    def get(name: str) -> S3Server:
        if name not in running:
            running[name] = MAKERS[name](tmp_path_factory.mktemp(name))
            running[name].start()
        return running[name]

    yield get
    for one in running.values():
        one.stop()


@pytest.fixture(params=[pytest.param("moto", marks=pytest.mark.soak), "seaweedfs"])
def s3_server(request: pytest.FixtureRequest, s3_servers: Callable[[str], S3Server]) -> S3Server:
    """A running S3 server: SeaweedFS, and in the tier soak also moto."""
    return s3_servers(request.param)


@pytest.fixture
def bucket(s3_server: S3Server) -> Bucket:
    """An empty part of the bucket of a running server."""
    return s3_server.bucket(f"test-{secrets.token_hex(8)}")


@pytest.fixture
def object_blobs(bucket: Bucket) -> ObjectBlobs:
    """Backing that stores blobs in an empty part of a bucket."""
    return ObjectBlobs(ObjectStorage(bucket), DatabaseBlobs())
