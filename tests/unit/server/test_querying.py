"""Queries in SQL select the same items as a direct evaluation of their conditions."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date, datetime, timedelta
from itertools import cycle, repeat
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from sqlalchemy import event, update
from tests.support.kept_rows import made_once
from tests.support.store_fixtures import Lab, motion_tree, skeleton_tree
from tests.support.tiers import examples, is_soak

from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.queries.fields import FIELDS, OPERATORS, field_names, find_field
from marey_schemas.queries.grammar import Condition, Junction, Negation, Query, parse
from marey_schemas.queries.matching import QueriedFacts, matches
from marey_server.errors import BadRequestProblem
from marey_server.store import items, projects
from marey_server.store.database.connections import Database
from marey_server.store.items import ItemFilters, narrowing
from marey_server.store.items.facets import publish_facets
from marey_server.store.tables import INDEXED_FACTS
from marey_server.store.tables import item as item_table
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

LONG = "walks " * 20  # more than an index stores
INFOS: tuple[dict[str, Any], ...] = (
    {"subject": "02", "action": "Walk, slow", "licence": "CC-BY 4.0", "select": "best", "shoot_day": "2025-02-28"},
    {"subject": "2", "action": "walk", "take": "7b", "shoot_day": "2025-03-01", "consent_until": "2026-01-31"},
    {"action": "Übung 100%", "checks": [{"code": "foot-slide", "message": "m"}], "capture_system": "Vicon_8"},
    {"action": f"{LONG} there", "subject": "02"},
    {"action": f"{LONG} back", "subject": "02", "licence": "CC-BY 4.0"},
    {"checks": [{"code": "foot", "message": "m"}, {"code": "gap", "message": "m"}], "select": "no good"},
    {},
)
PLACES = ("", "raw", "raw/day 1", "rawer")
TAGS = ((), ("night",), ("night", "day"))
TEXTS = (
    "02", "2", "walk", "WALK", "Walk, slow", "%", "_", "Übung", "übung", "raw", "raw/day 1", "take-1", "raw/take-1",
    "night", "day", "foot-slide", "foot", "gap", ",", '"', "best", "no good", "rig", "RIG", "", f"{LONG} there", LONG,
)  # fmt: skip
NUMBERS = ("0", "1", "3", "4.5", "120", "0.025", "1e3")
DATES = ("2025-02-28", "2025-03-01", "2025-03-01T10:00", "2026-01-31", "1999-12-31", "2999-01-01")


class QueriedLab(Lab):
    """Project with clips in all combinations of folders and take records, on two skeletons."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        rigs = [self.add_skeleton("rig"), self.add_skeleton("Other_rig", joints=4)]
        for number, info in enumerate(INFOS * len(PLACES)):
            joints = 3 + number % 2
            self.add_clip(
                rigs[number % 2],
                f"take-{number}",
                collection=PLACES[number % len(PLACES)],
                tags=TAGS[number % len(TAGS)],
                frames=2 + number % 4,
                joints=joints,
                seed=number,
                info={"schema": "marey/clip-info@1", **info} if info else None,
            )
        self.rigs = {rig.id: rig.name for rig in rigs}
        self.write(self._measure)
        self.clips: list[Item] = self.read(items.list_items, "lab", Kind.CLIP, limit=100).items

    def _measure(self, tx: Transaction) -> None:
        """Publish facets of every third clip; then revise two of these clips, and publish new facets of one of them."""
        project = projects.require(tx, "lab")
        measured = items.list_items(tx, "lab", Kind.CLIP, sort="name", limit=100).items[::3]
        for number, clip in enumerate(measured):
            values = {"usage": number / 2} if number % 2 else {"usage": 1.0, "used_frames": 0.025}
            publish_facets(tx, project.id, [[clip.id, 1, values]])
        for clip in measured[:2]:
            info = {"schema": "marey/clip-info@1", "comment": "changed"}
            items.put_part(tx, "lab", Kind.CLIP, clip.id, "info", info, expected_rev=None)
        publish_facets(tx, project.id, [[measured[1].id, 2, {"usage": 4.5}]])


@pytest.fixture
def queried(database: Database) -> QueriedLab:
    return made_once(QueriedLab, database)


def values_of(lab: QueriedLab, clip: Item, field: str) -> list[Any]:
    """Return the values that a clip has for a field."""
    summary = clip.summary
    known: dict[str, list[Any]] = {
        "name": [clip.name],
        "path": [clip.path],
        "tag": list(clip.tags),
        "revision": [clip.revision],
        "created": [clip.created_at],
        "updated": [clip.updated_at],
        "frames": [summary["frames"]],
        "duration": [summary["duration_s"]],
        "rate": [summary["frame_rate_hz"]],
        "joints": [summary["joints"]],
        "skeleton": [lab.rigs[summary["skeleton"]], summary["skeleton"]],
        "warning": summary["warnings"],
        "folder": [clip.collection] if clip.collection else [],
    }
    if field.startswith("facet."):
        return [value for name, value in clip.facets.items() if field == f"facet.{name}"]
    return known[field] if field in known else [summary[field]] if field in summary else []


def facts_of(lab: QueriedLab, clip: Item) -> QueriedFacts:
    return QueriedFacts(
        name=clip.name, folder=clip.collection, tags=clip.tags, revision=clip.revision, created_at=clip.created_at,
        updated_at=clip.updated_at, summary=clip.summary, frames=clip.summary["frames"],
        skeleton=clip.summary["skeleton"], skeleton_name=lab.rigs[clip.summary["skeleton"]], facets=clip.facets,
    )  # fmt: skip


def folded(field: str, text: str) -> str:
    return text.casefold() if field in ("name", "skeleton") else "".join(c.lower() if c.isascii() else c for c in text)


def meets(field: str, operator: str, value: Any, wanted: Any) -> bool:
    """Return whether the value of a clip's field meets the condition `operator` `wanted`."""
    if operator == "~":
        return folded(field, wanted) in folded(field, value)
    if field == "folder":
        path = wanted.strip("/")
        return not path or value == path or value.startswith(f"{path}/")
    if isinstance(wanted, date) and isinstance(value, str):  # a day
        value, wanted = date.fromisoformat(value), date(wanted.year, wanted.month, wanted.day)
    elif isinstance(wanted, date) and not isinstance(wanted, datetime):
        value = value.date()
    compared: bool = {
        "=": value == wanted,
        "<": operator == "<" and value < wanted,
        "<=": operator == "<=" and value <= wanted,
        ">": operator == ">" and value > wanted,
        ">=": operator == ">=" and value >= wanted,
    }[operator]
    return compared


def selects(lab: QueriedLab, query: Query, clip: Item) -> bool:
    """Return whether a query selects a clip."""
    if isinstance(query, Negation):
        return not selects(lab, query.query, clip)
    if isinstance(query, Junction):
        return (all if query.word == "and" else any)(selects(lab, part, clip) for part in query.queries)
    assert isinstance(query, Condition)
    values = values_of(lab, clip, query.field)
    if query.operator == "has":
        return bool(values)
    if query.field == "folder" and not values:
        values = [""]
    if query.field == "skeleton" and query.operator == "~":
        values = values[:1]
    return any(meets(query.field, query.operator, value, wanted) for value in values for wanted in query.values)


def quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


@st.composite
def conditions(draw: st.DrawFn) -> str:
    name = draw(st.sampled_from(field_names()))
    field = find_field(name)
    assert field is not None
    operator = draw(st.sampled_from(OPERATORS[field.type]))
    pool = {"text": tuple(map(quoted, TEXTS)), "number": NUMBERS, "date": DATES}[field.type]
    value = st.sampled_from(pool)
    if operator == "has":
        return f"has {name}"
    if operator == "in":
        return f"{name} in ({', '.join(draw(st.lists(value, min_size=1, max_size=3)))})"
    return f"{name} {operator} {draw(value)}"


queries = st.recursive(
    conditions(),
    lambda inner: (
        st.builds("not ({})".format, inner)
        | st.builds("({}) {} ({})".format, inner, st.sampled_from(["and", "or"]), inner)
    ),
    max_leaves=5,
)


@given(queries, st.sampled_from([0, 3, 1000]))
@example('path = "take-4" or path = "raw/take-1" or path = "rawer/take-3"', 1000)
@example('warning = "foot" and not warning = "foot-slide"', 1000)
@example("created >= 2999-01-01 or not updated < 2999-01-01", 1000)
@example(f'(action = "{LONG} back" and has licence) and subject = 02', 3)
@example("facet.usage > 0.5 and not facet.used_frames in (1, 0.025)", 3)
@example("facet.usage != 1 and has facet.usage", 0)
@example("subject = 02 and not action ~ walk and tag = night", 1000)
@example("frames > 4.5 and frames <= 1e14 and not frames < -1e14", 1000)
@example("frames in (4.5, 5, 1e14) or not frames >= 5.5", 1000)
@example("frames < 4.5 and not frames > 5", 1000)
@example("shoot_day = 2025-03-01T10:00", 1000)
@example("shoot_day = 2025-03-01T10:00", 0)
@example("shoot_day in (2025-02-28, 2025-03-01T10:00)", 1000)
@example("action in (walk, Übung) and subject in (02, 2)", 3)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(50, soak=150))
def test_sql_selects_what_the_conditions_say(queried: QueriedLab, text: str, few: int) -> None:
    query = parse(text)
    expected = {clip.id for clip in queried.clips if selects(queried, query, clip)}
    filters = ItemFilters(query=text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(narrowing, "MOST_ITEMS", few)
        found = queried.read(items.list_items, "lab", Kind.CLIP, filters, limit=100, count=True)
    assert {clip.id for clip in found.items} == expected
    assert found.count == len(expected)
    assert {clip.id for clip in queried.clips if matches(query, facts_of(queried, clip))} == expected
    explained = queried.read(items.explain_query, "lab", Kind.CLIP, ItemFilters(), text)
    assert (explained.items, explained.selected) == (len(queried.clips), len(expected))
    parts = [parse(part.condition) for part in explained.conditions]
    for number, part in enumerate(explained.conditions):
        met = [[selects(queried, one, clip) for one in parts] for clip in queried.clips]
        assert part.hides == sum(not row[number] for row in met)
        assert part.alone == sum(not row[number] and sum(row) == len(parts) - 1 for row in met)


def test_fields_of_times_compare_with_the_time_of_the_item(queried: QueriedLab) -> None:
    now = queried.clips[0].created_at
    day = now.date()

    def selected(text: str) -> int:
        return len(queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query=text), limit=100).items)

    everything = len(queried.clips)
    assert selected(f"created = {day} or created = {day + timedelta(days=1)}") == everything
    assert selected(f"created < {day}") == 0
    assert selected(f"created > {day - timedelta(days=1)} and not created > {day + timedelta(days=1)}") == everything
    assert selected(f"created <= {queried.clips[0].created_at.isoformat()}") == everything


ODD = ("text", 10**400, {"a": "b"})
"""Values that a document of a model may put into its summary."""
CONVERTED = ("rate", "duration", "joints", "shoot_day", "consent_until")
"""Fields whose values in the summary the database converts to numbers or days; a value may be impossible to convert."""


@pytest.mark.every_nth(3)
@pytest.mark.parametrize("value", ODD, ids=str)
def test_odd_values_in_a_summary_break_no_query(queried: QueriedLab, value: object) -> None:
    names = ("frame_rate_hz", "duration_s", "joints", "warnings", "subject", "shoot_day", "consent_until", "action")
    odd = queried.clips[0]
    with queried.database.engine.begin() as connection:
        changed = update(item_table).where(item_table.c.id == odd.id).values(summary=dict.fromkeys(names, value))
        connection.execute(changed)
    for number, (name, operator) in enumerate(operated_fields()):
        if name not in CONVERTED and number % len(ODD) != ODD.index(value) and not is_soak():
            continue  # one of the odd values is enough
        pool = {"text": "walk", "number": "1", "date": "2025-02-28"}[FIELDS[name].type]
        condition = {"has": f"has {name}", "in": f"{name} in ({pool})"}.get(operator, f"{name} {operator} {pool}")
        for text in (condition, f"not {condition}"):
            items_found = queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query=text), limit=100).items
            assert len(items_found) <= len(queried.clips)


def operated_fields() -> list[tuple[str, str]]:
    """Return all pairs of a field and an operator; pairs with the same operator follow each other."""
    pairs = [(name, operator) for name, field in FIELDS.items() for operator in OPERATORS[field.type]]
    return sorted(pairs, key=lambda pair: (pair[1], pair[0]))


def test_a_query_that_cannot_be_read_is_refused_with_its_place(queried: QueriedLab) -> None:
    for function, more in ((items.list_items, ()), (items.explain_query, ("frames >",))):
        with pytest.raises(BadRequestProblem, match="query, column 9") as refused:
            queried.read(function, "lab", Kind.CLIP, ItemFilters(query="frames >"), *more)
        assert refused.value.error_code == "bad-query"


def test_clips_that_an_index_found_are_selected_beside_other_conditions(
    queried: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "like(a:1) < 1 and not like(b:1) < 1 and frames > 2"
    first, second = ({clip.id for clip in queried.clips[start::2]} for start in (0, 3))
    alike = {"like(a:1) < 1": frozenset(first), "like(b:1) < 1": frozenset([*second, *map(str, range(9_000))])}
    filters = ItemFilters(query=text, alike=alike)
    expected = {clip.id for clip in queried.clips if clip.summary["frames"] > 2} & first - second
    assert expected
    for few in (0, 1000):
        monkeypatch.setattr(narrowing, "MOST_ITEMS", few)
        found = queried.read(items.list_items, "lab", Kind.CLIP, filters, limit=100, count=True)
        assert {clip.id for clip in found.items} == expected
        assert found.count == len(expected)
    told = queried.read(items.explain_query, "lab", Kind.CLIP, ItemFilters(alike=alike), text)
    assert (told.items, told.selected) == (len(queried.clips), len(expected))
    with pytest.raises(BadRequestProblem, match=r"column 1: like.* only lists of clips accept it"):
        queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query=text))


def test_a_cursor_belongs_to_its_query(queried: QueriedLab) -> None:
    page = queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query="frames > 2"), limit=2)
    with pytest.raises(BadRequestProblem):
        queried.read(
            items.list_items, "lab", Kind.CLIP, ItemFilters(query="frames > 3"), limit=2, cursor=page.next_cursor
        )


def test_skeletons_of_other_projects_have_no_names_here(queried: QueriedLab, database: Database) -> None:
    other = Lab(database, "elsewhere")
    other.add_skeleton("secret")

    def pages() -> Iterator[int]:
        for text in ("skeleton = secret", "skeleton ~ secret"):
            yield len(queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query=text)).items)

    assert list(pages()) == [0, 0]


SHARED_VALUES = {
    "subject": "02", "action": "walk", "take": "7b", "licence": '"CC-BY 4.0"', "shoot_day": "2025-03-01",
}  # fmt: skip
READS_ALL = "(project_id=? AND kind=?)"
"""Text that SQLite's query plan contains if the statement reads all clips."""


@pytest.mark.parametrize(
    ("field", "sort", "few"),
    [*zip(INDEXED_FACTS, cycle(["-created_at", "name", "-frames"]), repeat(1000)), ("subject", "-created_at", 0)],
)
def test_clips_with_a_value_are_found_through_an_index(
    queried: QueriedLab, monkeypatch: pytest.MonkeyPatch, field: str, sort: str, few: int
) -> None:
    if not queried.database.is_sqlite:
        return  # Postgres reads so few rows without an index
    monkeypatch.setattr(narrowing, "MOST_ITEMS", few)
    counting, listing, *_ = queried.read(plans_of, f"{field} = {SHARED_VALUES[field]} and rate > 2", sort)
    for plan in (counting, listing):
        assert f"ix_item_by_{field}" in plan
        assert READS_ALL not in plan


@pytest.mark.parametrize("sort", ["-created_at", "name", "-frames"])
@pytest.mark.parametrize(
    ("query", "index"),
    [
        ("frames > 2.5", "frames"),
        ("frames = 5", "frames"),
        ("frames in (4, 5)", "frames"),
        ("created >= 2020-01-01", "creation"),
        ("updated < 2999-01-01T10:00", "update"),
    ],
)
def test_clips_in_a_range_are_found_through_an_index_if_they_are_few(
    queried: QueriedLab, query: str, index: str, sort: str
) -> None:
    if not queried.database.is_sqlite:
        return  # as above
    counting, listing, *_ = queried.read(plans_of, f"{query} and rate > 2", sort)
    for plan in (counting, listing):
        assert f"COVERING INDEX ix_item_by_{index} (project_id=? AND kind=? AND " in plan
        assert READS_ALL not in plan


@pytest.mark.parametrize(("sort", "index"), [("-created_at", "creation"), ("name", "name")])
def test_many_clips_in_a_range_are_read_in_the_order_of_the_list(
    queried: QueriedLab, monkeypatch: pytest.MonkeyPatch, sort: str, index: str
) -> None:
    if not queried.database.is_sqlite:
        return  # as above
    monkeypatch.setattr(narrowing, "MOST_ITEMS", 0)
    counting, listing, *_ = queried.read(plans_of, "frames > 2 and rate > 2", sort)
    assert "COVERING INDEX ix_item_by_frames" in counting
    assert f"ix_item_by_{index}" in listing
    assert "TEMP B-TREE" not in listing


@pytest.mark.parametrize("field", INDEXED_FACTS)
@pytest.mark.parametrize("few", [1000, 0])
def test_clips_with_one_of_several_values_are_found_through_an_index_if_they_are_few(
    queried: QueriedLab, monkeypatch: pytest.MonkeyPatch, field: str, few: int
) -> None:
    if not queried.database.is_sqlite:
        return  # as above
    monkeypatch.setattr(narrowing, "MOST_ITEMS", few)
    query = f"{field} in ({SHARED_VALUES[field]}, 1999-12-31)"
    counting, listing, *_ = queried.read(plans_of, query, "-created_at")
    for plan in (counting, listing) if few else (counting,):
        assert f"ix_item_by_{field}" in plan
        assert READS_ALL not in plan


def test_a_frequent_value_is_looked_up_only_in_the_order_of_its_index(
    queried: QueriedLab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(narrowing, "MOST_ITEMS", 0)
    for sort, looked_up in (("-created_at", True), ("created_at", True), ("name", False), ("-updated_at", False)):
        _, (listing, _), *_ = queried.read(statements_of, "subject = 02", sort)
        assert ("substr(" in listing) == looked_up


def plans_of(tx: Transaction, query: str, sort: str) -> list[str]:
    """Return how SQLite runs each of the statements that list the first page of a query."""
    explained = [
        tx.connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {one}", given)
        for one, given in statements_of(tx, query, sort)
    ]
    return [" ".join(row.detail for row in rows) for rows in explained]


def statements_of(tx: Transaction, query: str, sort: str) -> list[tuple[str, Any]]:
    """Return the statements about items that list the first page of a query, with their parameters."""
    found: list[tuple[str, Any]] = []

    def watch(_: Any, __: Any, statement: str, parameters: Any, *___: Any) -> None:
        if "FROM item" in statement:
            found.append((statement, parameters))

    event.listen(tx.connection, "before_cursor_execute", watch)
    items.list_items(tx, "lab", Kind.CLIP, ItemFilters(query=query), sort=sort)
    event.remove(tx.connection, "before_cursor_execute", watch)
    return found


def test_a_clip_may_state_a_fact_that_is_too_long_for_an_index(queried: QueriedLab) -> None:
    digits = "".join(map(str, np.random.default_rng(0).integers(0, 10**9, 1000)))  # no database can compress it much
    rig = next(iter(queried.rigs))
    info = {"schema": "marey/clip-info@1", "action": digits}
    parts = {"motion": motion_tree({"item": rig, "revision": 1}), "info": info}
    made = queried.write(items.create_item, "lab", Kind.CLIP, ItemCreate(name="long", parts=parts))
    for query, expected in ((f'action = "{digits[:1900]}"', []), (f'action ~ "{digits[:1900]}"', [made.id])):
        found = queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query=query)).items
        assert [clip.id for clip in found] == expected


def test_a_page_of_a_tag_shows_no_items_of_other_projects_and_kinds(queried: QueriedLab, database: Database) -> None:
    other = Lab(database, "elsewhere")
    other.add_clip(other.add_skeleton("rig"), "foreign", tags=("night",))
    rig = ItemCreate(name="tagged", tags=("night",), parts={"hierarchy": skeleton_tree()})
    queried.write(items.create_item, "lab", Kind.SKELETON, rig)
    found = queried.read(items.list_items, "lab", Kind.CLIP, ItemFilters(query="tag = night"), limit=100, count=True)
    assert {clip.id for clip in found.items} == {clip.id for clip in queried.clips if "night" in clip.tags}
    assert found.count == len(found.items)


def test_a_query_finds_a_deleted_clip_only_among_deleted_ones(queried: QueriedLab) -> None:
    gone = next(clip for clip in queried.clips if clip.summary.get("take") == "7b")
    queried.write(items.delete_item, "lab", Kind.CLIP, gone.id, expected_rev=gone.rev)

    def finds(deleted: bool) -> bool:
        filters = ItemFilters(query='take = "7b"', deleted=deleted)
        return gone.id in {clip.id for clip in queried.read(items.list_items, "lab", Kind.CLIP, filters).items}

    assert (finds(deleted=False), finds(deleted=True)) == (False, True)
