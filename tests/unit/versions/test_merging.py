"""Differences and merges of entries: laws of merging, and examples with known results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_schemas.datasets.differences import ChangeKind
from marey_schemas.datasets.merges import Side
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_schemas.names import MOST_TAGS
from marey_versions.annotations import ADDED_TWICE, AnnotationClash
from marey_versions.choices import Choice
from marey_versions.compared import ComparedEntry, compare_entries
from marey_versions.merging import ChangedPart, MergedEntries, merge_entries
from marey_versions.records import DatasetEntry, key_of, revision_content
from marey_versions.tree.chunks import Value
from marey_versions.tree.difference import Changed

State = dict[str, Value]

paths = st.sampled_from(["a", "b", "c", "d", "e"])
digests = st.sampled_from(["1", "2", "3"])
values = st.builds(
    lambda motion, info, tags: {"parts": {"motion": motion} | ({"info": info} if info else {}), "tags": sorted(tags)},
    digests,
    st.none() | digests,
    st.sets(st.sampled_from(["x", "y"])),
)
states = st.dictionaries(paths.map(lambda path: key_of(path, "clip")), values, max_size=5)


@given(st.text(), st.dictionaries(st.text(), st.text(), max_size=4))
def test_the_digest_of_a_content_is_that_of_its_canonical_json(kind: str, parts: dict[str, str]) -> None:
    assert revision_content(kind, parts) == digest_of(canonical_json({"kind": kind, "parts": parts}))


def entry(motion: str, info: str | None = None, *tags: str) -> Value:
    return {"parts": {"motion": motion} | ({"info": info} if info else {}), "tags": sorted(tags)}


def state(**entries: Value) -> State:
    return {key_of(path, "clip"): value for path, value in entries.items()}


def compared(before: State, after: State) -> list[ComparedEntry]:
    changes = [
        Changed(key, before.get(key), after.get(key))
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key)
    ]
    return compare_entries(changes)


def merge(
    base: State,
    ours: State,
    theirs: State,
    resolutions: Mapping[str, Side] | Sequence[tuple[str, Side] | tuple[str, Side, str | None]] = (),
) -> tuple[State, MergedEntries]:
    pairs = list(resolutions.items()) if isinstance(resolutions, Mapping) else resolutions
    choices = [Choice(*cast(Any, one)) for one in pairs]
    merged = merge_entries(compared(base, ours), compared(base, theirs), choices)
    result: dict[str, Value | None] = {**ours, **merged.changes}
    return {key: value for key, value in result.items() if value is not None}, merged


def changes(before: State, after: State) -> list[tuple[ChangeKind, str | None, str | None]]:
    return [
        (one.change, one.before.path if one.before else None, one.after.path if one.after else None)
        for one in compared(before, after)
    ]


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(states, states)
def test_a_difference_turns_one_state_into_the_other(before: State, after: State) -> None:
    found = compared(before, after)
    turned = {key: value for key, value in before.items() if key not in {one.before.key for one in found if one.before}}
    assert not {one.after.key for one in found if one.after} & turned.keys()
    turned |= {one.after.key: one.after.value for one in found if one.after}
    assert turned == after


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(states, states)
def test_merging_with_an_unchanged_side_gives_the_other_side(base: State, changed: State) -> None:
    assert merge(base, base, changed) == (changed, merge(base, base, changed)[1])
    assert merge(base, changed, base)[0] == changed
    assert merge(base, changed, changed)[0] == changed
    assert not merge(base, base, changed)[1].conflicts


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(states, states, states)
def test_the_order_of_the_sides_matters_for_their_names_only(base: State, ours: State, theirs: State) -> None:
    one, merged = merge(base, ours, theirs)
    other, mirrored = merge(base, theirs, ours)
    assert bool(merged.conflicts) == bool(mirrored.conflicts)
    if not merged.conflicts:
        assert one == other


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(states, states, states)
def test_nothing_of_either_side_disappears(base: State, ours: State, theirs: State) -> None:
    """A part that a side has changed is in the result or in a conflict, unless the other side removed the entry."""
    result, merged = merge(base, ours, theirs)
    in_conflict = [side for one in merged.conflicts for side in (one.base, one.ours, one.theirs) if side is not None]
    kept = [parts for value in result.values() for parts in value["parts"].items()]
    kept += [part for side in in_conflict for part in side.parts.items()]
    for side, other in ((ours, theirs), (theirs, ours)):
        removed = {one.before.key for one in compared(base, other) if one.before is not None and one.after is None}
        for one in compared(base, side):
            if one.after is None or (one.before is not None and one.before.key in removed):
                continue
            for part in one.parts:
                if part in one.after.parts:
                    assert (part, one.after.parts[part]) in kept


@st.composite
def histories(draw: st.DrawFn) -> tuple[State, State, State]:
    """A base and two sides that keep, edit, rename, remove and add entries; each entry has a motion of its own."""
    base = {key_of(path, "clip"): entry(path, path) for path in draw(st.sets(paths))}
    sides = []
    for side in ("ours", "theirs"):
        state: State = {}
        for key, value in sorted(base.items()):
            to = draw(st.just(key) | st.none() | paths.map(lambda path: key_of(path, "clip")))
            if to is not None and to not in state:
                state[to] = entry(value["parts"]["motion"], draw(st.sampled_from([value["parts"]["info"], side])))
        for key in sorted({key_of(path, "clip") for path in draw(st.sets(paths))} - state.keys()):
            state[key] = entry(f"{key} of {side}", f"{key} of {side}")
        sides.append(state)
    return base, sides[0], sides[1]


def motions(entries: Iterable[Value]) -> set[str]:
    return {one["parts"]["motion"] for one in entries}


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(histories(), st.lists(st.sampled_from(Side), min_size=20, max_size=20))
def test_no_entry_disappears_by_a_resolution_of_other_entries(
    versions: tuple[State, State, State], choices: list[Side]
) -> None:
    """A person answers the listed conflicts one by one, and also new conflicts that the answers cause."""
    base, ours, theirs = versions
    kept_by_both = motions(ours.values()) & motions(theirs.values())
    resolutions: list[tuple[str, Side]] = []
    shown: set[str] = set()
    for choice in choices:
        result, merged = merge(base, ours, theirs, resolutions)
        expected = (motions(ours.values()) | motions(theirs.values())) - motions(base.values()) | kept_by_both
        shown |= motions(side.value for one in merged.conflicts for side in one[:3] if side is not None)
        assert expected - shown <= motions(result.values())
        if not merged.conflicts:
            break
        resolutions.append((merged.conflicts[0].key, choice))


RESTORED = (
    state(a=entry("1", "1"), b=entry("2", "2")),
    state(b=entry("1", "1")),
    state(a=entry("1", "1"), b=entry("2", "3")),
)
"""A base; our side, which removed `b` and moved `a` to the path of `b`; and their side, which changed `b`."""


def test_a_restored_entry_does_not_replace_one_that_no_conflict_has_shown() -> None:
    base, ours, theirs = RESTORED
    key = key_of("b", "clip")
    assert [(one.key, one.parts) for one in merge(base, ours, theirs)[1].conflicts] == [(key, ("entry",))]
    _, merged = merge(base, ours, theirs, [(key, Side.THEIRS)])
    assert [(one.key, one.parts, one.ours and one.ours.parts) for one in merged.conflicts] == [
        (key, ("path",), entry("1", "1")["parts"])
    ]
    result, merged = merge(base, ours, theirs, [(key, Side.THEIRS)] * 2)
    assert (result, merged.conflicts) == (theirs, [])
    result, merged = merge(base, ours, theirs, [(key, Side.OURS)])
    assert (result, merged.conflicts) == (ours, [])


def test_a_decision_about_an_entry_does_not_remove_the_one_that_was_moved_to_its_place() -> None:
    base, theirs, ours = RESTORED
    key = key_of("b", "clip")
    _, merged = merge(base, ours, theirs)
    assert [(one.key, one.parts) for one in merged.conflicts] == [(key, ("entry",)), (key, ("path",))]
    _, merged = merge(base, ours, theirs, [(key, Side.OURS)])
    assert [(one.key, one.parts) for one in merged.conflicts] == [(key, ("path",))]
    result, merged = merge(base, ours, theirs, [(key, Side.OURS)] * 2)
    assert (result, merged.conflicts) == (ours, [])
    _, merged = merge(base, ours, theirs, [(key, Side.OURS), (key, Side.THEIRS)])
    assert [(one.parts, one.no_way_back) for one in merged.conflicts] == [(("path",), "b")]
    result, merged = merge(base, ours, theirs, [(key, Side.THEIRS)])
    assert (result, merged.conflicts) == (theirs, [])


@pytest.mark.parametrize(
    ("take", "expected"),
    [
        (Side.OURS, state(z=entry("1"), b=entry("2"))),
        (Side.BASE, state(z=entry("1"), b=entry("2"))),
        (Side.THEIRS, state(a=entry("1"), z=entry("2"))),
    ],
)
def test_the_entry_that_does_not_get_a_place_keeps_its_own(take: Side, expected: State) -> None:
    base = state(a=entry("1"), b=entry("2"))
    result, merged = merge(
        base, state(z=entry("1"), b=entry("2")), state(a=entry("1"), z=entry("2")), [(key_of("z", "clip"), take)]
    )
    assert (result, merged.conflicts) == (expected, [])


def test_an_entry_whose_own_place_is_taken_stays_in_conflict() -> None:
    base, key = state(a=entry("1"), b=entry("2"), c=entry("3")), key_of("z", "clip")
    ours, theirs = state(z=entry("1"), b=entry("2"), c=entry("3")), state(a=entry("1"), z=entry("2"), b=entry("3"))
    result, merged = merge(base, ours, theirs, [(key, Side.OURS)])
    assert [(one.key, one.no_way_back) for one in merged.conflicts] == [(key, "b")]
    result, merged = merge(base, ours, theirs, [(key, Side.THEIRS)])
    assert (result, merged.conflicts) == (theirs, [])


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(states, states, states, st.none() | st.sampled_from(Side))
def test_each_content_is_that_of_a_side_or_is_listed_as_combined(
    base: State, ours: State, theirs: State, take: Side | None
) -> None:
    """A combined entry has parts of both sides, so its content is not stored yet and must be listed."""
    _, undecided = merge(base, ours, theirs)
    resolutions = {one.key: take for one in undecided.conflicts} if take else {}
    result, merged = merge(base, ours, theirs, resolutions)
    of_sides = [value["parts"] for side in (base, ours, theirs) for value in side.values()]
    combined = {one.entry.key: one for one in merged.combined}
    for key, value in result.items():
        assert value["parts"] in of_sides or combined[key].entry.value == value
    for one in combined.values():
        assert all(one.source_of(part) in one.sides[:2] for part in one.entry.parts)


def model(model: str, tree: str | None, report: str | None = None) -> Value:
    made = {"tree": tree, "report": report}
    return {"parts": {"model": model} | {part: digest for part, digest in made.items() if digest}, "tags": []}


@pytest.mark.parametrize(
    ("ours", "theirs", "parts"),
    [
        (model("2", "1"), model("1", "2"), ["model", "tree"]),
        (model("1", "2"), model("2", "1"), ["model", "tree"]),
        (model("2", None), model("1", "2"), ["model", "tree"]),
        (model("2", "2"), model("1", "1", "1"), ["model", "report", "tree"]),
        (model("2", "1"), model("3", "1"), ["model"]),
    ],
)
def test_a_part_is_not_combined_with_another_version_of_what_it_was_made_from(
    ours: Value, theirs: Value, parts: list[str]
) -> None:
    key = key_of("a", "model")
    sides = {key: model("1", "1")}, {key: ours}, {key: theirs}
    _, merged = merge(*sides)
    assert [list(one.parts) for one in merged.conflicts] == [parts]
    for side, value in ((Side.OURS, ours), (Side.THEIRS, theirs)):
        assert (
            merge(*sides, {key: side})[0][key]["parts"].items()
            >= {part: value["parts"][part] for part in parts if part in value["parts"]}.items()
        )


def test_parts_that_were_made_from_one_model_are_combined() -> None:
    key = key_of("a", "model")
    result, merged = merge({key: model("1", "1")}, {key: model("1", "2")}, {key: model("1", "1", "2")})
    assert result == {key: model("1", "2", "2")}
    assert [one.entry.key for one in merged.combined] == [key]


def test_renames_are_recognised_by_content() -> None:
    before = state(a=entry("1", "1"), b=entry("2"), c=entry("3"))
    assert changes(before, state(z=entry("1", "1"), b=entry("2"), c=entry("3"))) == [("moved", "a", "z")]
    assert changes(before, state(z=entry("1", "9"), b=entry("2"), c=entry("3"))) == [("moved", "a", "z")]
    assert changes(before, state(a=entry("1", "1"), b=entry("3"), c=entry("2"))) == [
        ("moved", "c", "b"),
        ("moved", "b", "c"),
    ]
    assert changes(before, state(a=entry("9"), b=entry("2"), c=entry("3"), d=entry("1", "1"))) == [
        ("added", None, "a"),
        ("moved", "a", "d"),
    ]


def test_one_side_renames_and_the_other_changes_the_content() -> None:
    base = state(a=entry("1", "1"))
    result, merged = merge(base, state(z=entry("1", "1")), state(a=entry("2", "1", "x")))
    assert (result, merged.conflicts) == (state(z=entry("2", "1", "x")), [])


def test_different_parts_of_one_entry_are_combined_and_tags_one_by_one() -> None:
    base = state(a=entry("1", "1", "old", "kept"))
    result, merged = merge(base, state(a=entry("2", "1", "kept", "x")), state(a=entry("1", "2", "old", "kept", "y")))
    assert (result, merged.conflicts) == (state(a=entry("2", "2", "kept", "x", "y")), [])


def test_conflicts_name_the_parts_and_are_decided_part_by_part() -> None:
    base, key = state(a=entry("1", "1")), key_of("a", "clip")
    ours, theirs = state(a=entry("2", "1", "x")), state(a=entry("3", "2"))
    _, merged = merge(base, ours, theirs)
    assert [(one.key, one.parts) for one in merged.conflicts] == [(key, ("motion",))]
    assert merge(base, ours, theirs, {key: Side.OURS})[0] == state(a=entry("2", "2", "x"))
    assert merge(base, ours, theirs, {key: Side.THEIRS})[0] == state(a=entry("3", "2", "x"))
    assert merge(base, ours, theirs, {key: Side.BASE})[0] == base


def test_each_part_of_a_conflict_is_decided_by_its_own_resolution() -> None:
    base, key = state(a=entry("1", "1", "x")), key_of("a", "clip")
    ours, theirs = state(a=entry("2", "2", "x")), state(a=entry("3", "3", "x"))
    sides = base, ours, theirs
    assert merge(*sides, [(key, Side.OURS, "motion"), (key, Side.THEIRS, "info")])[0] == state(a=entry("2", "3", "x"))
    result, merged = merge(*sides, [(key, Side.BASE, "info"), (key, Side.THEIRS, "motion")])
    assert result == state(a=entry("3", "1", "x"))
    assert [one.source_of("info") for one in merged.combined] == [DatasetEntry("a", "clip", base[key]["parts"], ("x",))]
    result, merged = merge(*sides, [(key, Side.OURS, "motion")])
    assert (result, [one.parts for one in merged.conflicts], merged.unused) == (ours, [("info",)], [])
    for extra in (Choice(key, Side.OURS, "motion"), Choice(key, Side.OURS), Choice(key, Side.OURS, "tags")):
        merged = merge(*sides, [(key, Side.OURS, "motion"), (key, Side.THEIRS, "info"), extra])[1]
        assert (merged.conflicts, merged.unused) == ([], [extra])
    assert merge(*sides, [(key, Side.OURS, "path")])[1].unused == [Choice(key, Side.OURS, "path")]


def test_the_path_is_decided_apart_from_the_content() -> None:
    base, key = state(a=entry("1", "1")), key_of("b", "clip")
    sides = base, state(b=entry("2", "1")), state(c=entry("3", "1"))
    assert merge(*sides)[1].conflicts[0].parts == ("path", "motion")
    assert merge(*sides, [(key, Side.THEIRS, "path"), (key, Side.OURS, "motion")])[0] == state(c=entry("2", "1"))
    assert merge(*sides, [(key, Side.BASE, "path"), (key, Side.THEIRS, "motion")])[0] == state(a=entry("3", "1"))


def test_a_part_that_the_base_lacks_is_not_taken_from_it() -> None:
    key = key_of("a", "clip")
    sides = state(), state(a=entry("1", "1")), state(a=entry("2", "2"))
    assert merge(*sides, [(key, Side.OURS, "motion"), (key, Side.THEIRS, "info")])[0] == state(a=entry("1", "2"))
    assert merge(*sides, [(key, Side.BASE, "motion")])[1].unused == [Choice(key, Side.BASE, "motion")]
    assert merge(*sides, [(key, Side.BASE)])[0] == state()


def test_a_resolution_of_a_part_decides_what_was_made_from_it() -> None:
    key = key_of("a", "model")
    sides = {key: model("1", "1")}, {key: model("2", "2")}, {key: model("3", "3")}
    assert merge(*sides, [(key, Side.THEIRS, "tree")])[0] == sides[2]
    assert merge(*sides, [(key, Side.OURS, "model"), (key, Side.THEIRS, "tree")])[1].unused != []


def test_everything_that_was_made_from_a_model_is_decided_together_with_it() -> None:
    """Our side has a new model with its tree, and their side another report of the model in the base."""
    key = key_of("a", "model")
    base, ours, theirs = {key: model("1", "1", "1")}, {key: model("2", "2", "1")}, {key: model("1", "1", "2")}
    assert merge(base, ours, theirs)[1].conflicts[0].parts == ("model", "report", "tree")
    for part in (None, "model", "report", "tree"):
        assert merge(base, ours, theirs, [(key, Side.OURS, part)])[0] == ours
        assert merge(base, ours, theirs, [(key, Side.THEIRS, part)])[0] == theirs
        assert merge(base, ours, theirs, [(key, Side.BASE, part)])[0] == base


def test_a_part_that_both_sides_removed_is_taken_from_the_base_with_what_it_was_made_from() -> None:
    key = key_of("a", "model")
    sides = {key: model("1", None, "1")}, {key: model("2", None)}, {key: model("1", None)}
    assert merge(*sides)[1].conflicts[0].parts == ("model", "report")
    assert merge(*sides, [(key, Side.BASE, "report")])[0] == sides[0]


@settings(max_examples=examples(100, soak=300), deadline=None)
@given(states, states, states, st.sampled_from([Side.OURS, Side.THEIRS]))
@example(
    state(a=entry("1"), b=entry("2", "1")),
    state(a=entry("1", None, "x"), b=entry("1")),
    state(a=entry("2", "1")),
    Side.THEIRS,
)
def test_the_same_side_for_every_part_is_that_side_for_the_conflict(
    base: State, ours: State, theirs: State, side: Side
) -> None:
    conflicts = merge(base, ours, theirs)[1].conflicts
    whole = [(one.key, side) for one in conflicts]
    apart = [(one.key, side, part) for one in conflicts for part in one.parts]
    (result, merged), (same, again) = merge(base, ours, theirs, whole), merge(base, ours, theirs, apart)
    added_twice = any(one.base is None and one.parts != ("path",) for one in conflicts)  # then a side is taken whole
    if not merged.conflicts and not added_twice:
        unused = [one.key for one in merged.unused]  # of conflicts that the other resolutions have removed
        assert (same, again.conflicts, [one.key for one in again.unused]) == (result, [], unused)


def test_more_tags_than_an_item_can_have_are_a_conflict() -> None:
    many = [f"tag {number}" for number in range(MOST_TAGS)]
    base, key = state(a=entry("1", None, *many[1:])), key_of("a", "clip")
    ours, theirs = state(a=entry("1", None, *many)), state(a=entry("2", None, *many[1:], "theirs"))
    _, merged = merge(base, ours, theirs)
    assert [(one.key, one.parts) for one in merged.conflicts] == [(key, ("tags",))]
    assert merge(base, ours, theirs, {key: Side.OURS})[0] == state(a=entry("2", None, *many))
    assert merge(base, ours, theirs, {key: Side.THEIRS})[0] == theirs
    fewer = state(a=entry("1", None, *many[2:], "ours"))
    assert not merge(base, fewer, theirs)[1].conflicts


def test_a_removed_entry_that_the_other_side_changed_is_a_conflict() -> None:
    base, key = state(a=entry("1")), key_of("a", "clip")
    _, merged = merge(base, {}, state(a=entry("2")))
    assert [one.parts for one in merged.conflicts] == [("entry",)]
    assert merge(base, {}, state(a=entry("2")), {key: Side.OURS})[0] == {}
    assert merge(base, {}, state(a=entry("2")), {key: Side.THEIRS})[0] == state(a=entry("2"))


def test_two_entries_that_come_to_one_place_are_a_conflict() -> None:
    base = state(a=entry("1"), b=entry("2"))
    ours, theirs = state(z=entry("1"), b=entry("2")), state(a=entry("1"), z=entry("2"))
    _, merged = merge(base, ours, theirs)
    assert [(one.key, one.parts) for one in merged.conflicts] == [(key_of("z", "clip"), ("path",))]


def test_documents_of_parts_that_both_sides_have_changed_are_merged() -> None:
    """Other parts, tags and paths of an entry are merged as usual."""
    base, key = state(a=entry("1", "1"), b=entry("5")), key_of("b", "clip")
    ours, theirs = state(a=entry("2", "1", "x"), b=entry("6")), state(a=entry("3", "2"), b=entry("7"))
    asked: list[ChangedPart] = []

    def merge_parts(changed: Sequence[ChangedPart]) -> list[str | AnnotationClash | None]:
        asked.extend(changed)
        return ["23" if one.ours.path == "a" else ADDED_TWICE for one in changed]

    merged = merge_entries(compared(base, ours), compared(base, theirs), (), merge_parts)
    assert [(one.part, one.ours.path) for one in asked] == [("motion", "a"), ("motion", "b")]
    assert merged.changes == {key_of("a", "clip"): entry("23", "2", "x")}
    assert [one.entry.path for one in merged.combined] == ["a"]
    assert [(one.key, one.parts, one.clash) for one in merged.conflicts] == [(key, ("motion",), ADDED_TWICE)]


@pytest.mark.parametrize(
    ("take", "path", "motion"), [(Side.OURS, "y", "23"), (Side.THEIRS, "z", "23"), (Side.BASE, "a", "1")]
)
def test_a_merged_document_is_kept_where_a_side_decides_the_path(take: Side, path: str, motion: str) -> None:
    base, ours, theirs = (
        DatasetEntry(at, "clip", {"motion": digest, "info": "1"}, ())
        for at, digest in (("a", "1"), ("y", "2"), ("z", "3"))
    )
    sides = [ComparedEntry(base, ours)], [ComparedEntry(base, theirs)]
    undecided = merge_entries(*sides, (), lambda changed: ["23" for _ in changed])
    assert [one.parts for one in undecided.conflicts] == [("path",)]
    merged = merge_entries(*sides, [Choice(ours.key, take)], lambda changed: ["23" for _ in changed])
    expected = {key_of(path, "clip"): {"parts": {"motion": motion, "info": "1"}, "tags": []}}
    assert {key: value for key, value in merged.changes.items() if value is not None} == expected


def test_an_entry_is_what_its_key_and_value_say() -> None:
    one = DatasetEntry("raw/a", "clip", {"motion": "1"}, ("x",))
    assert (one.key, one.value) == ("raw/a\tclip", {"parts": {"motion": "1"}, "tags": ["x"]})
