"""Reading and writing graphs of models in the format of Marey's predecessor."""

import copy
import json
from typing import Any

import pytest

from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.graph import graph_of_document, is_graph, write_predecessor_graph


def transition(action: str, name: str, model_id: int) -> dict[str, dict[str, Any]]:
    return {f"{action}:{name}": {"action_name": action, "model_name": name, "model_id": model_id}}


DOCUMENT = {
    "nodes": {
        "idle": {
            "11": {
                "name": "stand", "type": "idle",
                "transitions": transition("idle", "stand", 11) | transition("walk", "begin", 12),
            }
        },
        "walk": {
            "12": {"name": "begin", "type": "start", "transitions": transition("walk", "end", 13)},
            "13": {"name": "end", "type": "end", "transitions": transition("idle", "stand", 11)},
        },
    },
    "start_node": ["idle", "11"],
}  # fmt: skip


def test_nodes_are_known_by_action_and_name_with_what_follows_them() -> None:
    graph = graph_of_document(DOCUMENT, "g.json")
    assert graph.start == ("idle", "stand")
    assert graph.nodes["idle", "stand"].transitions == (("idle", "stand"), ("walk", "begin"))
    assert (graph.nodes["walk", "end"].model_id, graph.nodes["walk", "end"].type) == ("13", "end")


@pytest.mark.parametrize("start", [["idle", "11"], ["idle", 11], ["idle", "stand"]])
@pytest.mark.parametrize("field", ["start_node", "startNode"])
def test_the_start_stands_under_either_name_and_names_a_model_by_id_or_name(field: str, start: list[Any]) -> None:
    document = {"nodes": DOCUMENT["nodes"], field: start}
    assert is_graph(document)
    assert graph_of_document(document, "g.json").start == ("idle", "stand")


def test_a_graph_that_was_written_is_read_as_the_same_and_begins_under_both_names() -> None:
    graph = graph_of_document(DOCUMENT, "g.json")
    written = json.loads(write_predecessor_graph(graph))
    assert graph_of_document(written, "again.json") == graph
    assert written["start_node"] == written["startNode"] == ["idle", "stand"]
    assert json.loads(write_predecessor_graph(graph_of_document(written, "again.json"))) == written


def test_a_name_that_is_the_id_of_another_node_leads_to_no_other_node() -> None:
    document = {
        "nodes": {
            "walk": {
                "1": {"name": "2", "transitions": {"walk:2": {"action_name": "walk", "model_name": "2"}}},
                "2": {"name": "1", "transitions": transition("walk", "2", 1)},
            }
        },
        "start_node": ["walk", "2"],
    }
    graph = graph_of_document(document, "g.json")
    assert graph.start == ("walk", "2")
    assert {place: node.transitions for place, node in graph.nodes.items()} == {
        ("walk", "2"): (("walk", "2"),),
        ("walk", "1"): (("walk", "2"),),
    }
    assert graph_of_document(json.loads(write_predecessor_graph(graph)), "again.json") == graph


def test_a_graph_without_a_start_is_refused_by_the_field_that_is_missing() -> None:
    with pytest.raises(FormatError, match="'start_node' is missing") as refused:
        graph_of_document({"nodes": DOCUMENT["nodes"]}, "g.json")
    assert refused.value.file == "g.json"


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (["nodes"], [], "'nodes' must be dict"),
        (["nodes", "walk"], [], "'walk' must be dict"),
        (["nodes", "walk", "12", "name"], 3, "'name' must be str"),
        (["nodes", "walk", "12", "name"], "end", "walk: two nodes are called 'end'"),
        (["nodes", "walk", "12", "type"], "begin", "walk/begin: 'begin' is not a type of node"),
        (["nodes", "walk", "12", "transitions"], [], "walk/begin: 'transitions' must be an object"),
        (
            ["nodes", "walk", "12", "transitions"],
            {"walk:99": {}},
            "walk/begin: a transition leads to the node 'walk:99', which",
        ),
        (["start_node"], "idle", "'start_node' must be a list of two names"),
        (["start_node"], ["idle", "99"], "refers to the node"),
    ],
)
def test_damaged_graphs_are_refused_by_the_node(path: list[str], value: object, told: str) -> None:
    document = copy.deepcopy(DOCUMENT)
    *above, last = path
    place: Any = document
    for step in above:
        place = place[step]
    place[last] = value
    with pytest.raises(FormatError, match=told) as refused:
        graph_of_document(document, "g.json")
    assert refused.value.file == "g.json"


def test_a_graph_with_too_many_nodes_is_refused_before_it_is_linked() -> None:
    node = {"name": "stand", "type": "idle", "transitions": {}}
    document = {"nodes": {f"a{number}": {"1": node} for number in range(10_001)}, "start_node": ["a0", "stand"]}
    with pytest.raises(FormatError, match="more than 10000 nodes"):
        graph_of_document(document, "g.json")
