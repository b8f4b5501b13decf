"""Faults of a trial: drawn from a seed before the trial begins, and then injected one after another."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from tests.support.endurance.installation import SERVERS, Installation
from tests.support.server_process import QUICK_LEASES
from tests.support.tcp_proxy import TcpProxy

LEASE_S = float(QUICK_LEASES["MAREY_LEASE_TTL_S"])
CLOCK_S = 3600.0


@dataclass(frozen=True)
class Fault:
    """One fault: when it happens, on which process or connection, and for how long."""

    after_s: float
    """Time since the end of the previous fault, in seconds."""
    name: str
    target: int
    seconds: float

    def __str__(self) -> str:
        return f"{self.name}, number {self.target}, {self.seconds:.1f} s"


def plan(seed: int, seconds: float, every_s: float, names: Collection[str]) -> list[Fault]:
    """Return the faults that fit into `seconds`; equal arguments give equal faults.

    Every kind of fault happens once before any happens twice. `names` are the kinds.
    """
    draw = random.Random(seed)
    found: list[Fault] = []
    waiting: list[str] = []
    spent_s = 0.0
    while spent_s < seconds:
        waiting = waiting or draw.sample(sorted(names), len(names))
        lasts_s = LEASE_S * draw.uniform(1.5, 2.3)
        found.append(Fault(every_s * draw.uniform(0.3, 1.7), waiting.pop(), draw.randrange(1 << 16), lasts_s))
        spent_s += found[-1].after_s + (lasts_s if FAULTS[found[-1].name].lasts else 0.5)
    return found


@dataclass(frozen=True)
class _Injection:
    inject: Callable[[Installation, Fault], None]
    lasts: bool = False
    """Whether the fault lasts `Fault.seconds`."""


def inject(made: Installation, fault: Fault) -> None:
    """Let a fault happen; return when it is over and killed processes run again."""
    FAULTS[fault.name].inject(made, fault)


def _kill_server(made: Installation, fault: Fault) -> None:
    server = made.servers[fault.target % SERVERS]
    server.kill()
    server.start()


def _kill_worker(made: Installation, fault: Fault) -> None:
    worker = made.workers[fault.target % len(made.workers)]
    worker.kill()
    worker.begin()


def _pause_server(made: Installation, fault: Fault) -> None:
    server = made.servers[fault.target % SERVERS]
    server.send(signal.SIGSTOP)
    time.sleep(fault.seconds)
    server.send(signal.SIGCONT)


def _pause_worker(made: Installation, fault: Fault) -> None:
    worker = made.workers[fault.target % len(made.workers)]
    worker.send(signal.SIGSTOP)
    time.sleep(fault.seconds)
    worker.send(signal.SIGCONT)


def _restart_postgres(made: Installation, fault: Fault) -> None:
    made.postgres.stop(signal.SIGINT if fault.target % 2 else signal.SIGQUIT)
    time.sleep(fault.seconds - LEASE_S)
    made.postgres.start()


def _kill_backend(made: Installation, fault: Fault) -> None:
    made.postgres.kill_a_backend(fault.target)


def _stop_storage(made: Installation, fault: Fault) -> None:
    made.s3.stop()
    time.sleep(fault.seconds)
    made.s3.start()


def _pause_storage(made: Installation, fault: Fault) -> None:
    made.s3.send(signal.SIGSTOP)
    time.sleep(fault.seconds)
    made.s3.send(signal.SIGCONT)


def _link(made: Installation, fault: Fault) -> TcpProxy:
    links = [*made.database_links, *(worker.link for worker in made.workers)]
    return links[fault.target % len(links)]


def _cut(made: Installation, fault: Fault) -> None:
    _link(made, fault).cut()


def _silence_requests(made: Installation, fault: Fault) -> None:
    _silence(_link(made, fault), fault, answers=False)


def _silence_answers(made: Installation, fault: Fault) -> None:
    _silence(_link(made, fault), fault, answers=True)


def _silence(link: TcpProxy, fault: Fault, *, answers: bool) -> None:
    """Discard the bytes of one direction; then close the connections, because bytes are missing in them."""
    dropping = link.drop_answers if answers else link.drop_requests
    dropping.set()
    time.sleep(fault.seconds)
    link.cut()
    dropping.clear()
    link.cut()


def _lose_answers(made: Installation, fault: Fault) -> None:
    worker = made.workers[fault.target % len(made.workers)]
    worker.link.lose_answers((b"/complete", b"/leases", b"/outputs")[fault.target // len(made.workers) % 3], 2)


def _move_clock(made: Installation, fault: Fault) -> None:
    """Let the clock of the database jump by an hour, and after a while back to the true time."""
    made.postgres.set_clock(CLOCK_S if fault.target % 2 else -CLOCK_S)
    time.sleep(fault.seconds)
    made.postgres.set_clock(0)


FAULTS: dict[str, _Injection] = {
    "server killed": _Injection(_kill_server),
    "worker killed": _Injection(_kill_worker),
    "server suspended": _Injection(_pause_server, lasts=True),
    "worker suspended": _Injection(_pause_worker, lasts=True),
    "Postgres restarted": _Injection(_restart_postgres),
    "Postgres backend killed": _Injection(_kill_backend),
    "S3 server killed": _Injection(_stop_storage, lasts=True),
    "S3 server suspended": _Injection(_pause_storage, lasts=True),
    "connections cut": _Injection(_cut),
    "requests lost on the way": _Injection(_silence_requests, lasts=True),
    "answers lost on the way": _Injection(_silence_answers, lasts=True),
    "answers of two requests lost": _Injection(_lose_answers),
    "clock of the database moved": _Injection(_move_clock, lasts=True),
}
"""Functions that inject each fault, by its name."""
