"""Jobs that commit, compared with a model, while users commit, create branches and protect branches."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test
from sqlalchemy import update
from tests.support.committing_desk import CommittingDesk
from tests.support.queue_desk import Desk, document
from tests.support.tiers import examples, steps

from marey_schemas.datasets.commits import PutEntry, RemoveEntry
from marey_schemas.datasets.naming import MAIN, RefCreate, RefKind
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.kinds import Kind
from marey_schemas.queue.worker_protocol import CompleteAnswer, Lease
from marey_server.errors import ApiProblem, ConflictProblem, LeaseLostProblem
from marey_server.store import datasets
from marey_server.store.datasets import output_plans, outputs
from marey_server.store.items.drafts import Draft
from marey_server.store.tables import dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.merging import merge_entries

NAMES = ("a", "b")
BRANCHES = (MAIN, "work")
State = dict[str, int]
"""Number of the content at each path."""

names, branches, numbers = st.sampled_from(NAMES), st.sampled_from(BRANCHES), st.integers(1, 3)
results = st.dictionaries(names, numbers, max_size=2)
which = st.integers(0, 1_000)


@dataclass
class Running:
    """Expected state of a job that an attempt runs."""

    id: str
    lease: Lease
    branch: str
    base: State
    results: State
    replace: bool
    answer: CompleteAnswer | None = None


@dataclass
class Model:
    """Expected branches, as dictionaries."""

    heads: dict[str, State] = field(default_factory=dict)
    commits: dict[str, int] = field(default_factory=dict)
    """Number of commits of each branch."""
    protected: set[str] = field(default_factory=set)
    of_jobs: set[str] = field(default_factory=set)
    """Jobs that made a commit."""

    def complete(self, job: Running) -> str:
        """End a job in the model; return the expected result of its commit, or `failed` if the job must fail."""
        if job.results and job.branch in self.protected:
            return "failed"
        wanted: dict[str, int | None] = dict(job.results)
        if job.replace and job.results:
            wanted |= dict.fromkeys(job.base.keys() - wanted.keys())
        head = self.heads[job.branch]
        clashes = {
            name
            for name, number in wanted.items()
            if head.get(name) not in (job.base.get(name), number) and number != job.base.get(name)
        }
        if clashes:
            self.heads[job.id] = applied(job.base, wanted)
            self.of_jobs.add(job.id)
            return "conflict"
        changed = applied(head, {name: number for name, number in wanted.items() if number != job.base.get(name)})
        if changed == head:
            return "unchanged"
        self.heads[job.branch] = changed
        self.commits[job.branch] += 1
        self.of_jobs.add(job.id)
        return "committed"


def applied(state: State, changes: dict[str, int | None]) -> State:
    """Return a state after changes; the value None removes a path."""
    return {name: number for name, number in {**state, **changes}.items() if number is not None}


class CommittingMachine(RuleBasedStateMachine):
    """Workers and users who change one dataset."""

    serial = itertools.count()

    def __init__(self, desk: Desk) -> None:
        super().__init__()
        self.gaits = CommittingDesk(desk, f"d{next(self.serial)}")
        self.running: list[Running] = []
        self.ended: list[Running] = []
        self.contents: dict[str, tuple[str, int]] = {}
        """Name and number of each content that was seen."""
        for name in NAMES:
            self.put(name, 1, MAIN)
        self.gaits.write(datasets.create_ref, "lab", self.gaits.name, RefCreate(name="work", kind=RefKind.BRANCH))
        first = dict.fromkeys(NAMES, 1)
        self.model = Model({MAIN: first, "work": first}, {MAIN: len(NAMES), "work": len(NAMES)})

    def put(self, name: str, number: int, branch: str) -> None:
        draft = Draft("d", Kind.CHARACTER, f"{name}{number}", {"character": document(name=name, number=number)}, "own")
        (made,) = self.gaits.desk.publish(draft)
        self.gaits.change(PutEntry(path=f"made/{name}", item=made.item), branch=branch)

    # -- people --------------------------------------------------------------------------------------------------------

    @rule(name=names, number=st.none() | numbers, branch=branches)
    def commit(self, name: str, number: int | None, branch: str) -> None:
        head = self.model.heads[branch]
        if branch in self.model.protected or head.get(name) == number:
            return
        if number is None:
            self.gaits.change(RemoveEntry(path=f"made/{name}", kind=Kind.CHARACTER), branch=branch)
        else:
            self.put(name, number, branch)
        self.model.heads[branch] = applied(head, {name: number})
        self.model.commits[branch] += 1

    @rule(branch=branches)
    def protect_or_not(self, branch: str) -> None:
        rule_of = None if branch in self.model.protected else ProtectionRule(direct_commits=False)
        self.gaits.write(datasets.protect_branch, "lab", self.gaits.name, branch, rule_of, expected_rev=None)
        self.model.protected ^= {branch}

    # -- jobs ----------------------------------------------------------------------------------------------------------

    @rule(branch=branches, made=results, replace=st.booleans())
    def submit(self, branch: str, made: State, replace: bool) -> None:
        to = f"{self.gaits.name}@{branch}"
        if branch in self.model.protected:
            with pytest.raises(ConflictProblem):
                self.gaits.submit(to=to, into="made", cache="off")
            return
        job = self.gaits.submit(to=to, into="made", cache="off", commit_replace=replace)
        lease = self.gaits.desk.claim(job=job)
        for name, number in made.items():
            self.gaits.desk.stage(lease, name, facts={"number": number})
        self.running.append(Running(job, lease, branch, dict(self.model.heads[branch]), made, replace))

    @precondition(lambda self: self.running)
    @rule(index=which)
    def complete(self, index: int) -> None:
        job = self.running.pop(index % len(self.running))
        fate = self.model.complete(job)
        job.answer = self.gaits.desk.complete(job.lease, write_id=f"write-{job.id}")
        found = self.gaits.job(job.id)
        assert found.state == ("failed" if fate == "failed" else "succeeded")
        assert (found.publish_conflict is not None) == (fate == "conflict")
        assert found.commit is not None
        assert (found.commit.digest is not None) == (fate in ("committed", "conflict"))
        assert len(self.gaits.desk.outputs(job.id)) == (0 if fate == "failed" else len(job.results))
        self.ended.append(job)

    @rule(branch=branches, name=names, first=numbers, second=numbers)
    def commit_while_a_job_runs(self, branch: str, name: str, first: int, second: int) -> None:
        if branch not in self.model.protected:
            self.submit(branch, {name: first}, replace=False)
            self.commit(name, second, branch)
            self.complete(len(self.running) - 1)

    @precondition(lambda self: self.ended)
    @rule(index=which)
    def repeat_a_completion(self, index: int) -> None:
        job = self.ended[index % len(self.ended)]
        assert self.gaits.desk.complete(job.lease, write_id=f"write-{job.id}") == job.answer

    @precondition(lambda self: self.running)
    @rule(index=which)
    def cancel(self, index: int) -> None:
        job = self.running.pop(index % len(self.running))
        self.gaits.desk.cancel(job.id)
        assert self.gaits.desk.complete(job.lease).state == "cancelled"

    @precondition(lambda self: self.running)
    @rule(index=which)
    def lose_the_lease(self, index: int) -> None:
        """Let an attempt lose its lease; another attempt creates the same results."""
        job = self.running[index % len(self.running)]
        self.gaits.desk.fail(job.lease, interrupted=True)
        with pytest.raises(LeaseLostProblem):
            self.gaits.desk.complete(job.lease)
        job.lease = self.gaits.desk.claim(job=job.id)
        for name, number in job.results.items():
            self.gaits.desk.stage(job.lease, name, facts={"number": number})

    # -- what must hold ------------------------------------------------------------------------------------------------

    @invariant()
    def every_branch_has_the_entries_and_commits_of_the_model(self) -> None:
        """One transaction reads everything, to be fast, because this check runs after each step."""
        self.gaits.read(self._compare)

    def _compare(self, tx: Transaction) -> None:
        place = ("lab", self.gaits.name)
        refs = datasets.list_refs(tx, *place, cursor=None, limit=1000).items
        assert {one.name for one in refs} == self.model.heads.keys()
        for branch, state in self.model.heads.items():
            listed = datasets.list_entries(tx, *place, branch, path="", cursor=None, limit=1000).items
            found = {entry.path.rpartition("/")[2]: entry.parts["character"] for entry in listed}
            assert found.keys() == state.keys()
            for name, content in found.items():
                assert self.contents.setdefault(content, (name, state[name])) == (name, state[name])
        logs = [
            datasets.list_commits(tx, *place, branch, path="", cursor=None, limit=1000).items for branch in BRANCHES
        ]
        assert dict(zip(BRANCHES, map(len, logs), strict=True)) == self.model.commits
        own = [datasets.read_commit(tx, *place, name) for name in self.model.heads.keys() - set(BRANCHES)]
        assert {one.job for one in (*itertools.chain(*logs), *own)} - {None} == self.model.of_jobs


def run(desk: Desk, count: int, length: int) -> None:
    run_state_machine_as_test(
        cast(Any, lambda: CommittingMachine(desk)),
        settings=settings(
            max_examples=count, stateful_step_count=length, deadline=None, print_blob=False, report_multiple_bugs=False,
            suppress_health_check=list(HealthCheck), phases=[Phase.explicit, Phase.generate],
        ),
    )  # fmt: skip


@pytest.mark.every_database
def test_jobs_that_commit_behave_as_their_model(desk: Desk) -> None:
    run(desk, examples(3, soak=6), steps(25))


def overwrite_what_others_changed(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(output_plans, "merge_entries", lambda _others, own, take, _merge: merge_entries([], own, take))


def forget_what_the_job_made(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(output_plans, "merge_entries", lambda others, _own, take, _merge: merge_entries(others, [], take))


def ignore_the_rule(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(outputs, "require_move", lambda _ref, _mover: None)
    patch.setattr(outputs, "move_branch_to", move_unchecked)


def move_unchecked(tx: Transaction, prepared: Any, digest: str, _mover: Any) -> None:
    which_ref = (dataset_ref.c.dataset_id == prepared.dataset_id, dataset_ref.c.name == prepared.branch)
    tx.execute(update(dataset_ref).where(*which_ref).values(digest=digest))


PLANTED = (overwrite_what_others_changed, forget_what_the_job_made, ignore_the_rule)


@pytest.mark.soak  # looks for each fault until it is found, which may take two minutes
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_the_model_finds_planted_faults(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, plant: Callable[[pytest.MonkeyPatch], None]
) -> None:
    plant(monkeypatch)
    with pytest.raises((AssertionError, ApiProblem, pytest.fail.Exception)):
        run(desk, 1000, 50)  # in every tier: it ends with the first program that finds the fault
