"""Documents of graphs of models, and the conditions that they must meet."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from marey_schemas.documents.graphs import ModelGraph
from marey_schemas.documents.registry import SCHEMAS


def node(number: int, kind: str, *following: Any) -> dict[str, Any]:
    return {
        "model": {"item": f"model_{number}", "revision": 1},
        "type": kind,
        "transitions": [dict(zip(("action", "primitive"), one.split("/"), strict=True)) for one in following],
    }


GRAPH: dict[str, Any] = {
    "schema": "marey/model-graph@1",
    "actions": {
        "idle": {"primitives": {"stand": node(1, "idle", "idle/stand", "walk/begin")}},
        "walk": {
            "primitives": {
                "begin": node(2, "start", "walk/left"),
                "left": node(3, "standard", "walk/right", "walk/end"),
                "right": node(4, "standard", "walk/left"),
                "end": node(5, "end", "idle/stand"),
            }
        },
    },
    "start": {"action": "idle", "primitive": "stand"},
    "description": "A worker.",
}


def test_a_graph_whose_parts_hold_together_is_accepted_and_known_by_its_schema() -> None:
    graph = ModelGraph.model_validate(GRAPH)
    assert SCHEMAS["marey/model-graph@1"] is ModelGraph
    assert graph.model_dump(mode="json", by_alias=True, exclude_none=True) == GRAPH


def changed(change: Callable[..., Any]) -> dict[str, Any]:
    graph = copy.deepcopy(GRAPH)
    change(graph)
    return graph


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda one: one["start"].update(primitive="sit"), "start: there is no primitive idle/sit"),
        (
            lambda one: one["actions"]["walk"]["primitives"]["left"]["transitions"].append(
                {"action": "run", "primitive": "left"}
            ),
            "walk/left: transitions: there is no primitive run/left",
        ),
        (
            lambda one: one["actions"]["idle"]["primitives"]["stand"]["transitions"].pop(0),
            "idle/stand: an idle primitive must have a transition to itself",
        ),
        (
            lambda one: one["actions"]["walk"]["primitives"]["left"]["transitions"].pop(0),
            "walk/right: this primitive cannot be reached from the start",
        ),
        (
            lambda one: (
                one["actions"].update(fall={"primitives": {"down": node(9, "start", "fall/down")}})
                or one["actions"]["idle"]["primitives"]["stand"]["transitions"].append(
                    {"action": "fall", "primitive": "down"}
                )
            ),
            "fall/down: no primitive that ends a sequence can be reached from this one",
        ),
        (lambda one: one["actions"]["walk"]["primitives"]["left"].update(type="turn"), "type"),
        (lambda one: one.update(actions={}), "actions"),
        (lambda one: one["actions"]["walk"]["primitives"]["left"].pop("model"), "model"),
    ],
)
def test_a_graph_that_does_not_hold_together_is_refused_by_the_primitive(change: Callable[..., Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        ModelGraph.model_validate(changed(change))


def test_a_graph_without_any_end_is_refused() -> None:
    graph = copy.deepcopy(GRAPH)
    for action in graph["actions"].values():
        for primitive in action["primitives"].values():
            primitive["type"] = "standard"
    with pytest.raises(
        ValidationError, match="at least one primitive must have a type that ends a sequence: end, idle, single"
    ):
        ModelGraph.model_validate(graph)
