"""Origins of an entry's content: for each part, the commit that last changed it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import islice
from typing import Any, NamedTuple

from marey_versions.ancestry import HistoricCommit
from marey_versions.compared import compare_entries
from marey_versions.records import DatasetEntry, entry_of
from marey_versions.tree.difference import difference
from marey_versions.tree.reading import ChunkReader, Tree

PATH = "path"
"""Name of the origin of an entry's path: the commit that added or moved the entry."""
TAGS = "tags"
"""Name of the origin of an entry's tags."""
MOST_CHANGES = 100_000
"""Greatest number of changed entries of a commit among which a moved entry is searched for.

When a search has read more changed entries than this in total, it searches no further commits for moved entries.
"""


class FoundOrigin(NamedTuple):
    """Commit that gave an entry one of its parts, its path or its tags."""

    commit: str
    key: str
    """Key that the entry had in this commit; an entry may have been moved since."""
    certain: bool
    """False if the search ended at this commit, so that an earlier commit may be the origin."""


@dataclass
class _OriginSearch:
    """Search for the commits that gave an entry its parts, path and tags, from later commits to earlier ones."""

    reader: ChunkReader
    commit_of: Callable[[str], HistoricCommit]
    waiting: list[tuple[int, str, str]] = field(default_factory=list)
    """Commits and keys to look at, as a heap: the commit with the greatest generation is first."""
    sought: dict[tuple[str, str], set[str]] = field(default_factory=dict)
    """For each commit and key: names of the parts whose origin is this commit or an earlier one."""
    ended: set[str] = field(default_factory=set)
    """Commits in which moved entries were not searched for, because too many changed entries had been read."""
    compared: int = 0
    """Number of changed entries that were read to search for moved entries."""

    def add(self, commit: str, key: str, names: set[str]) -> None:
        if (commit, key) not in self.sought:
            heappush(self.waiting, (-self.commit_of(commit).generation, commit, key))
        self.sought.setdefault((commit, key), set()).update(names)

    def entry(self, commit: str, key: str) -> DatasetEntry | None:
        value = Tree(self.reader, self.commit_of(commit).tree).get(key)
        return None if value is None else entry_of(key, value)

    def before(self, parent: str, commit: str, key: str) -> DatasetEntry | None:
        """Return the entry of `parent` that became the entry `key` of `commit`; None if there is no such entry.

        The entry may have another key in the parent.
        """
        trees = [self.commit_of(one).tree for one in (parent, commit)]
        same, present = self.entry(parent, key), self.entry(commit, key)
        if trees[0] == trees[1] or (same and present and same.parts.items() & present.parts.items()):
            return same
        most = MOST_CHANGES if self.compared <= MOST_CHANGES else -1
        changes = list(islice(difference(self.reader, *trees), most + 1))
        self.compared += len(changes)
        if len(changes) > most:
            self.ended.add(commit)
            return None
        for one in compare_entries(changes):
            if one.after is not None and one.after.key == key:
                return one.before
        return None


def find_origins(
    reader: ChunkReader, commit_of: Callable[[str], HistoricCommit], commit: str, key: str, *, most: int
) -> dict[str, FoundOrigin]:
    """Return the origin of each part of an entry, of its path and of its tags, by name.

    A merge is the origin of a part only if the part differs from the same part in both parents. A moved entry is
    recognised by the equal content of at least one of its parts.

    Parameters
    ----------
    reader : chunks of the trees of all commits
    commit_of : returns a commit by its digest
    commit, key : digest of the commit, and key of an entry that exists in this commit
    most : greatest number of commits to look at; origins that are not found within them are marked as not certain
    """
    search = _OriginSearch(reader, commit_of)
    present = search.entry(commit, key)
    if present is None:
        raise KeyError(key)
    search.add(commit, key, set(_named(present)))
    origins: dict[str, FoundOrigin] = {}
    for _ in range(most):
        if not search.waiting:
            break
        _, commit, key = heappop(search.waiting)
        names = search.sought.pop((commit, key))
        names -= _pass_to_parents(search, commit, key, names)
        origins.update((name, FoundOrigin(commit, key, commit not in search.ended)) for name in names)
    for (commit, key), names in search.sought.items():
        origins.update((name, FoundOrigin(commit, key, False)) for name in names)
    return origins


def _pass_to_parents(search: _OriginSearch, commit: str, key: str, names: set[str]) -> set[str]:
    """Continue the search in the parents of `commit`, and return the names that are searched for there.

    `key` is the key of the entry in the commit; `names` are names of its parts, `PATH` or `TAGS`. A name is searched
    for in the first parent whose entry has the same value for this name. If there is no such parent, the commit is the
    origin of the name.
    """
    present = search.entry(commit, key)
    assert present is not None
    values = _named(present)
    passed: set[str] = set()
    for parent in search.commit_of(commit).parents:
        earlier = search.before(parent, commit, key)
        of_parent = {} if earlier is None else _named(earlier)
        same = {name for name in names - passed if name in of_parent and of_parent[name] == values[name]}
        if earlier is not None and same:
            search.add(parent, earlier.key, same)
            passed |= same
    return passed


def _named(entry: DatasetEntry) -> Mapping[str, Any]:
    """Return all values of an entry that a commit can change, by name: the parts, the path and the tags."""
    return {**entry.parts, PATH: entry.path, TAGS: entry.tags}
