"""Measurement of a server under attack, and of its effects on other clients: `python -m tests.support.hostile_figures`.

Options: `--shots` is the number of requests that are sent one after another to measure their cost, `--seconds` the
duration of the attack over 200 connections (0 for none), `--postgres` measures on a Postgres server that it starts.

`docs/explanation/threat-model.md` lists the goals.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import multiprocessing
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.synchronize import Event
from operator import itemgetter
from pathlib import Path

import httpx
from tests.support.database_fixtures import database_address, new_postgres_database, postgres_server
from tests.support.furnished_house import House, build_house, start_attempt
from tests.support.hostile_client import (
    ATTACKED,
    ENDS_CREDENTIALS,
    SMALL_BYTES,
    Manner,
    Outcome,
    Shot,
    fire,
    fire_all,
    shots,
    some,
)
from tests.support.process_cost import ProcessCost
from tests.support.rest_server import People
from tests.support.server_process import ServerProcess
from tests.support.who_may import PEOPLE

from marey_server.store.database.connections import Database

CONNECTIONS = 200
SEED = 20261123
WORST = 12
STARTING_S = 120.0
"""Longest time in seconds to wait until the children of a new server have loaded their modules."""
_EVERY_S = 0.05
Row = tuple[float, float, Outcome]
"""Processor time in milliseconds and memory in MB that a shot cost, and its outcome."""


class Companion:
    """Well-behaved client that measures how long it waits, in a thread."""

    def __init__(self, name: str, ask: Callable[[], httpx.Response]) -> None:
        self.name = name
        self._ask = ask
        self._waits_s: list[float] = []
        self._refused: list[int] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name)

    def __enter__(self) -> None:
        self._waits_s, self._refused = [], []
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name=self.name)
        self._thread.start()

    def __exit__(self, *_error: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(_EVERY_S):
            start = time.monotonic()
            status = self._ask().status_code
            self._waits_s.append(time.monotonic() - start)
            if status >= 400:
                self._refused.append(status)

    def line(self) -> str:
        """Return the measured waiting times as one line of text."""
        waits_ms = sorted(1e3 * wait for wait in self._waits_s) or [0.0]
        p99 = waits_ms[min(len(waits_ms) - 1, round(0.99 * len(waits_ms)))]
        return (
            f"  {self.name:24} {len(waits_ms):6} answers  median {statistics.median(waits_ms):7.1f} ms  "
            f"p99 {p99:7.1f} ms  longest {waits_ms[-1]:7.1f} ms  refused {len(self._refused)}"
        )


def measure_costs(url: str, every: Sequence[Shot], cost: ProcessCost) -> None:
    """Send malicious requests one after another; print the most expensive ones, and what each costs the second time.

    The first request of a route also pays for what the server builds once, such as the validator of its body.
    """
    rows = [cost_of(url, shot, cost) for shot in every]
    small = [row for row in rows if len(row[2].shot.data) <= SMALL_BYTES]
    print(f"{len(rows)} requests one after another, {len(small)} of them of up to 10 kB; the server: "
          f"{cost.resident_mb():.0f} MB")  # fmt: skip
    for unit, figure in (("ms of processor time", _processor_ms), ("MB more", _more_mb)):
        print(f"  most {unit}, per request of up to 10 kB: the first and the second time")
        for row in sorted(small, key=figure, reverse=True)[:WORST]:
            again = cost_of(url, row[2].shot, cost)
            print(f"    {figure(row):9.1f} {figure(again):9.1f}  {_said(row[2])}", flush=True)


def cost_of(url: str, shot: Shot, cost: ProcessCost) -> Row:
    """Send a malicious request, and return what it cost the server until it was idle again."""
    cost.wait_until_idle()
    cost.reset_peak()
    resident, processor = cost.resident_mb(), cost.processor_s()
    outcome = asyncio.run(fire(url, shot))
    cost.wait_until_idle()
    times = 2 if shot.manner is Manner.TWICE else 6 if shot.manner is Manner.UNREAD else 1
    return 1e3 * (cost.processor_s() - processor) / times, cost.peak_mb() - resident, outcome


_processor_ms: Callable[[Row], float] = itemgetter(0)
_more_mb: Callable[[Row], float] = itemgetter(1)


def _said(outcome: Outcome) -> str:
    return f"{outcome.shot.label} ({len(outcome.shot.data)} bytes): {outcome.status} after {outcome.seconds:.2f} s"


def attack(url: str, every: Sequence[Shot], seconds: float, nice: int, begun: Event) -> None:
    """Send malicious requests over 200 connections for `seconds`; print faults, and how busy this program was."""
    os.nice(nice)
    begun.set()
    start, processor = time.monotonic(), time.process_time()
    deadline = start + seconds
    endless = itertools.takewhile(lambda _shot: time.monotonic() < deadline, itertools.cycle(every))
    outcomes = asyncio.run(fire_all(url, endless, CONNECTIONS))
    counts: dict[int | None, int] = {}
    for outcome in outcomes:
        counts[outcome.status] = counts.get(outcome.status, 0) + 1
    took_s = time.monotonic() - start
    own = (time.process_time() - processor) / took_s
    print(f"{len(outcomes)} hostile requests in {took_s:.0f} s by a program that takes {own:.2f} processors; "
          f"answers by status: {counts}", flush=True)  # fmt: skip
    for outcome in filter(lambda outcome: outcome.fault, outcomes):
        print(f"  FAULT {outcome.fault}", flush=True)


def companions_of(house: House) -> list[Companion]:
    """Return a reader, a worker that sends heartbeats, and a client that requests `/readyz`.

    The reader and the worker have tokens of their own, which no hostile client uses.
    """
    people = house.people
    reader = people.client(people.make_user("visitor"))
    people.client(house.tokens["owner"]).put("/projects/lab/members/visitor", json={"role": "reader"})
    lease = start_attempt(people, house.tokens, house.variables["item"])
    attempt = people.client(lease["attempt_token"])
    asking = httpx.Client(base_url=people.address, timeout=120)
    heartbeat = f"/jobs/{lease['job']}/attempts/{lease['fence']}/heartbeat"
    clip = f"/projects/lab/clips/{house.variables['item']}"
    return [
        Companion("reads a clip", lambda: reader.get(clip)),
        Companion("sends heartbeats", lambda: attempt.post(heartbeat, json={})),
        Companion("asks /readyz", lambda: asking.get("/readyz")),
    ]


def measure_crowd(url: str, house: House, cost: ProcessCost, seconds: float, nice: int) -> None:
    """Print how long well-behaved clients wait, alone and during attacks by 20 users over 200 connections."""
    companions = companions_of(house)
    several = [house]
    for number in range(20 - len(PEOPLE)):
        tokens: dict[str, str | None] = {"stranger": house.people.make_user(f"stranger{number}")}
        several.append(House(house.people, tokens, house.variables))
    hostile = [
        shot
        for one in several
        for shot in some(shots(one, tuple(one.tokens)), 2_000, SEED)
        if not shot.route.endswith(ENDS_CREDENTIALS) and len(shot.data) <= SMALL_BYTES
    ]
    with measuring("alone", companions, cost):
        time.sleep(seconds / 3)
    processes = multiprocessing.get_context("spawn")
    begun = processes.Event()
    crowd = processes.Process(target=attack, args=(url, hostile, seconds, nice, begun))
    crowd.start()
    begun.wait()
    callers = sum(len(one.tokens) for one in several)
    with measuring(f"beside {CONNECTIONS} hostile connections of {callers} callers", companions, cost):
        crowd.join()


@contextlib.contextmanager
def measuring(name: str, companions: Sequence[Companion], cost: ProcessCost) -> Iterator[None]:
    """Print the waiting times of the companions during the `with` block, and the memory of the server."""
    cost.reset_peak()
    start, processor = time.monotonic(), cost.processor_s()
    with companions[0], companions[1], companions[2]:
        yield
    busy = (cost.processor_s() - processor) / (time.monotonic() - start)
    load = os.getloadavg()[0]
    print(f"{name}: peak {cost.own_peak_mb():.0f} MB, with children {cost.peak_mb():.0f} MB; {busy:.2f} processors; "
          f"load of the machine {load:.1f}")  # fmt: skip
    for companion in companions:
        print(companion.line(), flush=True)


@contextlib.contextmanager
def database_of(postgres: bool) -> Iterator[str | None]:
    """Yield the address of a new Postgres database with the usual durability, or None for SQLite."""
    if not postgres:
        yield None
        return
    with postgres_server(durable=True) as server, new_postgres_database(server, "figures") as url:
        yield database_address(url)


def main() -> None:
    """Run all measurements, and print their results."""
    parser = argparse.ArgumentParser(prog="python -m tests.support.hostile_figures")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--shots", type=int, default=1_000)
    parser.add_argument("--nice", type=int, default=0, help="niceness of the hostile program, 0 to 19")
    parser.add_argument("--postgres", action="store_true", help="measure on Postgres instead of SQLite")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, database_of(given.postgres) as address:
        process = ServerProcess(Path(folder), address, **ATTACKED)
        process.own_children = True
        process.start()
        assert process.process is not None
        database = Database(address or f"sqlite:///{process.data / 'marey.db'}")
        try:
            house, cost = build_house(People(process.url, database)), ProcessCost(process.process.pid)
            cost.wait_until_idle(STARTING_S)
            if given.seconds:
                measure_crowd(process.url, house, cost, given.seconds, given.nice)
            if given.shots:
                measure_costs(process.url, some(shots(house), given.shots, SEED), cost)
        finally:
            process.stop()
            database.close()


if __name__ == "__main__":
    main()
