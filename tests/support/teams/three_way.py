"""Three-way merges of versions as the documentation describes them, in the simplest form: versions are dictionaries."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar, cast

from tests.support.present import present
from tests.support.teams.contents import Keyframe, Labels, Parts, Segment

from marey_schemas.datasets.merges import Side
from marey_schemas.kinds import Kind

Label = TypeVar("Label", Segment, Keyframe)
Key = tuple[str, Kind]
"""Path and kind."""


class Entry(NamedTuple):
    """Entry of a version."""

    parts: Parts
    tags: frozenset[str]


State = Mapping[Key, Entry]


def by_path(key: Key) -> tuple[str, str]:
    """Return the sort key of an entry: its path and a tab, because no character of a path sorts before a tab."""
    return f"{key[0]}\t", key[1].value


def follow(before: State, after: State) -> dict[Key, Key | None]:
    """Return the key that each entry of `before` has in `after`; None if the entry was removed.

    An entry with an unchanged key and at least one unchanged part is the same entry. Each remaining entry is paired
    with a new entry of the same kind: if possible, with one that has the same content, else with the one at the same
    path, else with one that has an equal part.
    """
    found: dict[Key, Key | None] = {key: key for key in before if key in after and _share(before[key], after[key])}
    gone = sorted((key for key in before if key not in found), key=by_path)
    new = sorted((key for key in after if key not in found), key=by_path)
    _pair(found, gone, new, lambda old, now: before[old].parts == after[now].parts)
    _pair(found, gone, new, lambda old, now: old == now)
    names = {name for key in gone for name, _ in before[key].parts} | {
        name for key in new for name, _ in after[key].parts
    }
    for part in sorted(names, key=lambda name: (name == "info", name)):

        def alike(old: Key, now: Key, part: str = part) -> bool:
            values = dict(before[old].parts).get(part), dict(after[now].parts).get(part)
            return values[0] is not None and values[0] == values[1]

        _pair(found, gone, new, alike)
    return found | dict.fromkeys(gone)


def _share(before: Entry, after: Entry) -> bool:
    return bool(set(before.parts) & set(after.parts))


def _pair(found: dict[Key, Key | None], gone: list[Key], new: list[Key], alike: Callable[[Key, Key], bool]) -> None:
    for now in list(new):
        for old in gone:
            if old[1] == now[1] and alike(old, now):
                found[old] = now
                gone.remove(old)
                new.remove(now)
                break


def changed_entries(before: State, after: State) -> int:
    """Return how many entries differ; an entry that was moved counts once."""
    places = follow(before, after)
    kept = {now for now in places.values() if now is not None}
    differing = sum(now != old or before[old] != after[now] for old, now in places.items())
    return differing + len(after.keys() - kept)


@dataclass
class Merged:
    """Result of a merge; in `state`, entries with an unresolved conflict are as on our side."""

    state: dict[Key, Entry]
    conflicts: list[tuple[Key, tuple[str, ...]]] = field(default_factory=list)
    """For each conflict, the key that its resolution must name, and the parts in conflict. Keys may repeat."""
    decided: set[Key] = field(default_factory=set)
    """Keys of those resolutions that decided a conflict."""


class Located(NamedTuple):
    """Entry at its path."""

    key: Key
    entry: Entry


def _at(state: State, key: Key | None) -> Located | None:
    return None if key is None else Located(key, state[key])


def merge_states(base: State, ours: State, theirs: State, take: Mapping[Key, Side]) -> Merged:
    """Apply the changes from `base` to `theirs` to `ours`; `take` contains the resolutions of conflicts."""
    mine, their = follow(base, ours), follow(base, theirs)
    merged = Merged(dict(ours))
    origins: dict[Key, Origin] = {now: (now, old) for old, now in mine.items() if now is not None}
    results: list[tuple[Origin, Located]] = []
    for three in _changes(base, ours, theirs, mine, their):
        outcome = _decide(*three, take, merged)
        old, before, _ = three
        if outcome == before:
            continue
        stays = before is not None and outcome is not None and outcome.key == before.key
        if before is not None and not stays:
            del merged.state[before.key]
        if outcome is not None and stays:
            merged.state[outcome.key] = outcome.entry
        elif outcome is not None:
            results.append(((before.key if before else None, old.key if old else None), outcome))
    results.sort(key=lambda result: result[1].key != result[0][1])  # those that go back to the base come first
    waiting: list[tuple[Origin, Located]] = []
    for origin, (key, entry) in results:
        if key in merged.state:
            waiting.append((origin, Located(key, entry)))
        else:
            merged.state[key], origins[key] = entry, origin
    _settle(waiting, origins, take, merged)
    return merged


Origin = tuple[Key | None, Key | None]
"""Keys of an entry on our side and in the base."""


def _settle(
    waiting: Iterable[tuple[Origin, Located]], origins: dict[Key, Origin], take: Mapping[Key, Side], merged: Merged
) -> None:
    """Give each key that two entries claim to one of them; the other entry gets its earlier key, if it had one.

    `origins` contains, by key, the origin of each entry in `merged.state`.
    """
    for origin, (key, entry) in waiting:
        choice = None if key in merged.decided else take.get(key)
        if choice is None:
            merged.conflicts.append((key, ("path",)))
            continue
        merged.decided.add(key)
        winner, loser = (origin, entry), (origins.get(key, (key, None)), merged.state[key])
        if choice is not Side.THEIRS:
            winner, loser = loser, winner
        at_ours, at_base = loser[0]
        back = at_base if at_ours in (None, key) else at_ours
        if back in merged.state:
            merged.conflicts.append((key, ("path",)))
            continue
        if back is not None:
            origins[back], merged.state[back] = loser
        origins[key], merged.state[key] = winner


Three = tuple[Located | None, Located | None, Located | None]


def _changes(
    base: State, ours: State, theirs: State, mine: Mapping[Key, Key | None], their: Mapping[Key, Key | None]
) -> list[Three]:
    """Return each entry that differs between `base` and `theirs`, as (base, ours, theirs), in the order of paths.

    If their side has replaced an entry by another one at the same path, the removed entry comes first.
    """
    found: list[Three] = [
        (_at(base, old), _at(ours, mine[old]), _at(theirs, now))
        for old, now in their.items()
        if now != old or base[old] != theirs[now]
    ]
    added_by_us = ours.keys() - set(mine.values())
    found += [
        (None, _at(ours, key if key in added_by_us else None), _at(theirs, key))
        for key in theirs.keys() - set(their.values())
    ]
    return sorted(
        found, key=lambda three: (by_path((present(three[2] or three[0] or three[1])).key), three[2] is not None)
    )


def _decide(
    base: Located | None, ours: Located | None, theirs: Located | None, take: Mapping[Key, Side], merged: Merged
) -> Located | None:
    if theirs in (ours, base):
        return ours
    if ours == base:
        return theirs
    labels, clashes = _clashes(base, ours, theirs)
    if not clashes:
        return _combined(base, ours, theirs, labels, clashes, Side.OURS)
    named = ours or base or theirs
    assert named is not None
    choice = None if named.key in merged.decided else take.get(named.key)  # a resolution decides one conflict only
    if choice is None:
        merged.conflicts.append((named.key, clashes))
        return ours
    merged.decided.add(named.key)
    if choice is Side.BASE:
        return base
    if "entry" in clashes or base is None:
        return ours if choice is Side.OURS else theirs
    return _combined(base, ours, theirs, labels, clashes, choice)


def _clashes(
    base: Located | None, ours: Located | None, theirs: Located | None
) -> tuple[dict[str, Hashable], tuple[str, ...]]:
    """Return the content of each part that could be merged, and the names of the parts in conflict."""
    if ours is None or theirs is None:
        return {}, ("entry",)
    merged: dict[str, Hashable] = {}
    clashing = []
    if base is not None and _excludes(base.key[0], ours.key[0], theirs.key[0]):
        clashing.append("path")
    old, mine, their = (dict(one.entry.parts) if one else {} for one in (base, ours, theirs))
    for name in sorted(old.keys() | mine.keys() | their.keys()):
        three = old.get(name), mine.get(name), their.get(name)
        if not _excludes(*three):
            continue
        labels = merge_labels(*cast(Any, three)) if all(isinstance(one, Labels) for one in three) else None
        if labels is None:
            clashing.append(name)
        else:
            merged[name] = labels
    return merged, tuple(clashing)


def _excludes(base: Hashable, ours: Hashable, theirs: Hashable) -> bool:
    return len({base, ours, theirs}) == 3 or (ours != theirs and base not in (ours, theirs))


def _combined(
    base: Located | None,
    ours: Located | None,
    theirs: Located | None,
    labels: Mapping[str, Hashable],
    clashes: tuple[str, ...],
    choice: Side,
) -> Located:
    """Return the entry with the changes of both sides; for parts in conflict, take the side `choice`."""
    assert ours is not None
    assert theirs is not None
    first, second = (ours, theirs) if choice is Side.OURS else (theirs, ours)
    old, mine, other = (dict(one.entry.parts) if one else {} for one in (base, first, second))
    parts: dict[str, Hashable] = {}
    for name in mine.keys() | other.keys():
        keep = name in clashes or mine.get(name) != old.get(name)
        value = labels.get(name, mine.get(name) if keep else other.get(name))
        if value is not None:
            parts[name] = value
    path = first.key[0] if base is None or "path" in clashes or first.key[0] != base.key[0] else second.key[0]
    before = base.entry.tags if base else frozenset()
    tags = {
        tag
        for tag in before | ours.entry.tags | theirs.entry.tags
        if (tag in ours.entry.tags and tag in theirs.entry.tags) or (tag not in before)
    }
    return Located((path, ours.key[1]), Entry(tuple(sorted(parts.items())), frozenset(tags)))


# -- annotations ------------------------------------------------------------------------------------------------------


def merge_labels(base: Labels, ours: Labels, theirs: Labels) -> Labels | None:
    """Merge the labels of a clip one by one; return None if the changes of the two sides conflict."""
    clips = base.clip, ours.clip, theirs.clip
    if len({dict(one.parts)["motion"] for one in clips}) > 1 or _excludes(*clips):
        return None
    overlap = lambda one, other: one.start < other.end and other.start < one.end  # noqa: E731
    touches = lambda one, other: one.frame == other.frame or one.label == other.label  # noqa: E731
    added_twice = [
        (one, other)
        for one in ours.segments - base.segments
        for other in theirs.segments - base.segments
        if one != other and overlap(one, other)
    ]
    if added_twice or _replaced_twice(base.segments, ours.segments, theirs.segments, overlap):
        return None
    if _replaced_twice(base.keyframes, ours.keyframes, theirs.keyframes, touches):
        return None
    clip = theirs.clip if ours.clip == base.clip else ours.clip
    segments = _kept_or_added(base.segments, ours.segments, theirs.segments)
    return Labels(clip, segments, _kept_or_added(base.keyframes, ours.keyframes, theirs.keyframes))


def _kept_or_added(base: frozenset[Label], ours: frozenset[Label], theirs: frozenset[Label]) -> frozenset[Label]:
    """Return the labels that both sides have kept, and the labels that at least one side has added."""
    return (base & ours & theirs) | (ours - base) | (theirs - base)


def _replaced_twice(
    base: frozenset[Hashable],
    ours: frozenset[Hashable],
    theirs: frozenset[Hashable],
    instead: Callable[[Hashable, Hashable], bool],
) -> bool:
    """Return whether both sides have replaced the same label, but by different labels.

    `instead(new, old)` states whether `new` replaces `old`.
    """
    return any(
        {one for one in ours - base if instead(one, old)} != {one for one in theirs - base if instead(one, old)}
        for old in base - ours - theirs
    )
