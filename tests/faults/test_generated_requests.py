"""Requests that schemathesis generates from the OpenAPI document, sent for minutes as each kind of caller."""

from __future__ import annotations

import itertools
import random
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.furnished_house import start_attempt
from tests.support.generated_requests import AnyCase, FuzzedServer, fuzzed_server, generate, operations, probes
from tests.support.who_may import PEOPLE

from marey_server.store.database.connections import Database

pytestmark = [pytest.mark.soak, pytest.mark.timeout(7200)]

LONGEST_ANSWER_S = 10.0
AT_ONCE = 3
"""Number of requests that are sent to one operation before requests are sent to the next one."""
MOST_FAULTS = 20
PROBES = list(probes())


@pytest.fixture
def fuzzed(database: Database, tmp_path: Path) -> Iterator[FuzzedServer]:
    """A server with a private project, on SQLite and on Postgres."""
    with fuzzed_server(database, tmp_path) as server:
        yield server


class Round:
    """Generated requests of one caller to all operations, repeated with new seeds until the time is over."""

    def __init__(self, fuzzed: FuzzedServer, caller: str) -> None:
        self._fuzzed = fuzzed
        self._caller = caller
        self._statuses: Counter[int] = Counter()
        self._slowest = 0.0, ""
        self._faults: list[str] = []

    def run(self, seconds: float) -> None:
        """Send requests; fail if an answer contradicts the OpenAPI document or takes too long."""
        end = time.monotonic() + seconds
        for of_seed in itertools.count():
            for label, mode in random.Random(f"{self._caller} {of_seed}").sample(PROBES, len(PROBES)):
                self._restore()
                for requests in self._fuzzed.requests(operations()[label], mode):
                    if time.monotonic() > end or len(self._faults) >= MOST_FAULTS:
                        self._report()
                        return
                    try:
                        generate(requests, AT_ONCE, of_seed, self._send)
                    except Exception as error:
                        self._faults.append(f"{label} {mode.value}, seed {of_seed}: {error!r}"[:4000])

    def _send(self, case: AnyCase) -> None:
        status, took_s = self._fuzzed.send(case, self._caller)
        self._statuses[status] += 1
        self._slowest = max(self._slowest, (took_s, case.operation.label))
        assert took_s < LONGEST_ANSWER_S, f"{case.as_curl_command()} took {took_s:.1f} s"

    def _restore(self) -> None:
        """Restore what earlier requests have deleted or ended, such as the project and the attempts."""
        house = self._fuzzed.house
        if self._caller in ("owner", "administrator"):
            house.people.client(house.tokens["administrator"]).post("/projects/lab/restore")
        if self._caller == "attempt":
            beat = "/jobs/{job}/attempts/{fence}/heartbeat".format(**house.variables)
            if not house.people.client(house.tokens["attempt"]).post(beat, json={}).is_success:
                lease = start_attempt(house.people, house.tokens, house.variables["item"])
                house.tokens["attempt"] = lease["attempt_token"]
                house.variables |= {"job": lease["job"], "fence": str(lease["fence"])}

    def _report(self) -> None:
        took_s, slowest = self._slowest
        statuses = ", ".join(f"{count} with {status}" for status, count in sorted(self._statuses.items()))
        print(f"{self._caller}: {self._statuses.total()} answers, {statuses}; slowest {took_s:.2f} s, {slowest}")
        assert not self._faults, "\n\n".join(self._faults)


@pytest.mark.parametrize("caller", PEOPLE)
def test_no_request_of_a_caller_fails_or_takes_long(fuzzed: FuzzedServer, caller: str, fuzz_minutes: float) -> None:
    Round(fuzzed, caller).run(60 * fuzz_minutes)
