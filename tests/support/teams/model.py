"""Expected state of the two servers, as plain dictionaries."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from tests.support.teams.contents import Content, files_of, references_of
from tests.support.teams.three_way import Entry, Key, State

from marey_schemas.access import Role
from marey_schemas.kinds import Kind

STUDIO, PARTNER = "studio", "partner"
"""Names of the two servers."""
ROLES = {"ann": Role.OWNER, "mia": Role.MAINTAINER, "ben": Role.CONTRIBUTOR, "rea": Role.READER}
"""Roles of the users when a program begins."""


class Made(NamedTuple):
    """A commit."""

    state: State
    parents: tuple[str, ...]
    author: str


@dataclass(frozen=True)
class ModelItem:
    """An item that users have created."""

    id: str
    kind: Kind
    folder: str
    name: str
    revisions: tuple[Content, ...]
    refers: frozenset[str]
    """Ids of the items to which documents of this item refer."""
    tags: frozenset[str] = frozenset()
    status: str = "present"
    """`present`, `deleted` or `purged`."""

    @property
    def key(self) -> Key:
        """Path and kind; no two present items have the same pair."""
        return f"{self.folder}/{self.name}".lstrip("/"), self.kind

    @property
    def entry(self) -> Entry:
        """The entry that a commit of the newest revision makes."""
        return self.entry_of(len(self.revisions))

    def entry_of(self, revision: int) -> Entry:
        """Return the entry that a commit of a revision makes."""
        return Entry(self.revisions[revision - 1].parts, self.tags)


@dataclass
class ModelDataset:
    """A dataset."""

    folder: str | None = None
    commits: set[str] = field(default_factory=set)
    refs: dict[str, str | None] = field(default_factory=lambda: {"main": None})
    tags: set[str] = field(default_factory=set)
    checked_out: str | None = None
    """Commit that is checked out in the folder."""

    def copy(self) -> ModelDataset:
        return replace(self, commits=set(self.commits), refs=dict(self.refs), tags=set(self.tags))


@dataclass
class ModelProject:
    """The project on one server."""

    items: dict[str, ModelItem] = field(default_factory=dict)
    datasets: dict[str, ModelDataset] = field(default_factory=dict)
    loose_files: dict[str, str] = field(default_factory=dict)
    """Uploaded files to which nothing refers yet: the user who uploaded the file, by digest."""

    def present(self) -> list[ModelItem]:
        return [one for one in self.items.values() if one.status == "present"]

    def occupied(self, key: Key, besides: str = "") -> bool:
        """Return whether a present item other than `besides` has this path and kind."""
        return any(one.key == key and one.id != besides for one in self.present())

    def update(self, item_id: str, **changes: Any) -> None:
        self.items[item_id] = replace(self.items[item_id], **changes)

    def folder_state(self, folder: str) -> dict[Key, Entry]:
        """Return the entries that a commit of a folder makes."""
        return {
            (one.key[0].removeprefix(f"{folder}/"), one.kind): one.entry
            for one in self.present()
            if one.key[0].startswith(f"{folder}/")
        }

    def copy(self) -> ModelProject:
        datasets = {name: one.copy() for name, one in self.datasets.items()}
        return ModelProject(dict(self.items), datasets, dict(self.loose_files))


@dataclass
class Model:
    """Both projects, and all commits, which have the same digests on both servers."""

    projects: dict[str, ModelProject] = field(default_factory=lambda: {STUDIO: ModelProject(), PARTNER: ModelProject()})
    commits: dict[str, Made] = field(default_factory=dict)
    trees: dict[str, State] = field(default_factory=dict)
    """Entries of versions, by the digest of the tree of these entries, on both servers."""
    roles: dict[str, Role] = field(default_factory=ROLES.copy)
    """Roles of the users in both projects."""
    folder_roles: dict[tuple[str, str], Role] = field(default_factory=dict)
    """Roles of users in folders, and in everything below these, by user and folder."""

    def copy(self) -> Model:
        projects = {name: one.copy() for name, one in self.projects.items()}
        return Model(projects, dict(self.commits), dict(self.trees), dict(self.roles), dict(self.folder_roles))

    def role_of(self, user: str, place: str | None) -> Role:
        """Return the role of a user in a folder; None: in the project."""
        inside = {
            folder: role
            for (of, folder), role in self.folder_roles.items()
            if of == user and place is not None and f"{place}/".startswith(f"{folder}/")
        }
        return inside[max(inside, key=len)] if inside else self.roles[user]

    def note_tree(self, state: State, tree: str) -> None:
        """Check that versions have the same tree if, and only if, they have the same entries."""
        assert self.trees.setdefault(tree, state) == state
        assert [digest for digest, one in self.trees.items() if one == state] == [tree]

    def state(self, digest: str | None) -> State:
        return {} if digest is None else self.commits[digest].state

    def in_order(self, commits: Iterable[str]) -> list[str]:
        """Return `commits` in the order of their creation, so that random choices depend only on the seed."""
        wanted = set(commits)
        return [one for one in self.commits if one in wanted]

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
        """Return a commit, its first parent, the first parent of this parent, and so on."""
        found = [digest]
        while parents := self.commits[found[-1]].parents:
            found.append(parents[0])
        return found

    # -- what holds items -------------------------------------------------------------------------------------------

    def committed(self, lab: str) -> set[Content]:
        """Return the contents of all entries of all versions in a project."""
        digests = set[str]().union(*(one.commits for one in self.projects[lab].datasets.values()))
        return set(contents_of(self.commits[digest].state for digest in digests))

    def certainly_free(self, lab: str, going: Iterable[str]) -> bool:
        """Return whether it is certain that only items of `going` need the items `going`.

        The server may have items that the model does not know, because merges and copies have created them. The content
        of such an item is in a version, or content in a version refers to it.
        """
        ids = set(going)
        contents = {content for one in ids for content in self.projects[lab].items[one].revisions}
        known = set(contents_of(made.state for made in self.commits.values()))
        others = [one for one in self.projects[lab].items.values() if one.id not in ids and one.status != "purged"]
        known |= {content for one in others for content in one.revisions}
        needed = known.union(*(references_of(one) for one in known))
        return not (contents & needed) and not any(one.refers & ids for one in others)

    def is_held(self, lab: str, item_id: str) -> bool:
        """Return whether another present item refers to an item.

        Versions may also need the item. The model cannot know this, because another item may have the same content.
        """
        others = [one for one in self.projects[lab].items.values() if one.id != item_id and one.status == "present"]
        return any(item_id in one.refers for one in others)

    def needed_files(self) -> set[str]:
        """Return the digests of files that are named in a version, or in an item that was not purged."""
        contents = set(contents_of(made.state for made in self.commits.values()))
        for project in self.projects.values():
            contents |= {
                content for one in project.items.values() if one.status != "purged" for content in one.revisions
            }
        return set[str]().union(*map(files_of, contents))


def contents_of(states: Iterable[State]) -> Iterator[Content]:
    """Yield the contents of entries; many contents are yielded several times."""
    return (Content(key[1], entry.parts) for state in states for key, entry in state.items())
