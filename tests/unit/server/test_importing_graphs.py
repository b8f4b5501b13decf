"""Import of graphs, whose nodes refer to models by name."""

from collections.abc import Mapping
from typing import Any
from unittest.mock import Mock

import pytest
from tests.support.predecessor_models import imported
from tests.support.store_fixtures import ALL_RIGHTS, Lab

from marey_motion.formats.predecessor.graph import GraphNode, PredecessorGraph
from marey_motion.importing.items import ImportedGraph
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem
from marey_server.motions.importing import graph_draft
from marey_server.store import items, projects
from marey_server.store.items import Draft
from marey_server.store.items.drafts import Published
from marey_server.store.transaction import Transaction


@pytest.fixture(scope="module")
def parts() -> tuple[Mapping[str, Any], dict[str, Any]]:
    return imported()


def add_models(lab: Lab, parts: tuple[Mapping[str, Any], dict[str, Any]], *paths: Any) -> dict[str, str]:
    """Create the same model at several paths; return the ids by path."""
    found, hierarchy = parts
    model = {**found["model"], "skeleton": {"output": "rig"}, "provenance": {}}
    drafts = [Draft("rig", Kind.SKELETON, "rig", {"hierarchy": hierarchy}, reuse="by_content")]
    for path in paths:
        folder, _, name = path.rpartition("/")
        drafts.append(Draft(path, Kind.MODEL, name, {"model": model}, folder))

    def run(tx: Transaction) -> list[Published]:
        project_row = projects.require(tx, "lab")
        return items.publish(tx, project_row, drafts, author_id=tx.principal.user_id, rights=ALL_RIGHTS)

    return {one.name: one.item for one in lab.write(run)}


def models_of(lab: Lab, *names: Any) -> list[str]:
    """Return the ids of the models that the nodes of a graph in the folder `g` refer to."""
    nodes = {("idle", name): GraphNode("?", "idle", tuple(("idle", other) for other in names)) for name in names}
    graph = PredecessorGraph(nodes, ("idle", names[0]))
    draft = lab.read(graph_draft, "lab", ImportedGraph("graph", "g", (), graph, "graph.json", f"sha256:{'3' * 64}"))
    group = draft.parts["graph"].body["actions"]["idle"]["primitives"]
    return [group[name]["model"]["item"] for name in names]


def test_a_node_whose_name_ends_in_an_asterisk_is_no_search_by_the_start_of_names(
    lab: Lab, parts: tuple[Mapping[str, Any], dict[str, Any]]
) -> None:
    add_models(lab, parts, "g/stand")
    with pytest.raises(InvalidProblem, match=r"no model is called 'stan\*'"):
        models_of(lab, "stan*")
    ids = add_models(lab, parts, "g/stan*")
    assert models_of(lab, "stan*") == [ids["g/stan*"]]


def test_the_model_beside_the_graph_is_taken_however_many_there_are_elsewhere(
    lab: Lab, parts: tuple[Mapping[str, Any], dict[str, Any]]
) -> None:
    ids = add_models(lab, parts, "g/stand", *(f"other {number:03d}/stand" for number in range(101)))
    assert models_of(lab, "stand") == [ids["g/stand"]]


def test_the_only_model_elsewhere_is_taken_and_one_of_several_is_not_guessed(
    lab: Lab, parts: tuple[Mapping[str, Any], dict[str, Any]]
) -> None:
    ids = add_models(lab, parts, "far/stand")
    assert models_of(lab, "stand") == [ids["far/stand"]]
    add_models(lab, parts, "farther/stand")
    with pytest.raises(InvalidProblem, match="2 models are called 'stand'"):
        models_of(lab, "stand")


def test_the_models_of_many_nodes_are_looked_up_together(
    lab: Lab, parts: tuple[Mapping[str, Any], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"stand {number}" for number in range(40)]
    ids = add_models(lab, parts, *(f"far/{name}" for name in names))
    counted = Mock(side_effect=items.find_namesakes)
    monkeypatch.setattr(items, "find_namesakes", counted)
    assert models_of(lab, *names) == [ids[f"far/{name}"] for name in names]
    assert counted.call_count == 2, "once in the folder of the graph, and once in the project"
