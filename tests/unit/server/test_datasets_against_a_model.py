"""Datasets, compared with a model, under random changes by several users in any order."""

from __future__ import annotations

import itertools
import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from sqlalchemy import update
from tests.support.store_fixtures import Lab, skeleton_tree
from tests.support.tiers import examples, steps

from marey_schemas.datasets.commits import CommitCreate, PutEntry, RemoveEntry
from marey_schemas.datasets.merges import MergeRequest, PickRequest, Resolution, Side
from marey_schemas.datasets.naming import DatasetCreate, RefCreate, RefKind, RefMove
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.errors import ApiProblem, NotFoundProblem
from marey_server.store import datasets, items
from marey_server.store.datasets import committing, merging
from marey_server.store.fsck import check_store
from marey_server.store.tables import dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.merging import merge_entries

PATHS = ("a", "b", "b/c", "d")
REVISIONS = (1, 2, 3)
NAMES = ("main", "x", "y")
State = dict[str, int]
"""Revision of the item at each path; each path has an item of its own, so that nothing ever counts as moved."""

paths, names = st.sampled_from(PATHS), st.sampled_from(NAMES)
revisions = st.none() | st.sampled_from(REVISIONS)
sides = st.none() | st.sampled_from(Side)
numbers = st.integers(0, 1_000)


class Made(NamedTuple):
    """A commit of the model."""

    state: State
    parents: tuple[str, ...]


class Model:
    """Expected commits, branches and tags, as dictionaries."""

    def __init__(self) -> None:
        self.commits: dict[str, Made] = {}
        self.refs: dict[str, str | None] = {"main": None}
        self.tags: set[str] = set()

    def state(self, digest: str | None) -> State:
        return {} if digest is None else self.commits[digest].state

    def ancestors(self, commits: Iterable[str]) -> set[str]:
        """Return these commits and all commits before them."""
        found: set[str] = set()
        waiting = list(commits)
        while waiting:
            one = waiting.pop()
            if one not in found:
                found.add(one)
                waiting += self.commits[one].parents
        return found

    def bases(self, ours: str, theirs: str) -> set[str]:
        """Return the nearest common commits of two commits (the merge bases)."""
        shared = self.ancestors([ours]) & self.ancestors([theirs])
        return shared - self.ancestors(parent for one in shared for parent in self.commits[one].parents)

    def first_parents(self, digest: str) -> list[str]:
        found = [digest]
        while parents := self.commits[found[-1]].parents:
            found.append(parents[0])
        return found

    def origin(self, digest: str, path: str) -> str:
        """Return the commit that last changed the item at a path."""
        made = self.commits[digest]
        for parent in made.parents:
            if self.commits[parent].state.get(path) == made.state[path]:
                return self.origin(parent, path)
        return digest


def merged(base: State, ours: State, theirs: State, take: Side | None) -> tuple[State, set[str]]:
    """Return the three-way merge of three states, and the paths with conflicts."""
    result: dict[str, int | None] = {}
    conflicts = set()
    for path in PATHS:
        before, mine, their = (one.get(path) for one in (base, ours, theirs))
        if mine == their or their == before:
            result[path] = mine
        elif mine == before:
            result[path] = their
        else:
            conflicts.add(path)
            result[path] = {Side.OURS: mine, Side.THEIRS: their, Side.BASE: before, None: mine}[take]
    return {path: number for path, number in result.items() if number is not None}, conflicts


@contextmanager
def refused(*codes: str) -> Iterator[None]:
    """Check that the `with` block raises an error with one of these codes."""
    with pytest.raises(ApiProblem) as caught:
        yield
    assert caught.value.error_code in codes, caught.value.detail


class DatasetMachine(RuleBasedStateMachine):
    """Users who change one dataset."""

    serial = itertools.count()

    def __init__(self, lab: Lab, known: dict[str, str]) -> None:
        super().__init__()
        self.lab = lab
        self.items = known
        self.name = f"d{next(self.serial)}"
        self.model = Model()
        lab.write(datasets.create_dataset, "lab", DatasetCreate(name=self.name))

    # -- what people do ------------------------------------------------------------------------------------------------

    @rule(branch=names, path=paths, number=revisions, again=st.booleans())
    def commit(self, branch: str, path: str, number: int | None, again: bool) -> None:
        request = self._change(branch, path, number)
        with self._unless_impossible(branch, path, number) as possible:
            made = self._commit(request)
        if possible:
            head = self.model.refs[branch]
            self._made(branch, made, self._changed(branch, path, number), () if head is None else (head,))
            if again:  # the answer was lost
                assert self._commit(request).digest == made.digest

    @rule(branch=names, first=paths, second=paths, number=st.sampled_from(REVISIONS))
    def two_commit_at_once(self, branch: str, first: str, second: str, number: int) -> None:
        if branch in self.model.tags or branch not in self.model.refs:
            return
        state = self.model.state(self.model.refs[branch])
        if number in (state.get(first), state.get(second)):
            return
        prepared = [
            self.lab.read(datasets.prepare_commit, "lab", self.name, self._change(branch, path, number))
            for path in (first, second)
        ]
        head = self.model.refs[branch]
        made = self.lab.write(datasets.record_commit, "lab", self.name, prepared[0])
        with refused("branch-moved"):
            self.lab.write(datasets.record_commit, "lab", self.name, prepared[1])
        self._made(branch, made, {**state, first: number}, () if head is None else (head,))

    @rule(name=names, kind=st.sampled_from(RefKind), which=numbers)
    def create_ref(self, name: str, kind: RefKind, which: int) -> None:
        at = self._any_commit(which)
        if at is None:
            return
        request = RefCreate(name=name, kind=kind, at=at)
        if name in self.model.refs:
            with refused("name-taken"):
                self.lab.write(datasets.create_ref, "lab", self.name, request)
            return
        self.lab.write(datasets.create_ref, "lab", self.name, request)
        self.model.refs[name] = at
        self.model.tags |= {name} if kind is RefKind.TAG else set()

    @rule(name=names)
    def delete_ref(self, name: str) -> None:
        if name == "main" or name not in self.model.refs:
            with refused("is-main", "no-version"):
                self.lab.write(datasets.delete_ref, "lab", self.name, name, expected_rev=None)
            return
        self.lab.write(datasets.delete_ref, "lab", self.name, name, expected_rev=None)
        del self.model.refs[name]
        self.model.tags.discard(name)

    @rule(name=names, which=numbers)
    def reset(self, name: str, which: int) -> None:
        at = self._any_commit(which)
        if at is None or name not in self.model.refs:
            return
        if name in self.model.tags:
            with refused("is-tag"):
                self.lab.write(datasets.move_branch, "lab", self.name, name, RefMove(at=at), expected_rev=None)
            return
        self.lab.write(datasets.move_branch, "lab", self.name, name, RefMove(at=at), expected_rev=None)
        self.model.refs[name] = at

    @rule(into=names, which=numbers, take=sides, again=st.booleans())
    def merge(self, into: str, which: int, take: Side | None, again: bool) -> None:
        ours, theirs = self._branch_with_commits(into), self._any_commit(which)
        if ours is None or theirs is None:
            return
        bases = self.model.bases(ours, theirs)
        base = next(iter(bases), None)
        state, conflicts = self._merged(base, ours, theirs, take)
        resolutions = self._resolutions(conflicts, take)
        request = MergeRequest(into=into, version=theirs, resolutions=resolutions, write_id=secrets.token_hex(8))
        if theirs in bases or len(bases) > 1:
            with refused("already-merged" if theirs in bases else "several-bases", "no-conflict"):
                self._merge(request)
        elif conflicts and take is None:
            with refused("merge-conflicts"):
                self._merge(request)
        else:
            made = self._merge(request).commit
            self._made(into, made, state, (ours, theirs) if base != ours else self.model.commits[theirs].parents)
            if again:  # the answer was lost
                assert self._merge(request).commit.digest == made.digest

    @rule(into=names, which=numbers, undo=st.booleans(), parent=st.none() | st.sampled_from([1, 2]), take=sides)
    def pick(self, into: str, which: int, undo: bool, parent: Any, take: Side | None) -> None:
        ours, picked = self._branch_with_commits(into), self._any_commit(which)
        if ours is None or picked is None:
            return
        parents = self.model.commits[picked].parents
        if (parent is None and len(parents) == 2) or (parent == 2 and len(parents) < 2):
            with refused("is-merge", "no-parent"):
                self._pick(PickRequest(into=into, version=picked, parent=parent), undo)
            return
        before = parents[(parent or 1) - 1] if parents else None
        base, theirs = (picked, before) if undo else (before, picked)
        state, conflicts = self._merged(base, ours, theirs, take)
        request = PickRequest(into=into, version=picked, parent=parent, resolutions=self._resolutions(conflicts, take))
        if conflicts and take is None:
            with refused("merge-conflicts"):
                self._pick(request, undo)
        elif state == self.model.state(ours):
            with refused("no-changes"):
                self._pick(request, undo)
        else:
            self._made(into, self._pick(request, undo).commit, state, (ours,))

    # -- what people see -----------------------------------------------------------------------------------------------

    @invariant()
    def refs_are_those_of_the_model(self) -> None:
        found = self.lab.read(datasets.list_refs, "lab", self.name, cursor=None, limit=10).items
        assert {one.name: one.commit for one in found} == self.model.refs
        assert {one.name for one in found if one.kind is RefKind.TAG} == self.model.tags

    @rule(which=numbers, other=numbers)
    def look(self, which: int, other: int) -> None:
        at, after = self._any_commit(which), self._any_commit(other)
        if at is None or after is None:
            return
        page: dict[str, Any] = {"cursor": None, "limit": 1_000}
        entries = self.lab.read(datasets.list_entries, "lab", self.name, at, path="", **page).items
        state = self.model.state(at)
        assert {one.path: (one.item, one.revision) for one in entries} == {
            path: (self.items[path], number) for path, number in state.items()
        }
        log = self.lab.read(datasets.list_commits, "lab", self.name, at, path="", **page).items
        chain = self.model.first_parents(at)
        assert [one.digest for one in log] == chain
        of_b = self.lab.read(datasets.list_commits, "lab", self.name, at, path="b", **page).items
        changes = [(one, self._changes_of_b(one)) for one in chain]
        assert [(one.digest, one.changes) for one in of_b] == [one for one in changes if one[1]]
        found = self.lab.read(datasets.compare_versions, "lab", self.name, at, after, path="", limit=1_000)
        later = self.model.state(after)
        assert {one.path for one in found.entries} == {path for path in PATHS if state.get(path) != later.get(path)}
        for path in PATHS:
            if path not in state:
                self._look_for_removal(at, path)
                continue
            origins = self.lab.read(datasets.read_origins, "lab", self.name, at, path=path, kind=Kind.SKELETON)
            assert origins.parts["hierarchy"].commit.digest == self.model.origin(at, path)

    def _look_for_removal(self, at: str, path: str) -> None:
        """Check that the error for a missing entry names the commit that removed it, or none if it never existed."""
        chain = self.model.first_parents(at)
        had = [path in self.model.state(one) for one in chain]
        removed_by = chain[had.index(True) - 1] if any(had) else None
        with pytest.raises(NotFoundProblem) as caught:
            self.lab.read(datasets.read_origins, "lab", self.name, at, path=path, kind=Kind.SKELETON)
        assert caught.value.context.get("removed_by", {"digest": None})["digest"] == removed_by

    def teardown(self) -> None:
        assert list(check_store(self.lab.database)) == []

    # -- parts of these ------------------------------------------------------------------------------------------------

    def _change(self, branch: str, path: str, number: int | None) -> CommitCreate:
        change = (
            RemoveEntry(path=path, kind=Kind.SKELETON)
            if number is None
            else PutEntry(path=path, item=self.items[path], revision=number)
        )
        return CommitCreate(branch=branch, message="m", changes=(change,), write_id=secrets.token_hex(8))

    @contextmanager
    def _unless_impossible(self, branch: str, path: str, number: int | None) -> Iterator[bool]:
        """Yield whether the model can change the path; if it cannot, the `with` block must raise an error."""
        if branch in self.model.tags or branch not in self.model.refs:
            codes = ("is-tag", "no-version")
        elif self.model.state(self.model.refs[branch]).get(path) == number:
            codes = ("no-entry", "no-changes")
        else:
            yield True
            return
        with refused(*codes):
            yield False

    def _changed(self, branch: str, path: str, number: int | None) -> State:
        state = {**self.model.state(self.model.refs[branch]), path: number}
        return {path: number for path, number in state.items() if number is not None}

    def _merged(self, base: str | None, ours: str, theirs: str | None, take: Side | None) -> tuple[State, set[str]]:
        return merged(self.model.state(base), self.model.state(ours), self.model.state(theirs), take)

    def _made(self, branch: str, made: Any, state: State, parents: tuple[str, ...]) -> None:
        assert made.parents == parents
        assert made.entries == len(state)
        self.model.commits.setdefault(made.digest, Made(state, parents))
        assert self.model.commits[made.digest] == Made(state, parents)
        self.model.refs[branch] = made.digest

    def _any_commit(self, which: int) -> str | None:
        known = list(self.model.commits)
        return known[which % len(known)] if known else None

    def _branch_with_commits(self, name: str) -> str | None:
        return None if name in self.model.tags else self.model.refs.get(name)

    def _changes_of_b(self, digest: str) -> dict[str, int]:
        made = self.model.commits[digest]
        before = self.model.state(made.parents[0]) if made.parents else {}
        sides = [(before.get(path), made.state.get(path)) for path in ("b", "b/c")]
        return dict(
            Counter(
                "added" if old is None else "removed" if new is None else "changed" for old, new in sides if old != new
            )
        )

    @staticmethod
    def _resolutions(conflicts: set[str], take: Side | None) -> tuple[Resolution, ...]:
        if take is None:
            return ()
        return tuple(Resolution(path=path, kind=Kind.SKELETON, take=take) for path in sorted(conflicts))

    def _commit(self, request: CommitCreate) -> Any:
        prepared = self.lab.read(datasets.prepare_commit, "lab", self.name, request)
        return self.lab.write(datasets.record_commit, "lab", self.name, prepared)

    def _merge(self, request: MergeRequest) -> Any:
        prepared = self.lab.read(datasets.prepare_merge, "lab", self.name, request)
        return self.lab.write(datasets.record_merge, "lab", self.name, request, prepared)

    def _pick(self, request: PickRequest, undo: bool) -> Any:
        prepared = self.lab.read(datasets.prepare_pick, "lab", self.name, request, undo=undo)
        return self.lab.write(datasets.record_merge, "lab", self.name, request, prepared)


@pytest.fixture
def known_items(lab: Lab) -> dict[str, str]:
    """The ids of items with three revisions, by path; all revisions have different content."""

    def make(tx: Transaction) -> dict[str, str]:
        tx.principal = lab.owner
        made = {}
        for place, path in enumerate(PATHS):
            trees = [skeleton_tree(joints=2 + len(PATHS) * number + place) for number in REVISIONS]
            request = ItemCreate(name=path.replace("/", "-"), parts={"hierarchy": trees[0]})
            made[path] = items.create_item(tx, "lab", Kind.SKELETON, request).id
            for tree in trees[1:]:
                items.put_part(tx, "lab", Kind.SKELETON, made[path], "hierarchy", tree, expected_rev=None)
        return made

    found: dict[str, str] = lab.write(make)
    return found


def run(lab: Lab, known: dict[str, str], count: int, length: int) -> None:
    run_state_machine_as_test(
        cast(Any, lambda: DatasetMachine(lab, known)),
        settings=settings(
            max_examples=count, stateful_step_count=length, deadline=None, print_blob=False, report_multiple_bugs=False,
            suppress_health_check=list(HealthCheck), phases=[Phase.explicit, Phase.generate],
        ),
    )  # fmt: skip


@pytest.mark.every_database
def test_a_dataset_behaves_as_its_model(lab: Lab, known_items: dict[str, str]) -> None:
    run(lab, known_items, examples(6, soak=15), steps(30))


def drop_their_side(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(merging, "merge_entries", lambda ours, _theirs, take, _merge: merge_entries(ours, [], take))


def move_whatever_the_head_is(patch: pytest.MonkeyPatch) -> None:
    def move(tx: Transaction, prepared: Any, digest: str, _mover: Any) -> None:
        which = (dataset_ref.c.dataset_id == prepared.dataset_id, dataset_ref.c.name == prepared.branch)
        tx.execute(update(dataset_ref).where(*which).values(digest=digest))

    patch.setattr(committing, "move_branch_to", move)


@pytest.mark.soak  # looks for each fault until it is found
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("plant", [drop_their_side, move_whatever_the_head_is], ids=lambda plant: plant.__name__)
def test_the_model_finds_planted_faults(
    lab: Lab, known_items: dict[str, str], monkeypatch: pytest.MonkeyPatch, plant: Callable[[pytest.MonkeyPatch], None]
) -> None:
    plant(monkeypatch)
    with pytest.raises((AssertionError, ApiProblem, pytest.fail.Exception)):
        run(lab, known_items, 1000, 50)  # in every tier: it ends with the first program that finds the fault
