"""Operations of users on two versions: merges, cherry-picks and reverts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tests.support.teams.model import Made, Model
from tests.support.teams.operations import Clients, OnDataset, Outcome, accepted, new_write_id, refuse
from tests.support.teams.three_way import Key, Merged, changed_entries, merge_states

from marey_schemas.datasets.merges import MergeAnswer, MergeRequest, PickRequest, Resolution, Side


@dataclass(frozen=True)
class Combine(OnDataset):
    """Base class of merges, cherry-picks and reverts."""

    into: str
    version: str
    resolutions: Mapping[Key, Side] = field(default_factory=dict)
    preview: bool = False
    write_id: str = field(default_factory=new_write_id)

    @property
    def label(self) -> str:
        return f"{type(self).__name__}{'Preview' if self.preview else ''}{'Resolved' if self.resolutions else ''}"

    def common(self) -> dict[str, Any]:
        """Return the members that requests for merges, cherry-picks and reverts share."""
        sides = [Resolution(path=key[0], kind=key[1], take=side) for key, side in self.resolutions.items()]
        return {
            "into": self.into, "version": self.version, "resolutions": tuple(sides), "preview": self.preview,
            "write_id": self.write_id,
        }  # fmt: skip

    def post(self, clients: Clients, resource: str, request: MergeRequest | PickRequest) -> MergeAnswer:
        handle = clients.dataset(self.lab, self.name)
        return handle.transport.post(MergeAnswer, f"{handle.url}/{resource}", request)

    def again(self, outcome: Outcome, second: Outcome) -> None:
        assert accepted(second).commit == outcome.commit

    def head(self, model: Model) -> str | None:
        """Return the newest commit of the branch, None if there is no such branch."""
        dataset = self.dataset(model)
        return None if self.into in dataset.tags else dataset.refs.get(self.into)

    def refusal(self, model: Model) -> str | None:
        """Return the code of the expected error if nothing can be merged into the branch, else None."""
        dataset = self.dataset(model)
        if self.into not in dataset.refs:
            return "no-version"
        if self.into in dataset.tags:
            return "is-tag"
        return "no-commits" if dataset.refs[self.into] is None else None

    def settle(self, model: Model, outcome: Outcome, base: str | None, theirs: str | None) -> Merged | None:
        """Compare the outcome with the expected merge; return the merge if the model must record it, else None."""
        head = self.head(model)
        merged = merge_states(model.state(base), model.state(head), model.state(theirs), self.resolutions)
        if self.resolutions.keys() - merged.decided:
            refuse(outcome, "no-conflict")
            return None
        changes = changed_entries(model.state(head), merged.state)
        if isinstance(self, Pick) and not changes and not merged.conflicts:
            refuse(outcome, "no-changes")
            return None
        if merged.conflicts and not self.preview:
            refuse(outcome, "merge-conflicts")
            answer = MergeAnswer.model_validate(outcome.context)
        else:
            answer = accepted(outcome)
        found, expected = (answer.base, answer.ours, answer.theirs, answer.changes), (base, head, theirs, changes)
        assert found == expected, f"{found} in place of {expected}"
        conflicts = sorted(((one.path, one.kind), one.parts) for one in answer.conflicts)
        assert conflicts == sorted(merged.conflicts), f"{conflicts} in place of {merged.conflicts}"
        assert answer.conflict_count == len(conflicts)
        return None if merged.conflicts or self.preview else merged


@dataclass(frozen=True)
class Merge(Combine):
    """Merge of a version into a branch."""

    def send(self, clients: Clients) -> MergeAnswer:
        return self.post(clients, "merges", MergeRequest(**self.common()))

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        head, code = self.head(model), self.refusal(model)
        if code is not None or head is None:
            refuse(outcome, str(code))
            return
        bases = model.bases(head, self.version)
        if len(bases) > 1:
            refuse(outcome, "several-bases")
            return
        base = next(iter(bases), None)
        if base == self.version:
            refuse(outcome, "already-merged")
            return
        merged = self.settle(model, outcome, base, self.version)
        if merged is None:
            return
        if base == head:
            assert outcome.commit.digest == self.version
            self.dataset(model).refs[self.into] = self.version
        else:
            self.record(model, self.into, outcome.commit, Made(merged.state, (head, self.version), clients.user))


@dataclass(frozen=True)
class Pick(Combine):
    """Cherry-pick of a commit, or with `undo` the revert of a commit."""

    undo: bool = False
    parent: Any = None

    @property
    def label(self) -> str:
        return super().label.replace("Pick", "Revert" if self.undo else "CherryPick")

    def send(self, clients: Clients) -> MergeAnswer:
        request = PickRequest(**self.common(), parent=self.parent)
        return self.post(clients, "reverts" if self.undo else "cherry-picks", request)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        parents = model.commits[self.version].parents
        head, code = self.head(model), self.refusal(model)
        if self.parent is None and len(parents) == 2:
            code = "is-merge"
        elif self.parent == 2 and len(parents) < 2:
            code = "no-parent"
        if code is not None or head is None:
            refuse(outcome, str(code))
            return
        before = parents[(self.parent or 1) - 1] if parents else None
        base, theirs = (self.version, before) if self.undo else (before, self.version)
        merged = self.settle(model, outcome, base, theirs)
        if merged is not None:
            self.record(model, self.into, outcome.commit, Made(merged.state, (head,), clients.user))
