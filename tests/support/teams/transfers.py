"""Operations of users on whole versions: copies to other datasets, archives, and checkouts into folders."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tests.support.teams.contents import Content
from tests.support.teams.model import Model, ModelDataset, ModelItem
from tests.support.teams.operations import Clients, OnDataset, Operation, Outcome, accepted, refuse

from marey_client.handles.datasets import ImportedVersion
from marey_schemas.access import Role
from marey_schemas.datasets.naming import MAIN
from marey_schemas.kinds import Kind

LISTED = (Kind.SKELETON, Kind.CLIP, Kind.ANNOTATION)
"""Kinds of items that the model knows."""


@dataclass(frozen=True)
class Transfer(Operation):
    """Base class of copies of a version from the dataset `source` on the server `lab` to another dataset."""

    role = Role.MAINTAINER
    source: str
    version: str
    """Branch, tag or commit."""
    to_lab: str
    to: str
    into: str | None = None

    @property
    def labs(self) -> tuple[str, ...]:
        return self.lab, self.to_lab

    def head(self, model: Model) -> str | None:
        """Return the commit that the version names."""
        dataset = self.project(model).datasets[self.source]
        return dataset.refs.get(self.version, self.version)

    def arrive(self, model: Model, head: str, branch: str) -> bool:
        """Add the commits up to `head` to the target dataset of the model; return whether `branch` is now at `head`."""
        datasets = model.projects[self.to_lab].datasets
        target = datasets.setdefault(self.to, ModelDataset(folder=self.to))
        target.commits |= model.ancestors([head])
        if branch in target.tags:
            return target.refs[branch] == head
        now = target.refs.get(branch)
        if now is None or model.bases(now, head) == {now}:
            target.refs[branch] = head
        return target.refs[branch] == head


@dataclass(frozen=True)
class Copy(Transfer):
    """Copy of a version to a dataset on another server or the same one."""

    def send(self, clients: Clients) -> ImportedVersion:
        source = clients.dataset(self.lab, self.source)
        target = clients.project(self.to_lab).datasets
        return target.pull(source, self.to, self.version, into=self.into)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        head = self.head(model)
        if head is None:
            refuse(outcome, "no-commits")
            return
        source = self.project(model).datasets[self.source]
        is_branch = self.version in source.refs and self.version not in source.tags
        branch = self.into or (self.version if is_branch else MAIN)
        made = accepted(outcome)
        moved = self.arrive(model, head, branch)
        assert (made.commit.digest, made.branch, made.moved) == (head, branch, moved)
        if self.version in source.tags:
            target = model.projects[self.to_lab].datasets[self.to]
            if self.version not in target.refs:
                target.refs[self.version] = head
                target.tags.add(self.version)
            same = self.version in target.tags and target.refs[self.version] == head
            assert made.tag == (self.version if same else None)


@dataclass(frozen=True)
class ArchiveAndImport(Transfer):
    """Archive of a version, and its import into a dataset."""

    def send(self, clients: Clients) -> ImportedVersion:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "version.tar"
            clients.dataset(self.lab, self.source).archive(path, self.version)
            return clients.project(self.to_lab).datasets.import_archive(path, self.to, into=self.into or MAIN)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        head = self.head(model)
        if head is None:
            refuse(outcome, "no-commits")
            return
        made, branch = accepted(outcome), self.into or MAIN
        moved = self.arrive(model, head, branch)
        assert (made.commit.digest, made.branch, made.moved) == (head, branch, moved)


@dataclass(frozen=True)
class CheckOut(OnDataset):
    """Checkout of a version into the folder of a dataset.

    The server chooses which items it changes, restores and creates. So the model first checks that the folder has the
    entries of the version. Then it copies all items of the folder from the server.
    """

    role = Role.MAINTAINER
    at: str
    discard: bool

    def send(self, clients: Clients) -> list[Any]:
        clients.dataset(self.lab, self.name).check_out(self.at, discard=self.discard)
        return list(self._listed(clients))

    def _listed(self, clients: Clients) -> Iterator[Any]:
        project = clients.project(self.lab)
        for kind in LISTED:
            yield from (one.item for one in project.items(kind).list(collection=self.name))

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        dataset = self.dataset(model)
        if dataset.folder is None:
            refuse(outcome, "no-folder")
        elif not self.discard and self._has_changes(model):
            refuse(outcome, "uncommitted-changes")
        else:
            dataset.checked_out = self.at
            self._learn(model, accepted(outcome))

    def _has_changes(self, model: Model) -> bool:
        dataset = self.dataset(model)
        assert dataset.folder is not None
        return self.project(model).folder_state(dataset.folder) != model.state(dataset.checked_out)

    def _learn(self, model: Model, listed: list[Any]) -> None:
        project, folder = self.project(model), f"{self.name}/"
        wanted = model.state(self.at)
        found = {(one.path.removeprefix(folder), one.kind): one for one in listed}
        assert found.keys() == wanted.keys()
        here = {one.id for one in listed}
        for one in project.present():
            if one.key[0].startswith(folder) and one.id not in here:
                project.update(one.id, status="deleted")
        for key, item in found.items():
            content = Content(key[1], wanted[key].parts)
            assert frozenset(item.tags) == wanted[key].tags
            before = project.items.get(item.id)
            if before is None:
                before = ModelItem(item.id, key[1], "", "", (content,) * item.revision, frozenset())
            revisions = before.revisions + (content,) * (item.revision - len(before.revisions))
            assert revisions[-1] == content
            project.items[item.id] = replace(
                before, folder=item.collection, name=item.name, tags=wanted[key].tags, revisions=revisions,
                status="present",
            )  # fmt: skip
