"""Search for the first bad commit of a history, with tests that halve the number of possible commits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence


class BadCommitSearch:
    """Search for the first bad commit, by tests of commits.

    The suspects are the commits that can be the first bad commit. Every test excludes some of them. The search assumes
    that the commits after a bad commit are bad, and that the ancestors of a good commit are good. A test leaves one
    number of suspects if the tested commit is bad, and another number if it is good. The search tests the commit for
    which the larger of the two numbers is smallest. In a history without merges, this takes at most log2(n) tests for n
    commits, rounded up. With merges, which have two parents, a test leaves about two thirds of the commits in the worst
    case.

    Parameters
    ----------
    parents : mapping from the digest of a commit to the digests of its parents. The keys are `bad` and those of its
        ancestors that are not known to be good; other parents are known to be good
    bad : digest of a commit that is known to be bad
    """

    def __init__(self, parents: Mapping[str, Sequence[str]], bad: str) -> None:
        self._order = tuple(_parents_first(parents, bad))
        self._places = {digest: place for place, digest in enumerate(self._order)}
        # Sets of commits are integers in which the bit of a commit's place is set, so that a step over thousands of
        # commits takes milliseconds.
        self._with_ancestors: list[int] = []
        for place, digest in enumerate(self._order):
            found = 1 << place
            for parent in parents[digest]:
                if parent in self._places:
                    found |= self._with_ancestors[self._places[parent]]
            self._with_ancestors.append(found)
        self._bad = self._places[bad]
        self._left = self._with_ancestors[self._bad]
        self._untestable = 0
        self._skips = 0

    @property
    def suspects(self) -> tuple[str, ...]:
        """The commits that can be the first bad commit, parents first; only the last of them is known to be bad."""
        return tuple(self._order[place] for place in _places_in(self._left))

    @property
    def expected_tests(self) -> int:
        """The number of tests that are still to be expected: log2 of the number of suspects, rounded up."""
        return (self._left.bit_count() - 1).bit_length()

    def next(self) -> str | None:
        """Return the commit to test next, or None if the search has ended.

        The search has ended if the known bad commit is the only suspect, or if no other suspect can be tested.
        """
        total = self._left.bit_count()

        def larger_remainder(place: int) -> int:
            if_bad = (self._with_ancestors[place] & self._left).bit_count()
            return max(if_bad, total - if_bad)

        testable = self._left & ~self._untestable & ~(1 << self._bad)
        ranked = sorted(_places_in(testable), key=larger_remainder)
        if not ranked:
            return None
        # The neighbours of a commit that cannot be tested often cannot be tested either, so each skip moves the search
        # twice as far away from the middle.
        return self._order[ranked[min((1 << self._skips) - 1, len(ranked) - 1)]]

    def record(self, commit: str, bad: bool | None) -> None:
        """Record whether the commit that `next` returned is bad; None means that it cannot be tested."""
        place = self._places[commit]
        self._skips = self._skips + 1 if bad is None else 0
        if bad is None:
            self._untestable |= 1 << place
        elif bad:
            self._bad = place
            self._left &= self._with_ancestors[place]
        else:
            self._left &= ~self._with_ancestors[place]


def _parents_first(parents: Mapping[str, Sequence[str]], start: str) -> Iterator[str]:
    """Yield a commit and its ancestors in `parents`, each after its parents."""
    known: set[str] = set()
    waiting: list[tuple[str, bool]] = [(start, False)]
    while waiting:
        digest, parents_done = waiting.pop()
        if parents_done:
            yield digest
        elif digest not in known:
            known.add(digest)
            waiting.append((digest, True))
            waiting += [(one, False) for one in reversed(parents[digest]) if one in parents]


def _places_in(commits: int) -> Iterator[int]:
    """Yield the positions of the bits that are set in `commits`, lowest first."""
    while commits:
        lowest = commits & -commits
        yield lowest.bit_length() - 1
        commits ^= lowest
