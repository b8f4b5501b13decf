"""Two servers with users, and the steps of a program: operations, during which answers get lost or servers die."""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from tests.support.rest_server import People
from tests.support.teams.comparison import Comparison
from tests.support.teams.hosts import Host, Line
from tests.support.teams.model import PARTNER, ROLES, STUDIO, Model
from tests.support.teams.operations import RACED, Clients, Failed, Operation, Outcome, Refused, attempt

from marey_client import Marey
from marey_client.errors import Unreachable
from marey_schemas.access import ProjectCreate, Role
from marey_server.store import garbage

RANKS = {role: rank for rank, role in enumerate(Role)}


class Fate(NamedTuple):
    """Fault during an operation: none, the loss of answers, or the death of a server."""

    lost: int = 0
    """Number of answers to writes that are lost."""
    dies_after: int | None = None
    """Number of steps after which the server dies; None if it does not die."""

    @property
    def label(self) -> str:
        """Name of this fate in logs; empty if nothing happens."""
        return "lost answer" if self.lost else "death" if self.dies_after else ""


FINE = Fate()


class World:
    """Servers, and users who have the same names and roles on each of them."""

    def __init__(self, hosts: Mapping[str, Host]) -> None:
        self.hosts = hosts
        self.counts: Counter[str] = Counter()
        """Number of operations by kind and outcome, of deaths, and of lost answers."""
        self.divergences: list[str] = []
        """Errors of the steps after which a server and the model differed."""
        self._projects = itertools.count()
        self._servers: dict[str, dict[str, Marey]] = {name: {} for name in ROLES}
        self.lines: dict[str, dict[str, Line]] = {name: {} for name in ROLES}
        for lab, host in hosts.items():
            people = People(host.url, host.database)
            for name in ROLES:
                token = people.make_user(name)
                self._servers[name][lab], self.lines[name][lab] = host.client(token)

    def new_project(self) -> dict[str, Clients]:
        """Create a project on both servers, with all users as members; return their clients."""
        project = f"lab{next(self._projects)}"
        for marey in self._servers["ann"].values():
            made = marey.create_project(ProjectCreate(name=project))
            for name, role in ROLES.items():
                if name != "ann":
                    made.members.put(name, role)
        return {name: Clients(name, self._servers[name], project) for name in ROLES}

    def close(self) -> None:
        """Close all connections."""
        for servers in self._servers.values():
            for marey in servers.values():
                marey.close()


@dataclass
class Session:
    """Program of several users in one project."""

    world: World
    clients: Mapping[str, Clients]
    model: Model = field(default_factory=Model)
    done: list[tuple[Operation, str, Outcome]] = field(default_factory=list)
    """Commits and merges that have succeeded, to be repeated."""
    log: list[str] = field(default_factory=list)
    """Operations and their outcomes as text, for messages of failed tests."""

    @property
    def history(self) -> str:
        """The last operations and their outcomes, one per line."""
        return "\n".join(self.log[-40:])

    def comparison(self, lab: str) -> Comparison:
        """Return a comparison of the server `lab` with the model, through the client of the project's owner."""
        return Comparison(self.model, lab, self.clients["ann"])

    def do(self, operation: Operation, who: str, fate: Fate = FINE) -> Outcome:
        """Do an operation and compare its outcome with the model."""
        clients = self.clients[who]
        outcome = self._send(operation, clients, fate)
        self.log.append(f"{who}: {operation} {fate.label} -> {outcome}")
        if _unanswered(outcome) and fate is not FINE:
            return self._do_again(operation, clients)
        self._absorb(self.model, operation, clients, outcome)
        self._count(operation, outcome)
        return outcome

    def _send(self, operation: Operation, clients: Clients, fate: Fate) -> Outcome:
        lines = self.world.lines[clients.user].values()
        for line in lines:
            line.lose = fate.lost
        host = self.world.hosts[operation.labs[(fate.dies_after or 0) % len(operation.labs)]]
        if fate.dies_after is not None:
            host.arm(fate.dies_after)
        outcome = attempt(operation, clients)
        if fate.dies_after is not None and host.disarm():
            self.world.counts["(deaths)"] += 1
        self.world.counts["(lost answers)"] += sum(fate.lost - line.lose for line in lines)
        for line in lines:
            line.lose = 0
        return outcome

    def _do_again(self, operation: Operation, clients: Clients) -> Outcome:
        """Repeat an operation that got no answer; its first run must have had its whole effect or none."""
        self.world.counts["(repeated without knowing)"] += 1
        outcome = attempt(operation, clients)
        self.log.append(f"{clients.user}: repeated -> {outcome}")
        before = self.model.copy()
        try:
            if _may(self.model, operation, clients):
                operation.assume(self.model)
            self._absorb(self.model, operation, clients, outcome)
        except AssertionError:
            self.model = before
            self._absorb(self.model, operation, clients, outcome)
        self._count(operation, outcome)
        return outcome

    def repeat(self, operation: Operation, who: str, first: Outcome) -> None:
        """Send a write again, as after a lost answer; the answer must be the same, and nothing may change."""
        operation.again(first, attempt(operation, self.clients[who]))
        self.world.counts["(repeated writes)"] += 1

    @staticmethod
    def _absorb(model: Model, operation: Operation, clients: Clients, outcome: Outcome) -> None:
        if _may(model, operation, clients):
            operation.absorb(model, clients, outcome)
        else:
            operation.forbidden(model, outcome)

    def _count(self, operation: Operation, outcome: Outcome) -> None:
        code = f" {outcome.code}" if isinstance(outcome, Refused) else ""
        self.world.counts[f"{operation.label}{code}"] += 1

    # -- several at once --------------------------------------------------------------------------------------------

    def race(self, operations: Mapping[str, Operation], fate: Fate = FINE) -> None:
        """Let users do one operation each at the same time.

        The outcomes must be possible for some order of the operations. An operation may also be refused because another
        one came first; it then has no effect.
        """
        host = self.world.hosts[next(iter(operations.values())).lab]
        outcomes: dict[str, Outcome] = {}
        barrier = threading.Barrier(len(operations))

        def run(who: str) -> None:
            barrier.wait()
            outcomes[who] = attempt(operations[who], self.clients[who])

        if fate.dies_after is not None:
            host.arm(fate.dies_after)
        threads = [threading.Thread(target=run, args=(who,)) for who in operations]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if fate.dies_after is not None and host.disarm():
            self.world.counts["(deaths in races)"] += 1
        self.log += [f"at once, {who}: {operations[who]} {fate.label} -> {outcomes.get(who)}" for who in operations]
        self._explain(operations, outcomes)

    def _explain(self, operations: Mapping[str, Operation], outcomes: Mapping[str, Outcome]) -> None:
        """Find an order of the operations that explains all outcomes, and apply the operations to the model."""
        assert outcomes.keys() == operations.keys(), "an operation ended with an unexpected error"
        overtaken = [who for who, one in outcomes.items() if isinstance(one, Refused) and one.code in RACED]
        assert len(overtaken) < len(operations), f"nobody has won: {outcomes}"
        kinds = "+".join(sorted(one.label for one in operations.values()))
        failures = []
        for order in self._orders(operations, outcomes, overtaken):
            model = self.model.copy()
            try:
                for who in order:
                    if _unanswered(outcomes[who]):
                        operations[who].assume(model)
                    else:
                        self._absorb(model, operations[who], self.clients[who], outcomes[who])
                for lab in {one.lab for one in operations.values()}:
                    Comparison(model, lab, self.clients["ann"]).refs()  # answers alone do not always show the order
            except AssertionError as error:
                failures.append(str(error))
            else:
                self.model = model
                self.world.counts[f"race {kinds}{' overtaken' * bool(overtaken)}"] += 1
                return
        raise AssertionError(f"no order of {operations} explains {outcomes}: {failures}")

    @staticmethod
    def _orders(
        operations: Mapping[str, Operation], outcomes: Mapping[str, Outcome], overtaken: Sequence[str]
    ) -> Iterator[tuple[str, ...]]:
        """Yield the orders in which operations can have had effects.

        An operation without an answer may have had no effect.
        """
        certain = [who for who in operations if who not in overtaken and not _unanswered(outcomes[who])]
        uncertain = [who for who in operations if _unanswered(outcomes[who])]
        for count in range(len(uncertain) + 1):
            for some in itertools.combinations(uncertain, count):
                yield from itertools.permutations([*certain, *some])

    # -- housekeeping -----------------------------------------------------------------------------------------------

    def collect_garbage(self, lab: str, *, a_day_later: bool) -> None:
        """Collect garbage while the server runs, now or as if the grace period of all uploads had passed."""
        host = self.world.hosts[lab]
        if a_day_later:
            garbage.collect_garbage(host.database, grace_us=-1)
            self.model.projects[lab].loose_files.clear()
        else:
            garbage.collect_garbage(host.database)
        self.comparison(lab).files(host.database, collected=a_day_later)
        self.log.append(f"collect garbage of {lab}, {a_day_later=}")
        self.world.counts[f"CollectGarbage{' a day later' if a_day_later else ''}"] += 1


def _may(model: Model, operation: Operation, clients: Clients) -> bool:
    """Return whether the user has the role that an operation requires."""
    return RANKS[model.role_of(clients.user, operation.place(model))] >= RANKS[operation.role]


def _unanswered(outcome: Outcome) -> bool:
    return isinstance(outcome, Failed) and isinstance(outcome.error, Unreachable)


LABS = (STUDIO, PARTNER)
