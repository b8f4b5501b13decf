"""Random actions of several users on proposals, compared with a model in memory of the rules of branches."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from tests.support.store_fixtures import WRITE, Lab
from tests.support.tiers import examples

from marey_schemas.access import MemberChange, Role
from marey_schemas.datasets.commits import CommitCreate, PutEntry
from marey_schemas.datasets.naming import MAIN, DatasetCreate, RefCreate, RefKind, RefMove
from marey_schemas.datasets.proposal_states import CheckState, Verdict
from marey_schemas.datasets.proposals import CheckReport, ProposalCreate, ProposalMerge, ReviewCreate
from marey_schemas.datasets.protection import ProtectionRule
from marey_server.errors import ApiProblem
from marey_server.store import datasets, fsck, members
from marey_server.store.database.connections import Database
from marey_server.store.datasets import proposals

RANKS = {role: rank for rank, role in enumerate(Role)}
ROLES = {"ann": Role.CONTRIBUTOR, "ben": Role.CONTRIBUTOR, "mia": Role.MAINTAINER}
BRANCHES = ("trial", "other")
VERDICTS = (Verdict.APPROVE, Verdict.APPROVE, *Verdict)
STATES = (CheckState.SUCCEEDED, *CheckState)
UNMERGEABLE = {"already-merged", "several-bases"}
"""Codes of refusals that depend only on the history of commits, which the model does not know."""

STEPS = 400
"""Number of steps of each program."""


@dataclass
class Model:
    """Expected state of a proposal."""

    author: str
    source: str
    state: str = "open"
    verdicts: dict[str, tuple[Verdict, str]] = field(default_factory=dict)
    """Newest approval or request for changes of each user, and the commit that was reviewed."""
    checks: dict[str, CheckState] = field(default_factory=dict)
    """State of the check by commit."""
    waiting: tuple[str, str] | None = None
    """User for whom the proposal is merged as soon as possible, and the commit to merge; None if no merge waits."""

    def lacks_nothing(self, head: str, rule: ProtectionRule | None) -> bool:
        if any(verdict is Verdict.REQUEST_CHANGES for verdict, _ in self.verdicts.values()):
            return False
        approved = [who for who, one in self.verdicts.items() if one == (Verdict.APPROVE, head) and who != self.author]
        if rule is None:
            return True
        checked = not rule.checks or self.checks.get(head) is CheckState.SUCCEEDED
        return len(approved) >= rule.approvals and checked


class Program:
    """Random steps of several users; every step makes the same change in the store and in the model.

    `main` moves only as the model allows.
    """

    def __init__(self, database: Database, seed: int) -> None:
        self.chance = random.Random(seed)
        self.lab = Lab(database, f"lab{seed}")
        self.users = {name: self.lab.sign_up(f"{name}-{seed}") for name in ROLES}
        for name, role in ROLES.items():
            user = str(self.users[name].user_name)
            self.lab.write(members.put_member, self.lab.name, user, MemberChange(role=role))
        self.gaits = (self.lab.name, "gaits")
        self.lab.write(datasets.create_dataset, self.lab.name, DatasetCreate(name="gaits"))
        self.item = self.lab.add_skeleton("rig").id
        self.commits = 0
        self.rule: ProtectionRule | None = None
        self.models: dict[int, Model] = {}
        assert self.commit("mia", MAIN) is None
        for branch in BRANCHES:
            self.lab.write(datasets.create_ref, *self.gaits, RefCreate(name=branch, kind=RefKind.BRANCH))
        self.set_rule(ProtectionRule(approvals=1))
        self.open_proposal("ann")

    def run(self) -> None:
        often = (self.review, self.review, self.merge, self.merge, self.check, self.open_proposal)
        seldom = (self.commit_somewhere, self.change_rule, self.reset, self.close, self.delete)
        for _ in range(STEPS):
            act = self.chance.choice((*often, *often, *often, *seldom))
            act(self.chance.choice(sorted(ROLES)))

    def attempt(self, who: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> str | None:
        """Run a write as the user `who`; return the code of its error, or None if it succeeds."""
        try:
            self.lab.write(function, *self.gaits, *args, who=self.users[who], **kwargs)
        except ApiProblem as error:
            return error.error_code
        return None

    def look_up(self, who: str, function: Callable[..., Any], *args: Any) -> Any:
        return self.lab.read(function, *self.gaits, *args, who=self.users[who], required=WRITE)

    def head(self, branch: str) -> str:
        commit: str = self.lab.read(datasets.read_ref, *self.gaits, branch).commit
        return commit

    def commit(self, who: str, branch: str) -> str | None:
        self.commits += 1
        change = PutEntry(path=f"{branch}-{self.commits}", item=self.item)
        request = CommitCreate(branch=branch, message="m", changes=(change,))
        return self.attempt(who, datasets.record_commit, self.look_up(who, datasets.prepare_commit, request))

    def may_move(self, who: str, *, directly: bool) -> bool:
        allowed = self.rule is None or RANKS[ROLES[who]] >= RANKS[self.rule.role]
        return allowed and (not directly or self.rule is None or self.rule.direct_commits)

    def choose(self) -> tuple[int, Model]:
        """Choose a proposal, mostly an open one; return its number and its expected state."""
        still_open = [number for number, one in self.models.items() if one.state == "open"]
        number = self.chance.choice(still_open * 8 + [max(self.models)])
        return number, self.models[number]

    def commit_somewhere(self, who: str) -> None:
        branch = self.chance.choice((MAIN, *BRANCHES))
        allowed = branch != MAIN or self.may_move(who, directly=True)
        assert self.commit(who, branch) == (None if allowed else "branch-protected")

    def change_rule(self, _who: str) -> None:
        strict = ProtectionRule(
            role=self.chance.choice([Role.CONTRIBUTOR, Role.CONTRIBUTOR, Role.MAINTAINER]),
            approvals=self.chance.choice([1, 1, 0, 2]),
            checks=self.chance.choice([(), (), ("c",)]),
            up_to_date=self.chance.random() < 0.2,
        )
        self.set_rule(
            self.chance.choice([None, ProtectionRule(role=Role.MAINTAINER, direct_commits=True), *[strict] * 4])
        )

    def set_rule(self, new: ProtectionRule | None) -> None:
        assert self.attempt("mia", datasets.protect_branch, MAIN, new, expected_rev=None) is None
        self.rule = new

    def reset(self, _who: str) -> None:
        branch = self.chance.choice((MAIN, *BRANCHES))
        refused = branch == MAIN and self.rule is not None
        code = self.attempt("mia", datasets.move_branch, branch, RefMove(at="trial"), expected_rev=None)
        assert code == ("branch-protected" if refused else None)

    def open_proposal(self, who: str) -> None:
        """Commit to a branch and propose this branch, unless there are several open proposals."""
        if sum(one.state == "open" for one in self.models.values()) < 2:
            source = self.chance.choice(BRANCHES)
            assert self.commit(who, source) is None
            assert self.attempt(who, proposals.open_proposal, ProposalCreate(title="t", source=source)) is None
            self.models[len(self.models) + 1] = Model(who, source)

    def review(self, who: str) -> None:
        number, one = self.choose()
        verdict, head = self.chance.choice(VERDICTS), self.head(one.source)

        def note() -> None:
            if verdict is not Verdict.COMMENT:
                one.verdicts[who] = verdict, head

        self.settle(who, number, proposals.add_review, ReviewCreate(verdict=verdict), note)

    def check(self, who: str) -> None:
        number, one = self.choose()
        state, head = self.chance.choice(STATES), self.head(one.source)
        report = CheckReport(name="c", state=state)
        self.settle(who, number, proposals.report_check, report, lambda: one.checks.__setitem__(head, state))

    def settle(self, who: str, number: int, act: Any, request: Any, note: Callable[[], None]) -> None:
        """Send a review or a check, which may merge a proposal that waits to be merged."""
        one, before = self.models[number], self.head(MAIN)
        prepared = self.look_up(who, proposals.prepare_waiting, number)
        code = self.attempt(who, act, number, request, prepared)
        assert code == (None if one.state == "open" else f"proposal-{one.state}")
        if code is None:
            note()
            head = self.head(one.source)
            waits = one.waiting is not None and one.waiting[1] == head and self.may_move(one.waiting[0], directly=False)
            self.compare(number, before, waits and one.lacks_nothing(head, self.rule))

    def merge(self, who: str) -> None:
        number, one = self.choose()
        before, request = self.head(MAIN), ProposalMerge(when_green=self.chance.random() < 0.5)
        prepared = self.look_up(who, proposals.prepare_acceptance, number, request)
        code = self.attempt(who, proposals.merge_proposal, number, request, prepared)
        if one.state != "open":
            assert code == f"proposal-{one.state}"
        elif not self.may_move(who, directly=False):
            assert code == "branch-protected"
        else:
            ready = one.lacks_nothing(self.head(one.source), self.rule)
            assert code is None or (not request.when_green and (not ready or self.is_impossible(prepared)))
            if code is None and self.lab.read(proposals.read_proposal, *self.gaits, number).state == "open":
                one.waiting = who, self.head(one.source)
            self.compare(number, before, ready)

    def is_impossible(self, prepared: Any) -> bool:
        """Return whether two versions cannot be merged because of their history."""
        if prepared.merge is None:
            return prepared.refusal.error_code in UNMERGEABLE
        old = prepared.merge.answer.base != prepared.merge.answer.ours
        return old and self.rule is not None and self.rule.up_to_date

    def compare(self, number: int, before: str, ready: bool) -> None:
        """Check that a proposal was merged only if the model allows it, and that only this merge moved `main`."""
        one, found = self.models[number], self.lab.read(proposals.read_proposal, *self.gaits, number)
        merged = found.state == "merged"
        assert ready or not merged
        assert (self.head(MAIN) != before) == merged
        if merged:
            assert (found.merged, found.target_commit) == (self.head(MAIN), before)
            assert self.rule is None or not self.rule.up_to_date or found.merged == found.head
            one.state, one.waiting = "merged", None
        elif ready:
            assert self.is_impossible(self.look_up("mia", proposals.prepare_acceptance, number, ProposalMerge()))

    def close(self, who: str) -> None:
        number, one = self.choose()
        code = self.attempt(who, proposals.close_proposal, number)
        if one.state != "open":
            assert code == f"proposal-{one.state}"
        elif who not in (one.author, "mia"):
            assert code == "not-author"
        else:
            assert code is None
            one.state = "closed"

    def delete(self, _who: str) -> None:
        """Try to delete the source branches of all open proposals; each attempt must be refused."""
        for one in self.models.values():
            if one.state == "open":
                assert self.attempt("mia", datasets.delete_ref, one.source, expected_rev=None) == "proposal-open"


@pytest.mark.soak
def test_main_moves_only_as_its_rule_allows(database: Database) -> None:
    merged = 0
    for seed in range(examples(1)):
        program = Program(database, seed)
        program.run()
        merged += sum(one.state == "merged" for one in program.models.values())
    assert merged > 0
    assert not list(fsck.check_store(database))
