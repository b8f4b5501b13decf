"""Trial by load: requests of all sorts arrive at a stated rate for a stated time, hostile ones among them."""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import httpx
import numpy as np
from tests.support.endurance.installation import Installation, installation
from tests.support.endurance.measured_growth import Growth, growth_of
from tests.support.furnished_house import House, build_house, start_attempt
from tests.support.hostile_client import ATTACKED, ENDS_CREDENTIALS, SMALL_BYTES, Shot, fire, shots, some
from tests.support.process_cost import ProcessCost
from tests.support.rest_server import People
from tests.support.store_fixtures import skeleton_tree

from marey_client.load.figures import percentile
from marey_client.load.offering import arrival_times
from marey_schemas.access import ProjectCreate
from marey_schemas.address import API
from marey_schemas.encoding.digests import digest_of
from marey_schemas.formats import OCTETS
from marey_server.store.database.connections import Database

LEASE_S, HEARTBEAT_S = 15.0, 3.0
SETTLING_S = 300.0
"""Seconds after which the growth of the memory is measured; in a short trial, after a third of its duration."""
SENDERS = 24
SHOTS = 2_000
"""Number of hostile requests to choose from. All are sent once before the trial, because the first one of each sort
pays for what the server builds once; at 2 requests per second, this would look like growth for a quarter of an hour."""
ATTACKERS = ("contributor", "stranger")
"""Callers who send hostile requests; the requests of all callers would take gigabytes of memory."""
SAMPLE_EVERY_S = 2.0
UPLOAD_BYTES = 50_000
SHARES = {"read": 50, "list": 20, "upload": 10, "job": 5, "events": 5, "hostile": 10}
"""Shares of the sorts of requests in percent."""
Say = Callable[[str], None]


@dataclass(frozen=True)
class LoadTrial:
    """Parameters of a trial, and the limits that it checks."""

    minutes: float
    rate: float
    """Requests per second, of all sorts together."""
    seed: int
    s3: str = "seaweedfs"
    workers: int = 2
    most_read_ms: float = 1_000.0
    """Greatest 99th percentile of the waits of reads and lists, in milliseconds."""
    most_growth_mb_h: float = 60.0
    """Greatest growth of the memory of a server, in MB per hour: the lower end of the interval must not exceed it.

    In trials of less than ten minutes, in which servers still fill their caches, growth is printed, but not limited.
    """


@dataclass
class Record:
    """Measurements of a trial."""

    waits_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    faults: Counter[str] = field(default_factory=Counter)
    memory: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))
    """Time in seconds and memory in MB of each server: with its child processes, and alone."""


def run(trial: LoadTrial, say: Say) -> list[str]:
    """Run a trial, print a table, and return the rules that were broken."""
    settings = ATTACKED | {"MAREY_LEASE_TTL_S": str(LEASE_S), "MAREY_HEARTBEAT_S": str(HEARTBEAT_S)}
    with (
        installation(trial.s3, workers=trial.workers, settings=settings) as made,
        closing(Database(made.postgres.address())) as database,
    ):
        house = build_house(People(made.servers[0].url, database))
        visitors = Visitors(made, house, random.Random(trial.seed))
        lease = start_attempt(house.people, house.tokens, house.variables["item"])
        made.begin_work()
        record = Record()
        say(f"{trial.rate:g} requests per second for {trial.minutes:g} minutes")
        with _measuring(made, house, lease, record):
            visitors.warm_up(record)
            visitors.visit(arrival_times(trial.rate, 60 * trial.minutes, trial.seed), record)
        unfinished = visitors.unfinished_jobs()
        growths = {name: _growth(samples) for name, samples in record.memory.items()}
        _print(record, growths, say)
        broken = [f"{count} times: {what}" for what, count in record.faults.items()]
        broken += _beyond(trial, record, growths) + unfinished + made.stop_marey()
        return broken + [f"fsck: {one}" for one in made.check_store()]


class Visitors:
    """Threads that send requests of all sorts to both servers, at given times."""

    def __init__(self, made: Installation, house: House, draw: random.Random) -> None:
        self._made, self._house, self._draw = made, house, draw
        self._own = threading.local()
        self._addresses = itertools.cycle([server.url for server in made.servers])
        self._seen = 0
        self._numbers = itertools.count()
        with made.client() as marey:
            lab = marey.create_project(ProjectCreate(name="load"))
            self._rigs = [lab.skeletons.create(f"rig {n}", {"hierarchy": skeleton_tree()}).id for n in range(20)]
        hostile = some(shots(house, ATTACKERS), SHOTS, draw.randrange(1 << 32))
        self._hostile = [
            one for one in hostile if not one.route.endswith(ENDS_CREDENTIALS) and len(one.data) <= SMALL_BYTES
        ]

    def warm_up(self, record: Record) -> None:
        """Send each hostile request once."""
        with ThreadPoolExecutor(SENDERS) as pool:
            for _ in pool.map(partial(self._send_hostile, record), self._hostile):
                pass

    def visit(self, times_s: list[float], record: Record) -> None:
        """Send a request at each of the times; the wait for an answer counts from that time."""
        begun = time.monotonic()
        sorts = self._draw.choices(list(SHARES), list(SHARES.values()), k=len(times_s))
        hostile = itertools.cycle(self._hostile)
        sent: list[Future[None]] = []
        with ThreadPoolExecutor(SENDERS) as pool, ThreadPoolExecutor(SENDERS) as slow_pool:
            for after_s, sort in zip(times_s, sorts, strict=True):
                time.sleep(max(0.0, begun + after_s - time.monotonic()))
                senders = slow_pool if sort == "hostile" else pool
                sent.append(senders.submit(self._send, sort, begun + after_s, record, next(hostile)))
        for one in sent:
            one.result()

    def unfinished_jobs(self) -> list[str]:
        """Wait until the jobs have ended; return those that have not succeeded."""
        with self._made.client() as marey:
            jobs = list(marey.jobs.list("load", limit=1000))
            ended = [marey.jobs.wait(job.id, timeout_s=300, require_success=False) for job in jobs]
        return [f"the job {job.id} is {job.state}" for job in ended if job.state != "succeeded"]

    def _send(self, sort: str, planned: float, record: Record, shot: Shot) -> None:
        if sort == "hostile":
            self._send_hostile(record, shot)
        else:
            try:
                answer = getattr(self, f"_{sort}")(self._client())
                if answer.status_code >= 400:
                    record.faults[f"{sort}: {answer.status_code} {answer.text[:80]}"] += 1
            except httpx.TransportError as error:
                record.faults[f"{sort}: {error!r}"] += 1
        record.waits_s[sort].append(time.monotonic() - planned)

    def _send_hostile(self, record: Record, shot: Shot) -> None:
        if fault := asyncio.run(fire(self._made.servers[0].url, shot)).fault:
            record.faults[f"hostile: {fault}"] += 1

    def _client(self) -> httpx.Client:
        if not hasattr(self._own, "client"):
            token = self._made.servers[0].token
            self._own.client = httpx.Client(
                base_url=next(self._addresses) + API, headers={"Authorization": f"Bearer {token}"}, timeout=60
            )
        return self._own.client

    def _read(self, client: httpx.Client) -> httpx.Response:
        return client.get(f"/projects/load/skeletons/{random.choice(self._rigs)}/parts/hierarchy")

    def _list(self, client: httpx.Client) -> httpx.Response:
        return client.get("/projects/load/characters", params={"limit": 50, "sort": "-created_at"})

    def _upload(self, client: httpx.Client) -> httpx.Response:
        data = os.urandom(UPLOAD_BYTES)
        sent = client.put(f"/blobs/{digest_of(data)}", content=data, headers={"Content-Type": OCTETS})
        if sent.status_code >= 400:
            return sent
        study = {"schema": "marey/document@1", "blob": digest_of(data)}
        name = f"study {next(self._numbers)}"
        return client.post("/projects/load/characters", json={"name": name, "parts": {"character": study}})

    def _job(self, client: httpx.Client) -> httpx.Response:
        job = {"kind": "add", "params": {"a": next(self._numbers), "b": 1}, "cache": "off"}
        return client.post("/projects/load/jobs", json=job)

    def _events(self, client: httpx.Client) -> httpx.Response:
        answer = client.get("/projects/load/events", params={"after": self._seen})
        if answer.status_code == 200 and (found := answer.json()["items"]):
            self._seen = found[-1]["seq"]
        return answer


# -- what is measured meanwhile ---------------------------------------------------------------------------------------


@contextmanager
def _measuring(made: Installation, house: House, lease: dict[str, Any], record: Record) -> Iterator[None]:
    """Send heartbeats of an attempt and read the memory of the servers while the `with` block runs."""
    stopping = threading.Event()
    threads = [
        threading.Thread(target=_send_heartbeats, args=(house, lease, record, stopping)),
        threading.Thread(target=_read_memory, args=(made, record, stopping)),
    ]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stopping.set()
        for thread in threads:
            thread.join(60)


def _send_heartbeats(house: House, lease: dict[str, Any], record: Record, stopping: threading.Event) -> None:
    path = f"/jobs/{lease['job']}/attempts/{lease['fence']}/heartbeat"
    with house.people.client(lease["attempt_token"]) as client:
        while not stopping.wait(HEARTBEAT_S):
            begun = time.monotonic()
            answer = client.post(path, json={})
            record.waits_s["heartbeat"].append(time.monotonic() - begun)
            if answer.status_code != 200:
                record.faults[f"heartbeat: {answer.status_code}"] += 1


def _read_memory(made: Installation, record: Record, stopping: threading.Event) -> None:
    costs = {server.log.parent.name: ProcessCost(server.process.pid) for server in made.servers if server.process}
    begun = time.monotonic()
    while not stopping.wait(SAMPLE_EVERY_S):
        for name, cost in costs.items():
            at = time.monotonic() - begun
            record.memory[name].append((at, cost.proportional_mb()))
            record.memory[f"{name} without its children"].append((at, cost.own_resident_mb()))


def _growth(samples: list[tuple[float, float]]) -> Growth:
    times = np.array([at for at, _ in samples])
    settled = min(SETTLING_S, times[-1] / 3)
    return growth_of(times[times > settled], np.array([mb for _, mb in samples])[times > settled])


def _beyond(trial: LoadTrial, record: Record, growths: dict[str, Growth]) -> list[str]:
    """Return the limits that were exceeded."""
    p99_ms = {sort: 1e3 * percentile(record.waits_s[sort], 99) for sort in ("read", "list")}
    found = [
        f"{sort}: the 99th percentile is {ms:.0f} ms, more than {trial.most_read_ms:.0f} ms"
        for sort, ms in p99_ms.items()
        if ms > trial.most_read_ms
    ]
    if (longest := max(record.waits_s["heartbeat"], default=0.0)) > LEASE_S - HEARTBEAT_S:
        found.append(f"a heartbeat took {longest:.1f} s, so that the lease may have ended")
    for name, growth in growths.items():
        if 60 * trial.minutes >= 2 * SETTLING_S and growth.low_mb_h > trial.most_growth_mb_h:
            found.append(f"the memory of {name} grows by at least {growth.low_mb_h:.0f} MB/h")
    return found


def _print(record: Record, growths: dict[str, Growth], say: Say) -> None:
    say(f"{'sort':10} {'answers':>8} {'median ms':>10} {'p99 ms':>10} {'longest ms':>11} {'errors':>7}")
    for sort, waits_s in sorted(record.waits_s.items()):
        errors = sum(count for what, count in record.faults.items() if what.startswith(f"{sort}:"))
        figures = [1e3 * percentile(waits_s, percent) for percent in (50, 99, 100)]
        say(f"{sort:10} {len(waits_s):8} {figures[0]:10.1f} {figures[1]:10.1f} {figures[2]:11.1f} {errors:7}")
    for name, growth in growths.items():
        say(f"{name}: {growth}")
