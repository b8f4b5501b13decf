"""Lists of items: filters, order, cursors."""

import base64
import json
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.support.kept_rows import made_once
from tests.support.store_fixtures import Lab
from tests.support.tiers import examples

from marey_schemas.access import TokenCreate
from marey_schemas.items import Page
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.errors import BadRequestProblem, InvalidProblem
from marey_server.store import collections, items, listing, projects, users
from marey_server.store.credentials import server_key, tokens
from marey_server.store.database.connections import Database
from marey_server.store.items import ItemFilters
from marey_server.store.items.listing import SORT_KEYS
from marey_server.store.tables import collection as collection_table
from marey_server.store.tables import token
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

CLIPS = (  # name, collection, tags, frames
    ("walk 1", "raw/a", ("walk",), 10),
    ("walk 2", "raw/b", ("walk", "slow"), 20),
    ("Walk 10", "raw", ("fast",), 30),
    ("run_100%", "rawer", (), 20),
    ("Übung", "", ("slow",), 5),
    ("zoë", "raw/a/x", (), 5),
)


class FilledLab(Lab):
    """Project with the clips that this module lists, on one skeleton."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self.rig = self.add_skeleton()
        for seed, (name, collection, tags, frames) in enumerate(CLIPS):
            self.add_clip(self.rig, name, collection=collection, tags=tags, frames=frames, seed=seed)


@pytest.fixture
def filled(database: Database) -> FilledLab:
    return made_once(FilledLab, database)


def names(lab: Lab, sort: str = "name", **filters: Any) -> list[str]:
    return [one.name for one in lab.read(items.list_items, "lab", Kind.CLIP, ItemFilters(**filters), sort=sort).items]


FILTERS: tuple[tuple[dict[str, Any], set[str]], ...] = (
    ({}, {name for name, *_ in CLIPS}),
    ({"collection": "raw"}, {"walk 1", "walk 2", "Walk 10", "zoë"}),
    ({"collection": "raw/a"}, {"walk 1", "zoë"}),
    ({"collection": "ra"}, set()),
    ({"collection": ""}, {name for name, *_ in CLIPS}),
    ({"directly_in": "raw"}, {"Walk 10"}),
    ({"directly_in": "raw/a"}, {"walk 1"}),
    ({"directly_in": ""}, {"Übung"}),
    ({"directly_in": "ra"}, set()),
    ({"directly_in": "raw", "collection": "raw/a"}, set()),
    ({"path": "raw/walk 1"}, set()),
    ({"path": "raw/a/walk 1"}, {"walk 1"}),
    ({"path": "Übung"}, {"Übung"}),
    ({"name": "walk 1"}, {"walk 1"}),
    ({"name": "walk*"}, {"walk 1", "walk 2"}),
    ({"name": "*"}, {name for name, *_ in CLIPS}),
    ({"name": "run_100%*"}, {"run_100%"}),
    ({"name": "%*"}, set()),
    ({"tags": ("walk",)}, {"walk 1", "walk 2"}),
    ({"tags": ("fast", "slow")}, {"walk 2", "Walk 10", "Übung"}),
    ({"frames_gte": 20}, {"walk 2", "Walk 10", "run_100%"}),
    ({"frames_gte": 10, "frames_lte": 20}, {"walk 1", "walk 2", "run_100%"}),
    ({"q": "WALK"}, {"walk 1", "walk 2", "Walk 10"}),
    ({"q": "übung"}, {"Übung"}),
    ({"q": "ZOË"}, {"zoë"}),
    ({"q": "0%"}, {"run_100%"}),
    ({"q": "_"}, {"run_100%"}),
    ({"skeleton": "skeleton_x"}, set()),
    ({"q": "walk", "tags": ("slow",), "collection": "raw/b"}, {"walk 2"}),
)


def test_filters_choose(filled: FilledLab) -> None:
    for filters, expected in FILTERS:
        found = names(filled, **filters)
        assert set(found) == expected, filters
        assert len(found) == len(expected), filters
        counted = filled.read(items.list_items, "lab", Kind.CLIP, ItemFilters(**filters), limit=1, count=True)
        assert counted.count == len(expected), filters


def test_clips_are_found_by_their_skeleton(filled: FilledLab) -> None:
    assert len(names(filled, skeleton=filled.rig.id)) == len(CLIPS)


def test_order_is_that_of_code_points_on_every_database(filled: FilledLab) -> None:
    assert names(filled, sort="name") == sorted(name for name, *_ in CLIPS)
    assert names(filled, sort="-name") == sorted((name for name, *_ in CLIPS), reverse=True)


def test_keys_of_an_order_have_directions_of_their_own(filled: FilledLab) -> None:
    by_frames = sorted(((frames, name) for name, _, _, frames in CLIPS), key=lambda pair: (-pair[0], pair[1]))
    assert names(filled, sort="-frames,name") == [name for _, name in by_frames]


@pytest.mark.parametrize("sort", ["nose", "name,nose", "name,-name", "-", ",,nose"])
def test_unknown_orders_are_refused(filled: FilledLab, sort: str) -> None:
    with pytest.raises(BadRequestProblem):
        names(filled, sort=sort)


def test_an_order_with_a_key_twice_is_refused_with_this_key(filled: FilledLab) -> None:
    with pytest.raises(BadRequestProblem, match="contains 'frames' twice"):
        names(filled, sort="name,frames,-frames")


@pytest.mark.parametrize("limit", [0, -1, 1001])
def test_limits_out_of_range_are_refused(filled: FilledLab, limit: int) -> None:
    with pytest.raises(BadRequestProblem):
        filled.read(items.list_items, "lab", Kind.CLIP, limit=limit)


def test_fields_choose_what_is_shown(filled: FilledLab) -> None:
    page = filled.read(items.list_items, "lab", Kind.CLIP, ItemFilters(name="walk 2"), fields=("id", "name", "tags"))
    assert page.items[0].keys() == {"id", "name", "tags"}
    assert page.items[0]["tags"] == ["slow", "walk"]
    with pytest.raises(BadRequestProblem):
        filled.read(items.list_items, "lab", Kind.CLIP, fields=("nose",))


def pages(lab: Lab, limit: int, **kwargs: Any) -> Iterator[list[str]]:
    cursor = None
    while True:
        page = lab.read(items.list_items, "lab", Kind.CLIP, cursor=cursor, limit=limit, **kwargs)
        yield [one.name for one in page.items]
        cursor = page.next_cursor
        if cursor is None:
            return


def test_pages_put_together_are_the_list(filled: FilledLab) -> None:
    for sort in ("id", "name", "-name", "frames", "-frames,name", "frames,-name", "-created_at", "updated_at"):
        whole = names(filled, sort=sort)
        for limit in (1, 2, 4, 6, 7):
            assert [name for page in pages(filled, limit, sort=sort) for name in page] == whole, (sort, limit)


def test_pages_of_one_folder_put_together_are_its_list(filled: FilledLab) -> None:
    for number in range(5):
        filled.add_clip(filled.rig, f"take {number}", collection="raw", seed=30 + number)
    folder = ItemFilters(directly_in="raw")
    for sort in ("name", "-name", "-created_at"):
        whole = names(filled, sort=sort, directly_in="raw")
        assert len(whole) == 6
        assert [name for page in pages(filled, 2, sort=sort, filters=folder) for name in page] == whole


def test_deleted_items_are_found_directly_in_the_folder_they_were_in(filled: FilledLab) -> None:
    (gone,) = filled.read(items.list_items, "lab", Kind.CLIP, ItemFilters(name="Walk 10")).items
    filled.write(items.delete_item, "lab", Kind.CLIP, gone.id, expected_rev=None)
    assert names(filled, directly_in="raw") == []
    assert names(filled, directly_in="raw", deleted=True) == ["Walk 10"]
    assert names(filled, path="raw/Walk 10", deleted=True) == ["Walk 10"]


def test_what_is_inserted_meanwhile_neither_repeats_nor_hides_anything(filled: FilledLab) -> None:
    seen = []
    for number, page in enumerate(pages(filled, 2, sort="name")):
        seen += page
        filled.add_clip(filled.rig, f"A {number}", seed=50 + number)
        filled.add_clip(filled.rig, f"zz {number}", seed=70 + number)
        if number > 5:
            break
    assert len(seen) == len(set(seen))
    assert [name for name in seen if not name.startswith("zz")] == sorted(name for name, *_ in CLIPS)


def test_a_cursor_serves_only_the_list_it_came_from(filled: FilledLab) -> None:
    def ask(cursor: str, **kwargs: Any) -> Page:
        return filled.read(items.list_items, "lab", Kind.CLIP, cursor=cursor, **kwargs)

    cursor = filled.read(items.list_items, "lab", Kind.CLIP, limit=2, sort="name").next_cursor
    assert ask(cursor, sort="name").items
    for wrong in (
        lambda: ask(cursor, sort="-name"),
        lambda: ask(cursor, sort="name", filters=ItemFilters(q="w")),
        lambda: filled.read(items.list_items, "lab", Kind.CHARACTER, cursor=cursor, sort="name"),
        lambda: ask(cursor[:-2] + "AA", sort="name"),
        lambda: ask("", sort="name"),
        lambda: ask("é€", sort="name"),
        lambda: ask("A" * 300, sort="name"),
    ):
        with pytest.raises(BadRequestProblem):
            wrong()


FILTERS_OF_0_1: dict[str, Any] = {
    **dict.fromkeys(("collection", "directly_in", "path", "name", "exact_name", "skeleton", "clip", "q")),
    "frames_gte": None,
    "frames_lte": None,
    "tags": (),
    "deleted": False,
}


def old_cursor(tx: Transaction, cursor: str, order: listing.Order, identity: list[Any]) -> str:
    """Return the cursor that version 0.1 made for a list at the place of `cursor`."""
    payload = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
    return listing.make_cursor(tx, order, identity, json.loads(payload[listing._MAC_BYTES :])[2])


def test_cursors_of_version_0_1_continue_a_list_of_items(filled: FilledLab) -> None:
    def found(tx: Transaction) -> tuple[Page, Page]:
        order = listing.parse_order("name", SORT_KEYS)
        first = items.list_items(tx, "lab", Kind.CLIP, sort="name", limit=2)
        identity = [projects.require(tx, "lab").id, "clip", FILTERS_OF_0_1]
        cursor = old_cursor(tx, str(first.next_cursor), order, identity)
        rest = items.list_items(tx, "lab", Kind.CLIP, sort="name", cursor=cursor)
        return first, rest

    first, rest = filled.read(found)
    assert sorted(one.name for one in (*first.items, *rest.items)) == sorted(name for name, *_ in CLIPS)


def test_cursors_of_version_0_1_continue_a_list_of_folders(filled: FilledLab) -> None:
    def found(tx: Transaction) -> tuple[Page, Page]:
        order = listing.parse_order("path", {"path": collection_table.c.path, "id": collection_table.c.id})
        first = collections.list_collections(tx, "lab", limit=2)
        identity = ["collections", projects.require(tx, "lab").id, "", False]
        cursor = old_cursor(tx, str(first.next_cursor), order, identity)
        return first, collections.list_collections(tx, "lab", cursor=cursor)

    first, rest = filled.read(found)
    paths = [one.path for one in (*first.items, *rest.items)]
    assert paths == sorted(set(paths))
    assert {"raw", "raw/a", "raw/a/x", "raw/b", "rawer"} <= set(paths)


def test_cursors_of_version_0_1_continue_a_list_of_tokens(database: Database) -> None:
    database.write(SYSTEM, users.ensure_first_administrator)
    owner = database.read(SYSTEM, users.administrator_principal)
    made = [database.write(owner, tokens.create_token, TokenCreate(name="mine")).id for _ in range(3)]

    def found(tx: Transaction) -> Page:
        order = listing.parse_order("-id", {"id": token.c.id})
        cursor = str(tokens.list_tokens(tx, limit=1).next_cursor)
        return tokens.list_tokens(tx, cursor=old_cursor(tx, cursor, order, ["tokens", owner.user_id]))

    assert [one.id for one in database.read(owner, found).items] == sorted(made)[1::-1]


def test_cursors_of_one_server_are_worth_nothing_on_another(filled: FilledLab) -> None:
    cursor = filled.read(items.list_items, "lab", Kind.CLIP, limit=2).next_cursor

    def forget(tx: Transaction) -> None:
        tx.connection.exec_driver_sql("DELETE FROM server_state WHERE key = 'cursor_key'")
        server_key.make_server_key(tx)

    filled.write(forget)
    with pytest.raises(BadRequestProblem):
        filled.read(items.list_items, "lab", Kind.CLIP, limit=2, cursor=cursor)


@given(text=st.text(max_size=8), number=st.integers(-(2**70), 2**70))
@settings(max_examples=examples(20, soak=60), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_filter_value_breaks_a_list(filled: FilledLab, text: str, number: int) -> None:
    texts: list[dict[str, Any]] = [{"q": text}, {"name": text}, {"name": f"{text}*"}, {"path": text}, {"tags": (text,)}]
    texts += [{"directly_in": text}]
    texts += [{"collection": text}, {"skeleton": text}, {"frames_gte": number}, {"frames_lte": number}]
    for filters in texts:
        with suppress(InvalidProblem):
            assert set(names(filled, **filters)) <= {name for name, *_ in CLIPS}
