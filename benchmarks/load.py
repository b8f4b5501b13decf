"""Load that clients and workers put on a server. Each function runs in a process of its own (`in_process`)."""

from __future__ import annotations

import multiprocessing
import secrets
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from benchmarks.local_server import PROJECT, clip_parts
from benchmarks.material import noisy_clip
from benchmarks.wire import Connection
from marey_schemas.documents.references import RevisionRef
from marey_schemas.encoding.codecs import MSGPACK, encode_tree

T = TypeVar("T")

BLOCKS = "application/msgpack; arrays=blocks"
WARM_UP_S = 0.5


@dataclass(frozen=True)
class Load:
    """Requests answered, in how much time, and how long each took."""

    seconds: float
    latencies_s: list[float]

    @classmethod
    def joined(cls, loads: Sequence[Load]) -> Load:
        """Several of the same kind as one."""
        return cls(sum(one.seconds for one in loads), [latency for one in loads for latency in one.latencies_s])

    @property
    def per_second(self) -> float:
        """Answers per second."""
        return len(self.latencies_s) / self.seconds

    def percentile_ms(self, percent: int) -> float:
        """Compute the time that `percent` of the requests did not exceed, in milliseconds."""
        return statistics.quantiles(self.latencies_s, n=100, method="inclusive")[percent - 1] * 1e3


@contextmanager
def in_processes(count: int) -> Iterator[Callable[..., Future[Any]]]:
    """Make a function that starts another one in one of `count` processes."""
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool.submit


def read_steadily(port: int, token: str, path: str, *, accept: str, connections: int, seconds: float) -> Load:
    """GET one address over and over on each of `connections`."""

    def once(connection: Connection) -> None:
        connection.exchange(connection.head("GET", path, Accept=accept))

    return _repeatedly(port, token, once, connections, seconds)


def upload_steadily(port: int, token: str, skeleton: RevisionRef, *, frames: int, joints: int, seconds: float) -> Load:
    """Create clips on one connection, no two of them equal, with arrays as the client sends them."""
    clip = noisy_clip(frames, joints)
    sideways = np.eye(1, clip.poses.shape[1], dtype=np.float32)
    run = secrets.token_hex(4)
    made = 0

    def once(connection: Connection) -> None:
        nonlocal made
        made += 1
        moved = replace(clip, poses=clip.poses + np.float32(0.001 * made) * sideways)
        body = encode_tree({"name": f"{run}-{made}", "parts": clip_parts(moved, skeleton)}, MSGPACK, arrays="blocks")
        path = f"/projects/{PROJECT}/clips"
        connection.exchange(connection.head("POST", path, length=len(body), Content_Type=MSGPACK) + body)

    return _repeatedly(port, token, once, 1, seconds)


def cycle_jobs(port: int, token: str, job: dict[str, Any], *, connections: int, seconds: float) -> Load:
    """Submit a job, claim one, complete it: three requests, each on the disk before its answer."""

    def once(connection: Connection) -> None:
        connection.call(f"/projects/{PROJECT}/jobs", job)
        (lease,) = connection.call("/leases", {"worker": "bench", "kinds": [job["kind"]]})["leases"]
        path = f"/jobs/{lease['job']}/attempts/{lease['fence']}/complete"
        connection.call(path, {"write_id": secrets.token_hex(8)}, token=lease["attempt_token"])

    return _repeatedly(port, token, once, connections, seconds)


def cycle_job_batches(port: int, token: str, job: dict[str, Any], *, size: int, seconds: float) -> Load:
    """Submit, claim and complete `size` jobs with three requests."""

    def once(connection: Connection) -> None:
        connection.call(f"/projects/{PROJECT}/jobs/batch", {"jobs": [job] * size})
        leases = connection.call("/leases", {"worker": "bench", "kinds": [job["kind"]], "max": size})["leases"]
        assert len(leases) == size, f"{len(leases)} leases of {size}"
        wanted = [{"job": lease["job"], "fence": lease["fence"], "write_id": secrets.token_hex(8)} for lease in leases]
        results = connection.call("/leases/completions", {"completions": wanted})["results"]
        assert all(result["answer"] for result in results), results[0]

    return _repeatedly(port, token, once, 1, seconds)


def _repeatedly(port: int, token: str, once: Callable[[Connection], None], connections: int, seconds: float) -> Load:
    """Call `once` over and over, in a thread per connection, and time what begins after the warm-up."""
    start = time.perf_counter() + WARM_UP_S
    latencies: list[float] = []
    failures: list[BaseException] = []

    def work() -> None:
        try:
            with Connection(port, token) as connection:
                while (begun := time.perf_counter()) < start + seconds:
                    once(connection)
                    if begun >= start:
                        latencies.append(time.perf_counter() - begun)
        except BaseException as failure:  # noqa: BLE001 - raised again by the thread that waits
            failures.append(failure)

    threads = [threading.Thread(target=work) for _ in range(connections)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return Load(seconds, latencies)
