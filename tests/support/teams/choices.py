"""Random choices of operations, most of which are possible in the present state of the model."""

from __future__ import annotations

import random
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.support.teams.combining import Combine, Merge, Pick
from tests.support.teams.contents import Info, Keyframe, Labels, Motion, Segment
from tests.support.teams.item_operations import (
    CreateItem,
    DeleteItem,
    Purge,
    Rename,
    RestoreItem,
    Revise,
    Revision,
    UploadFile,
    clip_content,
    labels_content,
    revision_of,
)
from tests.support.teams.model import Model, ModelDataset, ModelItem, ModelProject
from tests.support.teams.operations import CommitChanges, CreateRef, DeleteRef, Operation, Reset
from tests.support.teams.transfers import ArchiveAndImport, CheckOut, Copy

from marey_schemas.datasets.commits import EntryChange, MoveEntry, PutEntry, RemoveEntry
from marey_schemas.datasets.naming import RefKind
from marey_schemas.kinds import Kind

DATASETS = ("gaits", "gaits", "copy")
PATHS = ("a", "b", "b/c", "d")
FOLDERS = ("gaits", "gaits/b", "shelf")
BRANCHES = ("main", "main", "x", "y")
TAG_NAMES = ("v1", "v2", "x")
MARKS: tuple[tuple[str, ...], ...] = ((), ("night",), ("day", "night"))
_KINDS = (Kind.CLIP, Kind.CLIP, Kind.ANNOTATION, Kind.ANNOTATION, Kind.SKELETON)
LEFT, RIGHT, TURN = Segment(0, 4, "left"), Segment(4, 8, "right"), Segment(6, 10, "turn")
SEGMENTS = (LEFT, RIGHT, TURN, Segment(10, 12, "left"), Segment(0, 3, "left"))
KEYFRAMES = (Keyframe(1, "down"), Keyframe(2, "down"), Keyframe(2, "up"))


@dataclass
class Chooser:
    """Chooses the operation of one step at random; `user` does this step in the project on the server `lab`."""

    chance: random.Random
    model: Model
    lab: str
    user: str
    serial: int
    """Number of the step, which makes names and contents different from those of earlier steps."""

    @property
    def project(self) -> ModelProject:
        return self.model.projects[self.lab]

    def operation(self, kind: str) -> Operation | None:
        """Return an operation, or None if the model has nothing to which it applies.

        `kind` is the name of one of the methods below.
        """
        chosen: Callable[[], Operation | None] = getattr(self, kind)
        return chosen()

    # -- items ------------------------------------------------------------------------------------------------------

    def create_clip(self) -> Operation | None:
        rig = self._item(Kind.SKELETON, present=True)
        if rig is None:
            return None
        mine = [one for one, user in self.project.loose_files.items() if user == self.user]
        content = clip_content(
            revision_of(rig), self.chance.randrange(5), f"take {self.serial}", mine[0] if mine else None
        )
        folder, name = self.chance.choice(FOLDERS), f"clip{self.chance.randrange(4)}"
        return CreateItem(self.lab, name, folder, content, revision_of(rig), self.chance.choice(MARKS))

    def upload_file(self) -> Operation:
        return UploadFile(self.lab, secrets.token_bytes(8))  # not as in the project of another program

    def annotate(self) -> Operation | None:
        clip = self._item(Kind.CLIP, present=True)
        if clip is None:
            return None
        name = f"labels{self.chance.randrange(3)}"
        content = labels_content(self._labels(revision_of(clip)))
        return CreateItem(self.lab, name, clip.folder, content, revision_of(clip))

    def revise(self) -> Operation | None:
        chosen = self._item(Kind.CLIP, Kind.ANNOTATION, Kind.ANNOTATION) or self._item(Kind.CLIP)
        rig = self._item(Kind.SKELETON, present=True)
        if chosen is None:
            return None
        value: Any = Info(f"take {self.chance.randrange(3)}")
        reference = None
        if chosen.kind is Kind.ANNOTATION:
            reference = self._clip_of(chosen)
            if reference is None:
                return None
            value = self._labels(reference)
        elif rig is not None and self.chance.random() < 0.5:
            reference = revision_of(rig)
            value = Motion(self.chance.randrange(7), reference.content)
        part = {Labels: "annotation", Motion: "motion", Info: "info"}[type(value)]
        return Revise(self.lab, chosen.id, chosen.kind, part, value, reference)

    def rename(self) -> Operation | None:
        chosen = self._item(Kind.CLIP, Kind.ANNOTATION)
        name, marks = f"clip{self.chance.randrange(4)}", self.chance.choice(MARKS)
        return (
            None
            if chosen is None
            else Rename(self.lab, chosen.id, chosen.kind, self.chance.choice(FOLDERS), name, marks)
        )

    def delete_item(self) -> Operation | None:
        kinds = (Kind.CLIP, Kind.ANNOTATION) if self.chance.random() < 0.97 else (Kind.SKELETON,)
        chosen = self._item(*kinds)
        return None if chosen is None else DeleteItem(self.lab, chosen.id, chosen.kind)

    def restore_item(self) -> Operation | None:
        chosen = self._gone() or self._item()
        return None if chosen is None else RestoreItem(self.lab, chosen.id, chosen.kind)

    def purge_item(self) -> Operation | None:
        chosen = self._gone() or self._item()
        return None if chosen is None else Purge(self.lab, chosen.id)

    def purge_all(self) -> Operation:
        return Purge(self.lab)

    # -- versions ---------------------------------------------------------------------------------------------------

    def first_commit(self) -> CommitChanges:
        """Return a commit of the items of the project to `main`."""
        items = self.project.present()
        changes = tuple(PutEntry(path=path, item=one.id) for path, one in zip(PATHS, items, strict=False))
        return CommitChanges(self.lab, "gaits", "main", changes)

    def commit(self, *, right: bool = False) -> CommitChanges | None:
        name = self._dataset()
        return None if name is None else self.commit_to(name, self._branch(name), right=right)

    def commit_to(self, name: str, branch: str, *, right: bool = False) -> CommitChanges | None:
        """Return a commit of up to three changes.

        If `right` is false, the request may expect a wrong newest commit of the branch.
        """
        dataset = self.project.datasets[name]
        changes = [self._change(name, branch) for _ in range(self.chance.randint(1, 3))]
        given = tuple(one for one in changes if one is not None)
        expected = dataset.refs.get(branch) if self.chance.random() < 0.4 else None
        if self.chance.random() < 0.1 and dataset.commits and not right:
            expected = self.chance.choice(self.model.in_order(dataset.commits))
        return CommitChanges(self.lab, name, branch, given, expected) if given else None

    def commit_folder(self) -> Operation | None:
        name = self._dataset()
        if name is None:
            return None
        dataset = self.project.datasets[name]
        here = [one for one, head in dataset.refs.items() if head == dataset.checked_out and one not in dataset.tags]
        branch = self.chance.choice(here) if here and self.chance.random() < 0.8 else self._branch(name)
        return CommitChanges(self.lab, name, branch, None)

    def check_out(self) -> Operation | None:
        name = self._dataset(with_commits=True)
        return None if name is None else CheckOut(self.lab, name, self._commit(name), self.chance.random() < 0.6)

    def create_branch(self) -> Operation | None:
        name = self._dataset(with_commits=True)
        return (
            None
            if name is None
            else CreateRef(self.lab, name, self.chance.choice(BRANCHES[1:]), RefKind.BRANCH, self._commit(name))
        )

    def create_tag(self) -> Operation | None:
        name = self._dataset(with_commits=True)
        return (
            None
            if name is None
            else CreateRef(self.lab, name, self.chance.choice(TAG_NAMES), RefKind.TAG, self._commit(name))
        )

    def delete_ref(self) -> Operation | None:
        name = self._dataset()
        return None if name is None else DeleteRef(self.lab, name, self.chance.choice((*BRANCHES[1:], *TAG_NAMES)))

    def reset(self) -> Operation | None:
        name = self._dataset(with_commits=True)
        return None if name is None else Reset(self.lab, name, self._branch(name), self._commit(name))

    def merge(self) -> Combine | None:
        name = self._dataset(with_commits=True)
        if name is None:
            return None
        branch = self._branch(name)
        return Merge(self.lab, name, branch, self._commit_for(name, branch, contained=False))

    def revert(self) -> Combine | None:
        return self._pick(undo=True)

    def cherry_pick(self) -> Combine | None:
        return self._pick(undo=False)

    def copy(self) -> Operation | None:
        return self._transfer(Copy)

    def archive(self) -> Operation | None:
        return self._transfer(ArchiveAndImport)

    # -- parts of these ---------------------------------------------------------------------------------------------

    def _item(self, *kinds: Kind, present: bool = False) -> ModelItem | None:
        """Return an item, mostly a present one."""
        wanted = self.chance.choice(kinds) if kinds else None
        found = [one for one in self.project.items.values() if wanted in (None, one.kind)]
        if present or self.chance.random() < 0.9:
            found = [one for one in found if one.status == "present"]
        return self.chance.choice(found) if found else None

    def _gone(self) -> ModelItem | None:
        """Return a deleted item, sometimes a purged one."""
        found = [one for one in self.project.items.values() if one.status != "present"]
        if self.chance.random() < 0.9:
            found = [one for one in found if one.status == "deleted"]
        return self.chance.choice(found) if found else None

    def _labels(self, clip: Revision) -> Labels:
        chosen: list[Segment] = []
        for one in self.chance.sample(SEGMENTS, self.chance.randint(0, 3)):
            if all(one.end <= other.start or other.end <= one.start for other in chosen):
                chosen.append(one)
        keyframes = self.chance.sample(KEYFRAMES, self.chance.randint(0, 2))
        return Labels(clip.content, frozenset(chosen), frozenset(keyframes))

    def _clip_of(self, annotation: ModelItem) -> Revision | None:
        """Return the revision of a clip that an annotation labels, or sometimes the newest revision of this clip."""
        labels = dict(annotation.revisions[-1].parts)["annotation"]
        assert isinstance(labels, Labels)
        for one in self.project.present():
            if labels.clip in one.revisions:
                newest = self.chance.random() < 0.2
                return revision_of(one, None if newest else one.revisions.index(labels.clip) + 1)
        return None

    def _dataset(self, *, with_commits: bool = False) -> str | None:
        found = [one for one in DATASETS if one in self.project.datasets]
        found = [one for one in found if self.project.datasets[one].commits or not with_commits]
        return self.chance.choice(found) if found else None

    def _branch(self, name: str) -> str:
        """Return the name of a branch, mostly of an existing one, or of a tag."""
        dataset = self.project.datasets[name]
        chosen = self.chance.choice(BRANCHES)
        return chosen if chosen in dataset.refs or self.chance.random() < 0.05 else "main"

    def _commit(self, name: str) -> str:
        """Return a commit, mostly the newest one of a branch or tag."""
        dataset = self.project.datasets[name]
        heads = self.model.in_order(one for one in dataset.refs.values() if one is not None)
        chosen = heads if heads and self.chance.random() < 0.7 else self.model.in_order(dataset.commits)
        return self.chance.choice(chosen)

    def _commit_for(self, name: str, branch: str, *, contained: bool) -> str:
        """Return a commit, mostly one that is in the branch; with `contained=False`, mostly one that is not."""
        dataset = self.project.datasets[name]
        head = dataset.refs.get(branch)
        before = set() if head is None else self.model.ancestors([head])
        fitting = self.model.in_order(dataset.commits & before if contained else dataset.commits - before)
        return self.chance.choice(fitting) if fitting and self.chance.random() < 0.9 else self._commit(name)

    def _change(self, name: str, branch: str) -> EntryChange | None:
        """Return a change for a commit: mostly a put, sometimes a removal or a move.

        The changed entry mostly exists.
        """
        state = self.model.state(self.project.datasets[name].refs.get(branch))
        path, kind = self.chance.choice(PATHS), self.chance.choice(list(_KINDS))
        exists = bool(state) and self.chance.random() < 0.8
        if exists:
            path, kind = self.chance.choice(sorted(state))
        if self.chance.random() < 0.7 or not (exists or self.chance.random() < 0.1):
            chosen = self._item(kind)
            if chosen is None:
                return None
            old = self.chance.randint(1, len(chosen.revisions)) if self.chance.random() < 0.5 else None
            return PutEntry(path=path, item=chosen.id, revision=old)
        if self.chance.random() < 0.5:
            return RemoveEntry(path=path, kind=kind)
        return MoveEntry(path=path, kind=kind, to=self.chance.choice(PATHS))

    def _pick(self, *, undo: bool) -> Combine | None:
        name = self._dataset(with_commits=True)
        if name is None:
            return None
        branch = self._branch(name)
        at = self._commit_for(name, branch, contained=undo)
        merged = len(self.model.commits[at].parents) == 2
        parent = self.chance.choice((None, 1, 1, 2, 2)) if merged or self.chance.random() < 0.05 else None
        return Pick(self.lab, name, branch, at, undo=undo, parent=parent)

    def _transfer(self, kind: type[Copy | ArchiveAndImport]) -> Operation | None:
        name = self._dataset(with_commits=True)
        if name is None or self.user not in ("ann", "mia"):  # others are refused late, or never
            return None
        refs = self.project.datasets[name].refs
        version = self.chance.choice(sorted(refs)) if self.chance.random() < 0.7 else self._commit(name)
        to_lab = self.chance.choice(sorted(self.model.projects))
        to = self.chance.choice([one for one in sorted(set(DATASETS)) if (to_lab, one) != (self.lab, name)])
        into = self.chance.choice((None, None, *BRANCHES, "v1"))
        return kind(self.lab, name, version, to_lab, to, into)


def some_dataset() -> ModelDataset:
    """Return the dataset, without commits, that each project of the model has at the start."""
    return ModelDataset(folder="gaits")
