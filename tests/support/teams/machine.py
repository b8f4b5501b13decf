"""State machine of several users who change datasets on two servers at random."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any, ClassVar, cast

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from tests.support.teams.choices import Chooser, some_dataset
from tests.support.teams.combining import Combine, Merge
from tests.support.teams.contents import Content, Hierarchy
from tests.support.teams.item_operations import CreateItem, DeleteItem, Purge
from tests.support.teams.model import ROLES
from tests.support.teams.operations import CommitChanges, CreateRef, Operation, Outcome, Refused, Reset
from tests.support.teams.role_operations import SetFolderRole, SetRole
from tests.support.teams.transfers import CheckOut
from tests.support.teams.world import FINE, LABS, Fate, Session, World

from marey_schemas.access import Role
from marey_schemas.datasets.commits import PutEntry
from marey_schemas.datasets.merges import Side
from marey_schemas.datasets.naming import RefKind
from marey_schemas.kinds import Kind
from marey_server.store.fsck import check_store

WEIGHTS = {
    "create_clip": 4, "upload_file": 3, "annotate": 4, "revise": 6, "rename": 2, "delete_item": 4, "restore_item": 2,
    "purge_item": 3, "purge_all": 1, "commit": 14, "commit_folder": 4, "check_out": 2, "create_branch": 4,
    "create_tag": 2, "delete_ref": 1, "reset": 2, "merge": 10, "revert": 5, "cherry_pick": 5, "copy": 5, "archive": 2,
}  # fmt: skip
"""Kinds of operations of one user, and the relative frequency with which each is chosen."""
USERS = ("mia", "mia", "mia", "ann", "ann", "ben", "ben", "rea")
MAINTAINERS = ("mia", "ann")
NEEDS_ROLE = {
    **dict.fromkeys(("purge_item", "purge_all"), ("ann",)),
    **dict.fromkeys(
        ("delete_item", "restore_item", "check_out", "delete_ref", "reset", "copy", "archive"), MAINTAINERS
    ),
}
"""Users who are allowed to do operations for which the role contributor is not enough, by kind of operation.

Mostly, one of these users is chosen for such an operation.
"""
MOST_STEPS, MOST_STEPS_OF_COPIES = 80, 600
"""Greatest number of steps after which a server dies. Most requests take fewer steps; a copy takes many requests."""


class Diverged(AssertionError):
    """A server has not done what the model expects."""


class TeamsMachine(RuleBasedStateMachine):
    """Users who change items and versions in a project that exists on two servers.

    Hypothesis draws only one number for each step, as the seed of all random choices in the step. This gives programs
    with more kinds of operations.
    """

    only: ClassVar[tuple[str, ...]] = ()
    """Names of the kinds of steps to take; empty: all."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self.world = world
        self.session = Session(world, world.new_project())
        self.serial = 0
        self.diverged = False
        for lab in LABS:
            self.session.clients["ann"].project(lab).datasets.create("gaits", collection="gaits")
            self.session.model.projects[lab].datasets["gaits"] = some_dataset()
            self._begin(lab)

    def _begin(self, lab: str) -> None:
        """Create a skeleton, a clip and an annotation; on one server, also commit these items to two branches."""
        rig = Content.of(Kind.SKELETON, {"hierarchy": Hierarchy(64)})
        self.session.do(CreateItem(lab, "rig", "rigs", rig), "ben")
        choose = Chooser(random.Random(0), self.session.model, lab, "ben", 0)
        for kind in ("create_clip", "annotate"):
            operation = choose.operation(kind)
            assert operation is not None
            self.session.do(operation, "ben")
        if lab == LABS[0]:
            first = self.session.do(choose.first_commit(), "ben")
            self.session.do(CreateRef(lab, "gaits", "x", RefKind.BRANCH, first.digest), "ben")

    @rule(seed=st.integers(0, 2**32 - 1))
    def step(self, seed: int) -> None:
        self.serial += 1
        chance = random.Random(f"{self.serial} {seed}")
        lab = chance.choice((LABS[0], *LABS))
        try:
            self._take(Chooser(chance, self.session.model, lab, chance.choice(USERS), self.serial), chance)
            for one in LABS:
                self.session.comparison(one).refs()
        except Exception as error:
            self.diverged = True
            self.world.divergences.append(f"{error!r}")
            raise Diverged(f"{error!r}\nafter:\n{self.session.history}") from error

    def _take(self, choose: Chooser, chance: random.Random) -> None:
        special = {
            "race": 8,
            "demote": 3,
            "restrict": 3,
            "look": 4,
            "repeat": 2,
            "collect_garbage": 3,
            "work_in_folder": 3,
        }
        weights = {name: weight for name, weight in (WEIGHTS | special).items() if not self.only or name in self.only}
        kind = chance.choices(list(weights), list(weights.values()))[0]
        if kind in special:
            getattr(self, f"_{kind}")(choose, chance)
            return
        if kind in NEEDS_ROLE and chance.random() < 0.9:
            choose.user = chance.choice(NEEDS_ROLE[kind])
        operation = choose.operation(kind)
        if isinstance(operation, Combine):
            self._combine(operation, choose.user, chance)
        elif operation is not None:
            self._do(operation, choose.user, chance)

    def _do(self, operation: Operation, who: str, chance: random.Random) -> Outcome:
        outcome = self.session.do(operation, who, _fate(chance))
        if isinstance(operation, Purge) and not isinstance(outcome, Refused):
            self.session.comparison(operation.lab).contents_are_there()
        if isinstance(operation, CommitChanges | Combine) and not isinstance(outcome, Refused):
            self.session.done = [*self.session.done[-5:], (operation, who, outcome)]
            if chance.random() < 0.3:
                self.session.repeat(operation, who, outcome)
        return outcome

    def _combine(self, operation: Combine, who: str, chance: random.Random) -> None:
        """Preview a merge, then do the merge, with or without resolutions of its conflicts."""
        preview = self.session.do(replace(operation, preview=True), who)
        chosen: dict[tuple[str, Kind], Side] = {}
        if chance.random() < 0.7 and not isinstance(preview, Refused):
            chosen = {(one.path, one.kind): chance.choice(list(Side)) for one in preview.conflicts}
        self._do(replace(operation, resolutions=chosen), who, chance)

    def _repeat(self, _choose: Chooser, chance: random.Random) -> None:
        if self.session.done:
            self.session.repeat(*chance.choice(self.session.done))

    def _work_in_folder(self, choose: Chooser, chance: random.Random) -> None:
        """Check out a branch, change items in the folder, and commit the folder."""
        dataset = choose.project.datasets["gaits"]
        heads = [(name, head) for name, head in dataset.refs.items() if head is not None and name not in dataset.tags]
        if not heads:
            return
        branch, head = chance.choice(heads)
        self._do(CheckOut(choose.lab, "gaits", head, True), "ann", chance)
        choose.user = "ben"
        for kind in chance.sample(("create_clip", "annotate", "revise", "rename"), 2):
            operation = choose.operation(kind)
            if operation is not None:
                self._do(operation, "ben", chance)
        self._do(CommitChanges(choose.lab, "gaits", branch, None), "ben", chance)

    def _collect_garbage(self, choose: Chooser, chance: random.Random) -> None:
        self.session.collect_garbage(choose.lab, a_day_later=chance.random() < 0.3)

    def _look(self, choose: Chooser, chance: random.Random) -> None:
        comparison = self.session.comparison(choose.lab)
        comparison.items()
        for name, dataset in choose.project.datasets.items():
            if dataset.commits:
                at, before = (chance.choice(self.session.model.in_order(dataset.commits)) for _ in range(2))
                comparison.version(name, at)
                comparison.difference(name, before, at)
                state = self.session.model.state(at)
                comparison.documents({Content(key[1], one.parts) for key, one in state.items()})
        self.world.counts["Look"] += 1

    def _race(self, choose: Chooser, chance: random.Random) -> None:
        """Let two users change a branch at once, or let one user delete or purge an item that another user commits."""
        mine = choose.commit(right=True)
        if mine is None:
            return
        kind = chance.choice(("commit", "commit", "merge", "reset", "removal"))
        other: Operation | None = choose.commit_to(mine.name, mine.branch, right=True)
        known = self.session.model.in_order(choose.project.datasets[mine.name].commits)
        if kind == "removal":
            other = _removal(choose, mine)
        elif known and kind == "merge":
            other = Merge(choose.lab, mine.name, mine.branch, chance.choice(known))
        elif known and kind == "reset":
            other = Reset(choose.lab, mine.name, mine.branch, chance.choice(known))
        if other is not None:
            self.session.race({"ben": mine, "ann": other}, _without_loss(_fate(chance)))

    def _demote(self, choose: Chooser, chance: random.Random) -> None:
        """Let an owner make another owner a reader while the second owner writes; then restore the role."""
        choose.user = "mia"
        operation = choose.operation(chance.choice(("commit", "reset", "delete_ref", "purge_item", "create_clip")))
        if operation is None:
            return
        self.session.do(SetRole(choose.lab, "mia", Role.OWNER), "ann")
        self.session.race({"mia": operation, "ann": SetRole(choose.lab, "mia", Role.READER)})
        self._do(operation, "mia", chance)
        self.session.do(SetRole(choose.lab, "mia", ROLES["mia"]), "ann")

    def _restrict(self, choose: Chooser, chance: random.Random) -> None:
        """Change the role of a member in a folder while the member creates items there; then remove this role."""
        choose.user, to = chance.choice((("ben", Role.READER), ("rea", Role.CONTRIBUTOR)))
        operation = choose.create_clip()
        if not isinstance(operation, CreateItem):
            return
        self.session.race({choose.user: operation, "ann": SetFolderRole(choose.lab, choose.user, "gaits", to)})
        another = choose.create_clip()
        if another is not None:
            self._do(another, choose.user, chance)
        self.session.do(SetFolderRole(choose.lab, choose.user, "gaits", None), "ann")

    def teardown(self) -> None:
        if self.diverged:
            return
        for lab in LABS:
            self.session.comparison(lab).everything()
            findings = list(check_store(self.world.hosts[lab].database))
            assert not findings, "\n".join(map(str, findings))


def _fate(chance: random.Random) -> Fate:
    drawn = chance.random()
    if drawn < 0.6:
        return FINE
    if drawn < 0.75:
        return Fate(lost=chance.randint(1, 2))
    return Fate(dies_after=chance.randint(1, MOST_STEPS if drawn < 0.95 else MOST_STEPS_OF_COPIES))


def _without_loss(fate: Fate) -> Fate:
    """Return `FINE` in place of a fate that loses answers, and any other fate unchanged."""
    return FINE if fate.lost else fate


def _removal(choose: Chooser, commit: CommitChanges) -> Operation | None:
    """Return the deletion of an item that a commit adds to a version; if the item is deleted already, its purge."""
    for one in commit.changes or ():
        if isinstance(one, PutEntry):
            item = choose.project.items[one.item]
            if item.status == "present":
                return DeleteItem(choose.lab, item.id, item.kind)
            return Purge(choose.lab, item.id)
    return None


def run_programs(world: World, count: int, length: int, only: tuple[str, ...] = ()) -> None:
    """Run random programs of some number of steps each; the first divergence ends the test."""

    class Machine(TeamsMachine):
        pass

    Machine.only = only
    run_state_machine_as_test(
        cast(Any, lambda: Machine(world)),
        settings=settings(
            max_examples=count, stateful_step_count=length, deadline=None, print_blob=False, report_multiple_bugs=False,
            suppress_health_check=list(HealthCheck), phases=[Phase.explicit, Phase.generate],
        ),
    )  # fmt: skip
