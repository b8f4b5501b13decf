"""Functions that load a server as clients and workers do; `in_processes` runs each function in a separate process."""

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
    """Requests that were answered: the duration of the measurement, and the duration of each request, in seconds."""

    seconds: float
    latencies_s: list[float]

    @classmethod
    def joined(cls, loads: Sequence[Load]) -> Load:
        """Return several measurements of the same kind as one: durations are added, requests are combined."""
        return cls(sum(one.seconds for one in loads), [latency for one in loads for latency in one.latencies_s])

    @property
    def per_second(self) -> float:
        """Number of answers per second."""
        return len(self.latencies_s) / self.seconds

    def percentile_ms(self, percent: int) -> float:
        """Return the time in milliseconds that `percent` % of the requests did not exceed."""
        return statistics.quantiles(self.latencies_s, n=100, method="inclusive")[percent - 1] * 1e3


@contextmanager
def in_processes(count: int) -> Iterator[Callable[..., Future[Any]]]:
    """Yield a function that runs another function in one of `count` processes, and returns the future of its result."""
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool.submit


def read_steadily(port: int, token: str, path: str, *, accept: str, connections: int, seconds: float) -> Load:
    """Request one path by GET again and again, over each of several connections; return the durations."""

    def once(connection: Connection) -> None:
        connection.exchange(connection.head("GET", path, Accept=accept))

    return _repeatedly(port, token, once, connections, seconds)


def upload_steadily(port: int, token: str, skeleton: RevisionRef, *, frames: int, joints: int, seconds: float) -> Load:
    """Create clips, all of them different, over one connection, with arrays encoded as the client encodes them."""
    clip = noisy_clip(frames, joints)
    sideways = np.eye(1, clip.poses.shape[1], dtype=np.float32)
    run = secrets.token_hex(4)
    made = 0

    def once(connection: Connection) -> None:
        nonlocal made
        made += 1
        moved = replace(clip, poses=np.asarray(clip.poses + np.float32(0.001 * made) * sideways, dtype=np.float32))
        body = encode_tree({"name": f"{run}-{made}", "parts": clip_parts(moved, skeleton)}, MSGPACK, arrays="blocks")
        path = f"/projects/{PROJECT}/clips"
        connection.exchange(connection.head("POST", path, length=len(body), Content_Type=MSGPACK) + body)

    return _repeatedly(port, token, once, 1, seconds)


def cycle_jobs(port: int, token: str, job: dict[str, Any], *, connections: int, seconds: float) -> Load:
    """Submit, claim and complete one job, again and again; the server writes each step to the disk, then answers."""

    def once(connection: Connection) -> None:
        connection.call(f"/projects/{PROJECT}/jobs", job)
        (lease,) = connection.call("/leases", {"worker": "bench", "kinds": [job["kind"]]})["leases"]
        path = f"/jobs/{lease['job']}/attempts/{lease['fence']}/complete"
        connection.call(path, {"write_id": secrets.token_hex(8)}, token=lease["attempt_token"])

    return _repeatedly(port, token, once, connections, seconds)


def cycle_job_batches(port: int, token: str, job: dict[str, Any], *, size: int, seconds: float) -> Load:
    """Submit, claim and complete `size` jobs with three requests, again and again."""

    def once(connection: Connection) -> None:
        connection.call(f"/projects/{PROJECT}/jobs/batch", {"jobs": [job] * size})
        leases = connection.call("/leases", {"worker": "bench", "kinds": [job["kind"]], "max": size})["leases"]
        assert len(leases) == size, f"{len(leases)} leases of {size}"
        wanted = [{"job": lease["job"], "fence": lease["fence"], "write_id": secrets.token_hex(8)} for lease in leases]
        results = connection.call("/leases/completions", {"completions": wanted})["results"]
        assert all(result["answer"] for result in results), results[0]

    return _repeatedly(port, token, once, 1, seconds)


def _repeatedly(port: int, token: str, once: Callable[[Connection], None], connections: int, seconds: float) -> Load:
    """Call `once` again and again in a thread for each connection; return the durations of calls after the warm-up."""
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
