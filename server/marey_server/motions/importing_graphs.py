"""Graphs of the predecessor become graphs of models of the project, which are found by their names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.originals import original_of
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem
from marey_server.store import items
from marey_server.store.documents import prepare_document
from marey_server.store.items import Draft, ItemFilters
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:
    from marey_motion.formats.predecessor.graph import PredecessorGraph
    from marey_motion.importing.files import ModelledDocuments
    from marey_server.motions.importing import SourceFile

SCHEMA = "marey/model-graph@1"
FEW = 3


@dataclass(frozen=True, slots=True)
class ImportedGraph:
    """A graph that was read, whose models are still to be found."""

    name: str
    collection: str
    tags: Sequence[str]
    graph: PredecessorGraph
    file: str
    digest: str


def graph_to_import(
    found: ModelledDocuments | None, collection: str, tags: Sequence[str], file: SourceFile
) -> ImportedGraph | None:
    """The graph among what a file said, if that was one."""
    if found is None or found.graph is None:
        return None
    return ImportedGraph(found.name, collection, tags, found.graph, file.name, file.digest)


def graph_draft(tx: Transaction, project: str, wanted: ImportedGraph) -> Draft:
    """The graph with models of the project: those called like its nodes, best beside it.

    Raises `InvalidProblem` where there is none, or several in other folders, and where the graph does not hold
    together.
    """
    graph = wanted.graph
    models = {name: _find_model(tx, project, name, wanted.collection) for _, name in graph.nodes}
    actions: dict[str, Any] = {}
    for (action, name), node in graph.nodes.items():
        primitives = actions.setdefault(action, {"primitives": {}})["primitives"]
        primitives[name] = {
            "model": models[name],
            "type": node.type,
            "transitions": [{"action": other, "primitive": one} for other, one in node.transitions],
            "source_id": node.model_id,
        }
    start = {"action": graph.start[0], "primitive": graph.start[1]}
    document = {"schema": SCHEMA, "actions": actions, "start": start}
    original = original_of("graph", document, wanted.file, wanted.digest)
    prepared = prepare_document({**document, "original": original}, schema=SCHEMA)
    return Draft("graph", Kind.GRAPH, wanted.name, {"graph": prepared}, wanted.collection, tuple(wanted.tags))


def _find_model(tx: Transaction, project: str, name: str, collection: str) -> dict[str, Any]:
    """The model beside the graph, else the only one that is called so."""
    for folder in (collection, None):
        named = ItemFilters(exact_name=name, directly_in=folder)
        page = items.list_items(tx, project, Kind.MODEL, named, limit=FEW, count=True)
        if page.count == 1:
            return {"item": page.items[0].id, "revision": page.items[0].revision}
    places = ", ".join(one.path for one in page.items)
    there = f"{page.count} models are called {name!r} ({places})" if page.count else f"no model is called {name!r}"
    advice = "import the models of a graph first, beside it"
    raise InvalidProblem(f"The graph has a node {name!r}, but {there}; {advice}.", code="no-model")
