"""Random operations on items, compared with a simple model in memory."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)
from tests.support.store_fixtures import Lab
from tests.support.tiers import examples, steps

from marey_schemas.items import Item, ItemChange, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.errors import ConflictProblem, NotFoundProblem, PreconditionFailedProblem
from marey_server.store import fsck, garbage, items
from marey_server.store.database.connections import Database

NAMES = st.sampled_from(["walk", "run", "Über"])
PLACES = st.sampled_from(["", "a", "a/b", "c"])
TAGS = st.lists(st.sampled_from(["x", "y", "z"]), max_size=2).map(lambda tags: tuple(sorted(set(tags))))
TEXTS = st.sampled_from(["one", "two", "three"])


@dataclass(frozen=True)
class Model:
    """Expected state of an item."""

    name: str
    place: str
    tags: tuple[str, ...]
    history: tuple[str, ...]
    rev: int = 1
    deleted: bool = False


@dataclass
class World:
    """Expected items by id."""

    items: dict[str, Model] = field(default_factory=dict)

    def occupied(self, name: str, place: str, besides: str = "") -> bool:
        return any(
            (one.name, one.place) == (name, place) and not one.deleted
            for item_id, one in self.items.items()
            if item_id != besides
        )


class ItemsMachine(RuleBasedStateMachine):
    """State machine that makes each change in the store and in the model, and compares the results."""

    ids = Bundle("ids")
    database = None
    runs = 0

    def __init__(self) -> None:
        super().__init__()
        type(self).runs += 1
        self.lab = Lab(self.database, f"run{self.runs}")
        self.world = World()

    def write(self, function: Callable[..., Any], item_id: str, *args: Any, **kwargs: Any) -> Item | None:
        return self.lab.write(function, self.lab.name, Kind.CHARACTER, item_id, *args, **kwargs)

    def attempt(self, item_id: str, expected: str, change: Callable[..., Any], *, blocked: bool = False) -> bool:
        """Run `change(expected_rev)`, and return whether it succeeds; fail if the model expects another outcome.

        `expected` selects the `rev` of the item that the change expects: "any", "right" or "wrong". `blocked` states
        whether the change conflicts with another item.
        """
        model = self.world.items[item_id]
        expected_rev = {"any": None, "right": model.rev, "wrong": model.rev + 7}[expected]
        error: type[Exception] | None = None
        if model.deleted:
            error = NotFoundProblem
        elif expected == "wrong":
            error = PreconditionFailedProblem
        elif blocked:
            error = ConflictProblem
        with pytest.raises(error) if error else nullcontext():
            change(expected_rev)
        return error is None

    @rule(target=ids, name=NAMES, place=PLACES, tags=TAGS, text=TEXTS)
    def create(self, name: str, place: str, tags: tuple[Any, ...], text: str) -> Any:
        request = ItemCreate(name=name, collection=place, tags=tags, parts={"character": {"text": text}})
        try:
            made = self.lab.write(items.create_item, self.lab.name, Kind.CHARACTER, request)
        except ConflictProblem:
            assert self.world.occupied(name, place)
            return multiple()
        assert not self.world.occupied(name, place)
        assert made.id not in self.world.items
        self.world.items[made.id] = Model(name, place, tags, (text,))
        return made.id

    expectations = st.sampled_from(["any", "right", "wrong"])

    @rule(item_id=ids, text=TEXTS, expected=expectations)
    def put_part(self, item_id: str, text: str, expected: str) -> None:
        tree = {"text": text}
        put = lambda rev: self.write(items.put_part, item_id, "character", tree, expected_rev=rev)  # noqa: E731
        if self.attempt(item_id, expected, put):
            model = self.world.items[item_id]
            if model.history[-1] != text:
                self.world.items[item_id] = replace(model, history=(*model.history, text), rev=model.rev + 1)

    @rule(item_id=ids, name=NAMES, place=PLACES, tags=TAGS, expected=expectations)
    def change(self, item_id: str, name: Any, place: Any, tags: Any, expected: Any) -> None:
        request = ItemChange(name=name, collection=place, tags=tags)
        change = lambda rev: self.write(items.change_item, item_id, request, expected_rev=rev)  # noqa: E731
        if self.attempt(item_id, expected, change, blocked=self.world.occupied(name, place, item_id)):
            model = self.world.items[item_id]
            self.world.items[item_id] = replace(model, name=name, place=place, tags=tags, rev=model.rev + 1)

    @rule(item_id=ids, expected=expectations)
    def delete(self, item_id: str, expected: str) -> None:
        delete = lambda rev: self.write(items.delete_item, item_id, expected_rev=rev)  # noqa: E731
        if self.attempt(item_id, expected, delete):
            model = self.world.items[item_id]
            self.world.items[item_id] = replace(model, deleted=True, rev=model.rev + 1)

    @rule(item_id=ids)
    def restore(self, item_id: str) -> None:
        model = self.world.items[item_id]
        blocked = self.world.occupied(model.name, model.place, item_id)
        try:
            self.write(items.restore_item, item_id)
        except NotFoundProblem:
            assert not model.deleted
        except ConflictProblem:
            assert model.deleted
            assert blocked
        else:
            assert model.deleted
            assert not blocked
            self.world.items[item_id] = replace(model, deleted=False, rev=model.rev + 1)

    @rule()
    def collect_garbage(self) -> None:
        garbage.collect_garbage(self.lab.database, grace_us=-1)

    @invariant()
    def lists_agree(self) -> None:
        for deleted in (False, True):
            filters = items.ItemFilters(deleted=deleted)
            page = self.lab.read(items.list_items, self.lab.name, Kind.CHARACTER, filters, limit=1000, count=True)
            found = {one.id: (one.name, one.collection, one.tags, one.revision, one.rev) for one in page.items}
            assert found == {
                item_id: (one.name, one.place, one.tags, len(one.history), one.rev)
                for item_id, one in self.world.items.items()
                if one.deleted is deleted
            }
            assert page.count == len(found)

    def teardown(self) -> None:
        for item_id, model in self.world.items.items():
            if not model.deleted:
                for number, text in enumerate(model.history, 1):
                    part = self.lab.read(
                        items.read_part, self.lab.name, Kind.CHARACTER, item_id, "character", revision=number
                    )
                    assert part.tree["text"] == text
        assert list(fsck.check_store(self.lab.database)) == []


def test_items_are_what_the_model_says(database: Database) -> None:
    machine = type("Machine", (ItemsMachine,), {"database": database, "runs": 0})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples(12),
            stateful_step_count=steps(20),
            deadline=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
        ),
    )
