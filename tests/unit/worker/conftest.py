"""Simulated server for workers, and worker processes that use it."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.attached_worker import AttachedWorker, StartWorker
from tests.support.fake_server import FakeServer


@pytest.fixture
def server() -> Iterator[FakeServer]:
    """A simulated server that speaks the worker protocol."""
    fake = FakeServer()
    yield fake
    fake.close()


@pytest.fixture
def start_worker(server: FakeServer, tmp_path: Path) -> Iterator[StartWorker]:
    """Function that starts a worker of `server`; the workers end with the test."""
    workers: list[AttachedWorker] = []

    def start(
        *options: str, env: dict[str, str] | None = None, token_file: Path | None = None, forked: bool = True
    ) -> AttachedWorker:
        workers.append(AttachedWorker(server, tmp_path, *options, env=env, token_file=token_file, forked=forked))
        return workers[-1]

    yield start
    for worker in workers:
        worker.close()
    show(tmp_path)


@pytest.fixture(scope="module")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeServer]:
    """A simulated server with a worker that several tests share, because starting a worker takes long."""
    fake, folder = FakeServer(), tmp_path_factory.mktemp("worker")
    worker = AttachedWorker(fake, folder)
    yield fake
    worker.close()
    fake.close()
    show(folder)


def show(folder: Path) -> None:
    """Print the logs of the workers in a folder, so that pytest shows them with the failure of a test."""
    for log in folder.glob(AttachedWorker.LOG):
        sys.stderr.write(log.read_text())
