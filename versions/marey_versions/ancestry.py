"""Commits and their ancestors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Protocol


class HistoricCommit(Protocol):
    """Commit with the facts that searches for common ancestors and for origins need."""

    @property
    def tree(self) -> str:
        """The digest of the root of the tree of entries."""

    @property
    def parents(self) -> Sequence[str]:
        """The digests of the commits before this one."""

    @property
    def generation(self) -> int:
        """A number that is greater than the generations of all parents."""


_OURS, _THEIRS, _FOLLOWED = 1, 2, 4
_COMMON = _OURS | _THEIRS


def nearest_common(commit_of: Callable[[str], HistoricCommit], ours: str, theirs: str) -> list[str]:
    """Return the nearest common ancestors of two commits, sorted by digest; an empty list if there are none.

    A common ancestor is nearest if no other common ancestor descends from it. A commit counts as its own ancestor. The
    search reads commits in the order of decreasing generation. It stops when all commits that are left to read are
    ancestors of common ancestors. So the history before the common ancestors does not lengthen the search.

    Parameters
    ----------
    commit_of : returns a commit by its digest
    ours, theirs : digests of the two commits
    """
    marks: dict[str, int] = {}
    waiting: list[tuple[int, str]] = []

    def mark(digest: str, marked: int) -> None:
        if digest not in marks:
            heappush(waiting, (-commit_of(digest).generation, digest))
        marks[digest] = marks.get(digest, 0) | marked

    found: list[str] = []
    mark(ours, _OURS)
    mark(theirs, _THEIRS)
    while any(not marks[digest] & _FOLLOWED for _, digest in waiting):
        _, digest = heappop(waiting)
        if marks[digest] == _COMMON:
            found.append(digest)
            marks[digest] |= _FOLLOWED
        for parent in commit_of(digest).parents:
            mark(parent, marks[digest])
    return sorted(found)
