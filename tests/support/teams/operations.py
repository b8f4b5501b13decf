"""Operations of users: the base class of all operations, and operations on commits, branches and tags.

An operation sends its request, compares the outcome with the expectation of the model, and then changes the model.
"""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from tests.support.teams.model import Made, Model, ModelDataset, ModelProject
from tests.support.teams.three_way import Entry, Key

from marey_client import Marey
from marey_client.errors import MareyError, RequestFailed
from marey_client.handles.versions import DatasetHandle
from marey_client.project import ProjectHandle
from marey_schemas.access import Role
from marey_schemas.datasets.commits import Commit, CommitCreate, EntryChange, MoveEntry, PutEntry, RemoveEntry
from marey_schemas.datasets.naming import RefKind

RACED = frozenset({"branch-moved", "purged-meanwhile"})
"""Error codes of requests that another request has overtaken; a client should then send the request again."""


class Refused(NamedTuple):
    """Answer of the server that refuses a request."""

    status: int
    code: str
    context: Mapping[str, Any] = {}


class Failed(NamedTuple):
    """Error that the client raised itself, without a refusal by the server."""

    error: MareyError


Outcome = Any
"""`Refused`, `Failed`, or the answer of the server to a request that succeeded."""


def attempt(operation: Operation, clients: Clients) -> Outcome:
    """Send an operation and return its outcome; `Unreachable` is an outcome, too."""
    try:
        return operation.send(clients)
    except RequestFailed as error:
        return Refused(error.problem.status, error.problem.code, error.problem.context or {})
    except MareyError as error:
        return Failed(error)


@dataclass(frozen=True)
class Clients:
    """Connections of one user to both servers, and the name of the project on them."""

    user: str
    servers: Mapping[str, Marey]
    project_name: str

    def project(self, lab: str) -> ProjectHandle:
        return self.servers[lab].project(self.project_name)

    def dataset(self, lab: str, name: str) -> DatasetHandle:
        return self.project(lab).datasets.at(name)


@dataclass(frozen=True)
class Operation(ABC):
    """Something that a user does in the project on the server `lab`."""

    role: ClassVar[Role] = Role.CONTRIBUTOR
    """Role that the operation requires."""
    lab: str

    @property
    def label(self) -> str:
        """The name under which operations of this kind are counted."""
        return type(self).__name__

    @property
    def labs(self) -> tuple[str, ...]:
        """The servers that take part."""
        return (self.lab,)

    @abstractmethod
    def send(self, clients: Clients) -> Any:
        """Do the operation on the server, and return the answer."""

    @abstractmethod
    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        """Check that the outcome is as the model expects, and then apply the effect of the operation to the model."""

    def forbidden(self, model: Model, outcome: Outcome) -> None:
        """Fail if the outcome is not a refusal because of the user's role."""
        refuse(outcome, 403)

    def assume(self, model: Model) -> None:  # noqa: B027 - most operations are repeated
        """Apply the effect to the model although no answer arrived; needed if a repetition gets another answer."""

    def again(self, outcome: Outcome, second: Outcome) -> None:  # noqa: B027 - most have nothing to check
        """Check the outcome `second` of a repetition, after the operation had succeeded with `outcome` at first."""

    def place(self, model: Model) -> str | None:
        """Return the folder in which the user needs the role; None: in the project."""
        return None

    def project(self, model: Model) -> ModelProject:
        return model.projects[self.lab]


def refuse(outcome: Outcome, *expected: str | int) -> None:
    """Fail if the outcome is not a refusal with one of these error codes or HTTP statuses."""
    assert isinstance(outcome, Refused), f"{outcome} in place of {expected}"
    assert outcome.code in expected or outcome.status in expected, f"{outcome} in place of {expected}"


def accepted(outcome: Outcome) -> Any:
    """Return the answer; fail if the outcome is an error."""
    assert not isinstance(outcome, Refused | Failed), outcome
    return outcome


@dataclass(frozen=True)
class OnDataset(Operation):
    """Operation on a dataset."""

    name: str

    def dataset(self, model: Model) -> ModelDataset:
        return self.project(model).datasets[self.name]

    def record(self, model: Model, branch: str, commit: Commit, made: Made) -> None:
        """Check a new commit, and add it to the model as the newest commit of a branch."""
        assert commit.parents == made.parents
        assert commit.author == made.author
        assert commit.entries == len(made.state)
        assert commit.digest not in model.commits, "the commit is not new"
        model.note_tree(made.state, commit.tree)
        model.commits[commit.digest] = made
        dataset = self.dataset(model)
        dataset.commits.add(commit.digest)
        dataset.refs[branch] = commit.digest


def new_write_id() -> str:
    """Return a new name of a write."""
    return secrets.token_hex(8)


@dataclass(frozen=True)
class CommitChanges(OnDataset):
    """Commit of explicit changes; without changes, commit of the dataset's folder."""

    branch: str
    changes: tuple[EntryChange, ...] | None
    expected: str | None = None
    write_id: str = field(default_factory=new_write_id)

    @property
    def label(self) -> str:
        return "CommitFolder" if self.changes is None else "CommitChanges"

    def send(self, clients: Clients) -> Commit:
        request = CommitCreate(
            branch=self.branch, message="m", changes=self.changes, expected=self.expected, write_id=self.write_id
        )
        handle = clients.dataset(self.lab, self.name)
        return handle.transport.post(Commit, f"{handle.url}/commits", request)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        dataset = self.dataset(model)
        after = self._after(model)
        if isinstance(after, str):
            refuse(outcome, after)
            return
        head = dataset.refs[self.branch]
        made = Made(after, () if head is None else (head,), clients.user)
        commit = accepted(outcome)
        self.record(model, self.branch, commit, made)
        if self.changes is None:
            dataset.checked_out = commit.digest

    def again(self, outcome: Outcome, second: Outcome) -> None:
        assert accepted(second) == outcome

    def _after(self, model: Model) -> dict[Key, Entry] | str:
        """Return the entries of the new version, or the code of the expected error."""
        dataset = self.dataset(model)
        if self.branch not in dataset.refs:
            return "no-version"
        if self.branch in dataset.tags:
            return "is-tag"
        head = dataset.refs[self.branch]
        if self.expected not in (None, head):
            return "branch-moved"
        if self.changes is None:
            if dataset.folder is None:
                return "no-folder"
            if dataset.checked_out != head:
                return "folder-elsewhere"
            after: dict[Key, Entry] | str = self.project(model).folder_state(dataset.folder)
        else:
            after = apply_changes(self.project(model), dict(model.state(head)), self.changes)
        return "no-changes" if head is not None and after == model.state(head) else after


def apply_changes(
    project: ModelProject, state: dict[Key, Entry], changes: Sequence[EntryChange]
) -> dict[Key, Entry] | str:
    """Return the entries after changes, or the code of the expected error."""
    if any(isinstance(one, PutEntry) and project.items[one.item].status != "present" for one in changes):
        return "no-item"
    for one in changes:
        if isinstance(one, PutEntry):
            item = project.items[one.item]
            state[one.path, item.kind] = item.entry_of(one.revision or len(item.revisions))
        elif (one.path, one.kind) not in state:
            return "no-entry"
        else:
            entry = state.pop((one.path, one.kind))
            if isinstance(one, MoveEntry):
                if (one.to, one.kind) in state:
                    return "path-taken"
                state[one.to, one.kind] = entry
            else:
                assert isinstance(one, RemoveEntry)
    return state


@dataclass(frozen=True)
class CreateRef(OnDataset):
    """Creation of a branch or a tag."""

    ref: str
    kind: RefKind
    at: str

    @property
    def label(self) -> str:
        return f"Create{self.kind.value.title()}"

    def send(self, clients: Clients) -> Any:
        handle = clients.dataset(self.lab, self.name)
        create = handle.create_branch if self.kind is RefKind.BRANCH else handle.create_tag
        return create(self.ref, self.at)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        dataset = self.dataset(model)
        if self.ref in dataset.refs:
            refuse(outcome, "name-taken")
            return
        made = accepted(outcome)
        assert (made.name, made.kind, made.commit) == (self.ref, self.kind, self.at)
        dataset.refs[self.ref] = self.at
        dataset.tags |= {self.ref} if self.kind is RefKind.TAG else set()


@dataclass(frozen=True)
class DeleteRef(OnDataset):
    """Deletion of a branch or a tag."""

    role = Role.MAINTAINER
    ref: str

    def send(self, clients: Clients) -> None:
        clients.dataset(self.lab, self.name).delete_ref(self.ref)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        if self.ref == "main":
            refuse(outcome, "is-main")
        elif self.ref not in self.dataset(model).refs:
            refuse(outcome, "no-version")
        else:
            accepted(outcome)
            self.assume(model)

    def assume(self, model: Model) -> None:
        dataset = self.dataset(model)
        assert self.ref in dataset.refs
        assert self.ref != "main"
        del dataset.refs[self.ref]
        dataset.tags.discard(self.ref)


@dataclass(frozen=True)
class Reset(OnDataset):
    """Move of a branch to any version."""

    role = Role.MAINTAINER
    branch: str
    at: str

    def send(self, clients: Clients) -> Any:
        return clients.dataset(self.lab, self.name).move_branch(self.branch, self.at)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        dataset = self.dataset(model)
        if self.branch not in dataset.refs:
            refuse(outcome, "no-version")
        elif self.branch in dataset.tags:
            refuse(outcome, "is-tag")
        else:
            assert accepted(outcome).commit == self.at
            self.assume(model)

    def assume(self, model: Model) -> None:
        dataset = self.dataset(model)
        assert self.branch in dataset.refs
        assert self.branch not in dataset.tags
        dataset.refs[self.branch] = self.at
