"""Three-way merges of the changes of two sides since a common version, entry by entry and part by part."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from marey_schemas.datasets.merges import Side
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.names import MOST_TAGS
from marey_versions.annotations import AnnotationClash
from marey_versions.choices import Choice, Choices
from marey_versions.compared import ComparedEntry
from marey_versions.records import DatasetEntry
from marey_versions.tree.chunks import Value


class MergeConflict(NamedTuple):
    """Entry that both sides have changed in ways that exclude each other.

    `ours` or `theirs` is None if that side does not have the entry. `base` is None if both sides added the entry, or
    moved different entries to the same path.
    """

    base: DatasetEntry | None
    ours: DatasetEntry | None
    theirs: DatasetEntry | None
    parts: tuple[str, ...]
    """Names of the parts that both sides have changed in different ways.

    `path` is among them if both sides have moved the entry to different paths, or want different entries at one path.
    `tags` is among them if the entry would have more tags than an item can have.
    If one side has removed the entry, `entry` is the only name.
    """
    clash: AnnotationClash | None = None
    """The reason why an annotation could not be merged segment by segment."""
    no_way_back: str | None = None
    """Path to which one of two entries would return after a resolution, but at which there is another entry; else None.

    In this case, the conflict remains in spite of the resolution, because the first entry would be lost.
    """

    @property
    def key(self) -> str:
        """The key of the conflict in resolutions: the key of the entry in `ours`, else in `base`, else in `theirs`."""
        present = self.ours or self.base or self.theirs
        assert present is not None
        return present.key


class ChangedPart(NamedTuple):
    """Part of an entry that both sides have changed in different ways. `base` is None if both have added the entry."""

    part: str
    base: DatasetEntry | None
    ours: DatasetEntry
    theirs: DatasetEntry


MergeParts = Callable[[Sequence[ChangedPart]], Sequence[str | AnnotationClash | None]]
"""Function that merges the documents of parts. For each part, it returns one of three values: the content digest of the
merged document, the reason why the changes exclude each other, or None if parts of this kind are not merged.
"""


class CombinedEntry(NamedTuple):
    """Entry whose parts come from several versions, so that no version has a revision with the content of the entry."""

    entry: DatasetEntry
    sides: tuple[DatasetEntry, ...]
    """The entry on our side, on their side, and in the base if the base has it."""

    def source_of(self, part: str) -> DatasetEntry | None:
        """Return the first of `sides` with this part of the entry; None if the part was merged from several."""
        digest = self.entry.parts[part]
        return next((one for one in self.sides if one.parts.get(part) == digest), None)


@dataclass
class MergedEntries:
    """Result of a merge: changes to apply to our tree, and conflicts without a resolution."""

    changes: dict[str, Value | None] = field(default_factory=dict)
    combined: list[CombinedEntry] = field(default_factory=list)
    """The entries in `changes` that have parts of both sides, or parts that were merged."""
    conflicts: list[MergeConflict] = field(default_factory=list)
    decided: set[str] = field(default_factory=set)
    """Keys of the resolutions that decided a conflict."""
    unused: list[Choice] = field(default_factory=list)
    """Resolutions that decided no conflict, by key; a key may also be in `decided`."""


def merge_entries(
    ours: Iterable[ComparedEntry],
    theirs: Iterable[ComparedEntry],
    resolutions: Iterable[Choice],
    merge_parts: MergeParts | None = None,
) -> MergedEntries:
    """Merge the changes that two sides have made since their base.

    Parameters
    ----------
    ours, theirs : the entries that differ between the base and each side
    resolutions : decisions about conflicts. Each decides one conflict, or one part of a conflict. If several conflicts
        have the same key, the first resolutions with this key decide the first of these conflicts, and so on
    merge_parts : merges the parts that both sides have changed; if None, such parts are in conflict

    Returns
    -------
    MergedEntries
        changes that turn our tree into the merged one, and the conflicts without a resolution
    """
    mine = list(ours)
    of_base = {one.before.key: one.after for one in mine if one.before is not None}
    added = {one.after.key: one.after for one in mine if one.before is None and one.after is not None}
    sides: list[_Sides] = []
    for one in theirs:
        at = one.present.key if one.before is None else one.before.key
        our_entry = added.get(at) if one.before is None else of_base.get(at, one.before)
        sides.append(_Sides(one.before, our_entry, one.after))
    if merge_parts is not None:
        _merge_documents(sides, merge_parts)
    merged = MergedEntries()
    choices = Choices(resolutions, merged.decided)
    decided: list[_Decided] = []
    for three in sides:
        found = _decide(three, choices)
        if isinstance(found, MergeConflict):
            merged.conflicts.append(found)
        else:
            decided.append(found)
    _apply(decided, mine, choices, merged)
    merged.unused += choices.left()
    return merged


class _Decided(NamedTuple):
    """Entry in the base and on both sides, and the merged entry, which is None if the entry is removed."""

    base: DatasetEntry | None
    ours: DatasetEntry | None
    theirs: DatasetEntry | None
    merged: DatasetEntry | None

    @property
    def combined(self) -> CombinedEntry | None:
        """The merged entry, with the entries of both sides; None if one of the three is missing.

        Also None if the base or one side has exactly the merged parts, so that no parts were combined.
        """
        if self.merged is None or self.ours is None or self.theirs is None:
            return None
        sides = (self.ours, self.theirs, *(() if self.base is None else (self.base,)))
        known = [one.parts for one in sides]
        return None if self.merged.parts in known else CombinedEntry(self.merged, sides)

    @property
    def moves(self) -> bool:
        """Whether the merged entry gets a path or kind that it does not have on our side."""
        return self.merged is not None and (self.ours is None or self.ours.key != self.merged.key)

    @property
    def result(self) -> DatasetEntry:
        """The merged entry, which must exist."""
        assert self.merged is not None
        return self.merged

    def place_beside(self, key: str) -> str | None:
        """Return the earlier path of this entry, for the case that another entry gets `key`; None without such a path.

        This is the path of the entry on our side. If our side does not have the entry, or has it at `key`, it is the
        path in the base.
        """
        back = self.base if self.ours is None or self.ours.key == key else self.ours
        return None if back is None else back.path

    def at(self, path: str) -> _Decided:
        """Return the same entry with `path` as its merged path."""
        return self._replace(merged=self.result._replace(path=path))


@dataclass
class _Sides:
    """Entry in the base, on our side and on their side."""

    base: DatasetEntry | None
    ours: DatasetEntry | None
    theirs: DatasetEntry | None
    clashes: tuple[str, ...] = ()
    """Parts that both sides have changed in ways that exclude each other."""
    merged: dict[str, str] = field(default_factory=dict)
    """Content digests of the parts whose documents were merged."""
    clash: AnnotationClash | None = None

    def __post_init__(self) -> None:
        if _excludes(self.base, self.ours, self.theirs):
            self.clashes = _clashes(self.base, self.ours, self.theirs)

    @property
    def by_name(self) -> dict[Side, DatasetEntry | None]:
        """The entry of each version: `ours` and `theirs`, possibly None, and `base` only if the base has the entry."""
        found = {Side.OURS: self.ours, Side.THEIRS: self.theirs}
        return found if self.base is None else {**found, Side.BASE: self.base}

    @property
    def groups(self) -> dict[str, set[str]]:
        """For each clashing part, the clashing parts that must come from the same side."""
        found = {part: {part} for part in self.clashes}
        pairs = () if self.ours is None else _made_together(self.ours.kind)
        for made_from, made in pairs:
            if made_from in found and made in found:
                found[made_from] |= found[made]
                found.update(dict.fromkeys(found[made_from], found[made_from]))
        return found

    @property
    def changed_parts(self) -> Iterator[ChangedPart]:
        """The clashing parts that have content on both sides; none if one of the sides has no such entry."""
        for part in self.clashes:
            if self.ours is not None and self.theirs is not None and part in self.ours.parts.keys() & self.theirs.parts:
                yield ChangedPart(part, self.base, self.ours, self.theirs)


def _merge_documents(sides: Sequence[_Sides], merge_parts: MergeParts) -> None:
    """Merge the documents of clashing parts; a merged part no longer clashes."""
    changed = [(one, part) for one in sides for part in one.changed_parts]
    outcomes = merge_parts([part for _, part in changed]) if changed else ()
    for (one, part), outcome in zip(changed, outcomes, strict=True):
        if isinstance(outcome, AnnotationClash):
            one.clash = outcome
        elif outcome is not None:
            one.merged[part.part] = outcome
            one.clashes = tuple(name for name in one.clashes if name != part.part)


def _decide(sides: _Sides, choices: Choices) -> _Decided | MergeConflict:
    base, ours, theirs = sides.base, sides.ours, sides.theirs
    if theirs in (ours, base):
        return _Decided(base, ours, theirs, ours)
    if ours == base:
        return _Decided(base, ours, theirs, theirs)
    if not sides.clashes:
        return _Decided(base, ours, theirs, _combined(sides, {}))
    conflict = MergeConflict(base, ours, theirs, sides.clashes, sides.clash)
    choice = choices.take(conflict.key, sides.groups, sides.by_name)
    if not isinstance(choice, Side):
        if left := tuple(part for part in sides.clashes if part not in choice):
            return conflict._replace(parts=left)
        if "entry" not in choice:
            return _Decided(base, ours, theirs, _combined(sides, choice))
        choice = choice["entry"]
    if choice is Side.BASE:
        return _Decided(base, ours, theirs, base)
    whole = "entry" in sides.clashes or base is None
    chosen = sides.by_name[choice] if whole else _combined(sides, dict.fromkeys(sides.clashes, choice))
    return _Decided(base, ours, theirs, chosen)


def _apply(decided: Sequence[_Decided], mine: Iterable[ComparedEntry], choices: Choices, merged: MergedEntries) -> None:
    """Add the changes of our tree to `merged`, and a conflict for each key that two entries should get.

    A resolution in `choices` can decide which of the two entries gets the key; then no conflict is added. `mine`
    contains the entries that our side has changed.
    """
    placed = {one.after.key: _Decided(one.before, one.after, one.before, one.after) for one in mine if one.after}
    for one in decided:
        if one.ours is not None:
            placed.pop(one.ours.key, None)
            merged.changes[one.ours.key] = None
    placed.update((one.result.key, one) for one in decided if one.merged is not None and not one.moves)
    # Entries that go back to the base come first, so that a conflict never lists an entry of theirs as ours.
    moving = sorted((one for one in decided if one.moves), key=_gets_place_of_theirs)
    colliding = [one for one in moving if placed.setdefault(one.result.key, one) is not one]
    # Collisions come last, so that no entry goes back to a place that another entry gets.
    merged.conflicts += (conflict for one in colliding if (conflict := _collide(one, placed, choices)) is not None)
    for key, one in placed.items():
        if one.merged == one.ours:
            merged.changes.pop(key, None)
            continue
        merged.changes[key] = one.result.value
        if (combined := one.combined) is not None:
            merged.combined.append(combined)


def _gets_place_of_theirs(one: _Decided) -> bool:
    return one.theirs is not None and one.merged is not None and one.theirs.key == one.merged.key


def _collide(one: _Decided, placed: dict[str, _Decided], choices: Choices) -> MergeConflict | None:
    """Decide which of two entries gets a key; the other entry returns to its earlier path.

    `placed` contains entries by key; one of them has the key that `one` should get. If a side has added the entry that
    does not get the key, this entry has no earlier path and is dropped. The result is a conflict if there is no
    resolution, or if the earlier path is taken.
    """
    key = one.result.key
    other = placed[key]
    conflict = MergeConflict(None, other.merged, one.merged, ("path",))
    choice = choices.take(key, {"path": ("path",)}, tuple(Side))
    if not isinstance(choice, Side):
        if not choice:
            return conflict
        choice = choice["path"]
    winner, loser = (one, other) if choice is Side.THEIRS else (other, one)
    if (back := loser.place_beside(key)) is not None:
        moved = loser.at(back)
        if moved.result.key in placed:
            return conflict._replace(no_way_back=back)
        placed[moved.result.key] = moved
    placed[key] = winner
    return None


def _clashes(base: DatasetEntry | None, ours: DatasetEntry | None, theirs: DatasetEntry | None) -> tuple[str, ...]:
    """Return the names of the parts that both sides have changed in different ways.

    A part and a part that is computed from it, such as a model and its sample tree, count as one part. If one side has
    changed the model and the other side the tree, both names are returned, because the tree of one side would not fit
    the model of the other side. All other changed parts that are computed from a returned part are also returned, since
    they must come from the same side. The names can also be `entry`, `path` and `tags` (see `MergeConflict.parts`).
    """
    if ours is None or theirs is None:
        return ("entry",)
    of_base: Mapping[str, str] = {} if base is None else base.parts
    names = sorted(of_base.keys() | ours.parts.keys() | theirs.parts.keys())
    clashing = {name for name in names if _excludes(of_base.get(name), ours.parts.get(name), theirs.parts.get(name))}
    versions = of_base, ours.parts, theirs.parts
    differing = {name for name in names if len({parts.get(name) for parts in versions}) > 1}
    for pair in _made_together(ours.kind):
        if _excludes(*(tuple(parts.get(name) for name in pair) for parts in versions)):
            clashing |= differing.intersection(pair)
    for made_from, made in _made_together(ours.kind):
        if made_from in clashing & differing and made in differing:
            clashing.add(made)
    moved = base is not None and _excludes(base.path, ours.path, theirs.path)
    crowded = len(_merged_tags(base, ours, theirs)) > MOST_TAGS
    return (*(("path",) if moved else ()), *sorted(clashing), *(("tags",) if crowded else ()))


def _made_together(kind: str) -> Iterator[tuple[str, str]]:
    """Yield pairs of parts: a part, and a part that is computed from it."""
    for name, spec in PARTS[Kind(kind)].items():
        if spec.made_from is not None:
            yield spec.made_from, name


def _excludes(base: Any, ours: Any, theirs: Any) -> bool:
    return ours not in (base, theirs) and theirs != base


def _combined(sides: _Sides, taken: Mapping[str, Side]) -> DatasetEntry | None:
    """Return the entry with the changes of both sides; None if one side does not have the entry.

    `taken` contains the side of each clashing part.
    """
    base, ours, theirs = sides.base, sides.ours, sides.theirs
    if ours is None or theirs is None:
        return None
    chosen = {name: one for name, side in taken.items() if (one := sides.by_name[side]) is not None}
    of_base: Mapping[str, str] = {} if base is None else base.parts
    parts = {
        name: digest
        for name in sorted(of_base.keys() | ours.parts.keys() | theirs.parts.keys())
        if (digest := chosen[name].parts.get(name) if name in chosen else _newer(name, of_base, ours, theirs))
        is not None
    }
    path = chosen["path"].path if "path" in chosen else theirs.path if ours.path == (base or ours).path else ours.path
    tags = chosen["tags"].tags if "tags" in chosen else _merged_tags(base, ours, theirs)
    return DatasetEntry(path, ours.kind, parts | sides.merged, tuple(sorted(tags)))


def _merged_tags(base: DatasetEntry | None, ours: DatasetEntry, theirs: DatasetEntry) -> set[str]:
    """Return the tags that both sides have kept or one side has added."""
    old = set() if base is None else set(base.tags)
    return (old | set(ours.tags) | set(theirs.tags)) - (old - set(ours.tags)) - (old - set(theirs.tags))


def _newer(part: str, of_base: Mapping[str, str], ours: DatasetEntry, theirs: DatasetEntry) -> str | None:
    """Return the content digest of a part on the side that has changed it; None if this side has removed the part."""
    return (theirs if ours.parts.get(part) == of_base.get(part) else ours).parts.get(part)
