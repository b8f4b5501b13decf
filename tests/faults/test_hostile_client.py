"""Attacks on every route by every kind of caller: the server refuses all attacks, keeps running and changes nothing."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select
from tests.support import hostile_client
from tests.support.furnished_house import House, build_house
from tests.support.hostile_client import ATTACKED, Outcome, fire_all, shots, some
from tests.support.process_cost import ProcessCost
from tests.support.rest_server import People, running
from tests.support.server_process import ServerProcess
from tests.support.tiers import is_soak
from tests.support.who_may import PEOPLE

from marey_schemas.encoding import codecs
from marey_server.access import roles
from marey_server.store.database.connections import Database
from marey_server.store.tables import metadata

pytestmark = pytest.mark.timeout(3600)

SEED = 20261123
SHOTS = 5_000 if is_soak() else 250
OUTSIDERS = tuple(
    person.name for person in PEOPLE.values() if person.rank < 0 and person.standing not in ("attempt", "participant")
)
MOST_MB = 1_200
"""Most memory of the server with its children: twice the real limit, so that the test passes on a busy machine."""
OWN_BUSINESS = {"leader", "server_state", "event", "sign_in_limit"}
"""Tables that the server changes by itself, or to count failed sign-ins."""


@dataclass
class Attacked:
    """A server with users, a project and jobs, in a separate process."""

    process: ServerProcess
    house: House
    cost: ProcessCost

    def faults(self, outcomes: Iterable[Outcome]) -> list[str]:
        """Return a text for each outcome that has a fault, with the last lines of the server's log."""
        log = self.process.log.read_text()[-5000:]
        return [f"{one.fault}; the server's log: {log}" for one in outcomes if one.fault]

    def fingerprint(self) -> dict[str, str]:
        """Return a digest of the rows of each table, except the tables in `OWN_BUSINESS`."""
        found = {}
        engine = self.house.people.database.engine
        with engine.connect() as connection:
            for table in metadata.sorted_tables:
                columns = [column for column in table.columns if column.name != "last_used_us"]
                rows = sorted(map(repr, connection.execute(select(*columns))))
                found[table.name] = hashlib.sha256("\n".join(rows).encode()).hexdigest()
        return {name: digest for name, digest in found.items() if name not in OWN_BUSINESS}


@pytest.fixture
def attacked(tmp_path: Path, database_url: str) -> Iterator[Attacked]:
    """A server with users, a project and jobs in a separate process, on SQLite and on Postgres."""
    process = ServerProcess(tmp_path, database_url, **ATTACKED)
    process.own_children = True  # forked children would count the memory that they share several times
    process.start()
    database = Database(database_url)
    people = People(process.url, database)
    try:
        assert process.process is not None
        yield Attacked(process, build_house(people), ProcessCost(process.process.pid))
        assert process.stop() == 0, process.log.read_text()[-3000:]
    finally:
        process.stop()
        people.close()
        database.close()


def test_a_hostile_client_is_refused_and_changes_nothing_and_the_server_stays_well(attacked: Attacked) -> None:
    every = some(shots(attacked.house), SHOTS, SEED)
    refused = [shot for shot in every if shot.refusal]
    before = attacked.fingerprint()
    outcomes = asyncio.run(fire_all(attacked.process.url, refused, 8))
    assert attacked.faults(outcomes) == []
    assert attacked.fingerprint() == before

    accepted = [shot for shot in every if not shot.refusal]
    outcomes = asyncio.run(fire_all(attacked.process.url, accepted, 8))
    assert attacked.faults(outcomes) == []
    assert accepted
    assert refused
    assert attacked.cost.peak_mb() < MOST_MB
    people = attacked.house.people  # whose own tokens may have ended, because signing out is one of the requests
    newcomer = people.client(people.make_user("newcomer", administrator=True))
    assert newcomer.get("/projects/lab").status_code == 200


@pytest.mark.soak
def test_two_hundred_hostile_connections_leave_no_fault(attacked: Attacked) -> None:
    outsiders = [shot for shot in shots(attacked.house, OUTSIDERS) if shot.refusal]
    outcomes = asyncio.run(fire_all(attacked.process.url, some(outsiders, SHOTS, SEED), 200))
    assert attacked.faults(outcomes) == []
    assert attacked.cost.peak_mb() < MOST_MB


def _every_role_is_enough(_role: Any, _required: Any) -> bool:
    return True


def _no_body_can_be_read(*_body: Any, **_limits: Any) -> Any:
    raise KeyError("a mistake in a decoder")


def _bodies_take_long(*_body: Any, **_limits: Any) -> Any:
    time.sleep(1.0)
    return {}


HOLES: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "every member may do everything": (roles, "includes", _every_role_is_enough),
    "a decoder fails": (codecs, "decode_tree", _no_body_can_be_read),
    "a decoder takes long": (codecs, "decode_tree", _bodies_take_long),
}


@pytest.mark.soak
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("hole", HOLES)
def test_a_planted_hole_is_found(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hole: str
) -> None:
    monkeypatch.setattr(hostile_client, "HANGS_S", 0.5 if hole == "a decoder takes long" else hostile_client.HANGS_S)
    with running(database, tmp_path, body_timeout_s=5.0, header_timeout_s=5.0) as server:
        every = some(shots(build_house(server), ("reader",)), 1_000, SEED)
        monkeypatch.setattr(*HOLES[hole])
        outcomes = asyncio.run(fire_all(server.address, every, 8))
    assert any(one.fault for one in outcomes)
