"""Two concurrent writes about one proposal or one branch: the second begins before the first has committed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from sqlalchemy import select
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import WRITE, Lab, requiring

from marey_schemas.datasets.commits import CommitCreate, PutEntry
from marey_schemas.datasets.naming import MAIN, DatasetCreate, RefCreate, RefKind
from marey_schemas.datasets.proposal_states import CheckState, Verdict
from marey_schemas.datasets.proposals import CheckReport, ProposalCreate, ProposalMerge, ReviewCreate
from marey_schemas.datasets.protection import ProtectionRule
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import ApiProblem
from marey_server.store import datasets
from marey_server.store.database.connections import Database
from marey_server.store.datasets import committing, proposals
from marey_server.store.datasets.chunks import store_chunks
from marey_server.store.tables import dataset_ref
from marey_server.store.transaction import Transaction

GAITS = ("lab", "gaits")
RULE = ProtectionRule(approvals=1)

Act = Callable[..., Any]


class Team:
    """Users of the dataset `gaits`, with two database connections.

    The branch `trial` has one commit more than `main`.
    """

    def __init__(self, lab: Lab, other: Database) -> None:
        self.lab, self.other = lab, other
        lab.write(datasets.create_dataset, "lab", DatasetCreate(name="gaits"))
        self.commit(MAIN, "a")
        lab.write(datasets.create_ref, *GAITS, RefCreate(name="trial", kind=RefKind.BRANCH))
        self.commit("trial", "b")

    def commit(self, branch: str, name: str) -> None:
        request, prepared = self.prepared_commit(branch, name)
        self.lab.write(request, *prepared)

    def prepared_commit(self, branch: str, name: str) -> tuple[Act, tuple[Any, ...]]:
        """Return the function and arguments of a write that commits a new entry."""
        item = self.lab.add_skeleton(name)
        request = CommitCreate(branch=branch, message=name, changes=(PutEntry(path=name, item=item.id),))
        return datasets.record_commit, (*GAITS, self.lab.read(datasets.prepare_commit, *GAITS, request, required=WRITE))

    def propose(self) -> int:
        request = ProposalCreate(title="t", source="trial")
        number: int = self.lab.write(proposals.open_proposal, *GAITS, request, who=self.lab.maintainer).number
        return number

    def protect(self, rule: ProtectionRule = RULE) -> Act:
        return lambda tx: datasets.protect_branch(tx, *GAITS, MAIN, rule, expected_rev=None)

    def merge(self, number: int, **fields: Any) -> Act:
        """Prepare the merge of a proposal; return a function that records the merge in a transaction."""
        request = ProposalMerge(**fields)
        prepared = self.lab.read(proposals.prepare_acceptance, *GAITS, number, request, required=WRITE)
        return lambda tx: proposals.merge_proposal(tx, *GAITS, number, request, prepared)

    def prepare_waiting(self, number: int) -> Any:
        return self.lab.read(proposals.prepare_waiting, *GAITS, number, required=WRITE)

    def both(self, first: Act, second: Act, who: Principal | None = None) -> tuple[Any, Any]:
        """Interleave two writes; return their results, or the codes of their errors."""
        one = Step(self.lab.database, self.lab.owner, requiring(WRITE, first))
        two = Step(self.other, who or self.lab.owner, requiring(WRITE, second))
        first_done, second_done = interleave(one, two)
        return _code(first_done), _code(second_done)

    @property
    def main(self) -> str | None:
        commit: str | None = self.lab.read(datasets.read_ref, *GAITS, MAIN).commit
        return commit


def _code(outcome: Any) -> Any:
    return outcome.error_code if isinstance(outcome, ApiProblem) else outcome


@pytest.fixture
def team(lab: Lab, open_database: Callable[[], Database]) -> Team:
    return Team(lab, open_database())


on_postgres = pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
pytestmark = pytest.mark.every_database


@on_postgres
def test_a_rule_that_is_set_at_the_same_moment_holds_for_a_merge(team: Team) -> None:
    number, before = team.propose(), team.main
    assert team.both(team.protect(), team.merge(number))[1] == "proposal-not-green"
    assert team.main == before


@on_postgres
def test_an_approval_and_a_check_at_once_merge_a_waiting_proposal(team: Team) -> None:
    team.lab.write(team.protect(ProtectionRule(approvals=1, checks=("c",))))
    number = team.propose()
    team.lab.write(team.merge(number, when_green=True))
    waiting = team.prepare_waiting(number)
    approval, report = ReviewCreate(verdict=Verdict.APPROVE), CheckReport(name="c", state=CheckState.SUCCEEDED)
    team.both(
        lambda tx: proposals.add_review(tx, *GAITS, number, approval, waiting),
        lambda tx: proposals.report_check(tx, *GAITS, number, report, waiting),
    )
    found = team.lab.read(proposals.read_proposal, *GAITS, number)
    assert (found.state, found.merged) == ("merged", team.main)


@on_postgres
def test_a_commit_locks_its_branch_before_it_stores_chunks(team: Team, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commits of jobs take their locks in the same order as commits of users, so that they never form a deadlock."""
    free: list[list[str]] = []

    def store(tx: Transaction, chunks: Mapping[str, bytes]) -> None:
        branch = select(dataset_ref.c.name).where(dataset_ref.c.name == MAIN).with_for_update(skip_locked=True)
        free.append(team.other.write(SYSTEM, lambda other: list(other.execute(branch).scalars())))
        store_chunks(tx, chunks)

    monkeypatch.setattr(committing, "store_chunks", store)
    team.commit(MAIN, "c")
    assert free == [[]]


@pytest.mark.soak
@pytest.mark.parametrize("first", ["merge", "close"])
@pytest.mark.parametrize("second", ["merge", "close"])
def test_of_two_who_end_a_proposal_the_second_is_told_who_was_first(team: Team, first: str, second: str) -> None:
    number = team.propose()
    ends = {"merge": team.merge(number), "close": lambda tx: proposals.close_proposal(tx, *GAITS, number)}
    done, refused = team.both(ends[first], ends[second])
    assert refused == f"proposal-{done.state}"


@pytest.mark.soak
def test_a_rule_that_is_set_at_the_same_moment_holds_for_a_commit(team: Team) -> None:
    record, arguments = team.prepared_commit(MAIN, "c")
    assert team.both(team.protect(), lambda tx: record(tx, *arguments))[1] == "branch-protected"


@pytest.mark.soak
def test_a_branch_is_not_deleted_while_somebody_proposes_it(team: Team) -> None:
    request = ProposalCreate(title="t", source="trial")

    def propose(tx: Any) -> Any:
        return proposals.open_proposal(tx, *GAITS, request)

    def delete(tx: Any) -> Any:
        return datasets.delete_ref(tx, *GAITS, "trial", expected_rev=None)

    assert team.both(propose, delete)[1] == "proposal-open"
    team.lab.write(lambda tx: proposals.close_proposal(tx, *GAITS, 1))
    assert team.both(delete, propose)[1] == "no-version"


@pytest.mark.soak
def test_proposals_that_are_opened_at_once_get_different_numbers(team: Team) -> None:
    request = ProposalCreate(title="t", source="trial")

    def propose(tx: Any) -> Any:
        return proposals.open_proposal(tx, *GAITS, request)

    assert [one.number for one in team.both(propose, propose)] == [1, 2]
