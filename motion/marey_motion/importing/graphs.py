"""Conversion of imported graphs of models: each node is linked to the project's model with the same name.

Such graphs come from files of the predecessor, the system that Marey replaces (`formats.predecessor`). They name the
models of one or several actions, and the possible transitions between these models.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from marey_motion.errors import FormatError
from marey_motion.importing.items import ImportedGraph, ImportedItem
from marey_schemas.documents.graphs import ModelGraph
from marey_schemas.documents.originals import original_of
from marey_schemas.imports import NO_MODEL
from marey_schemas.kinds import Kind
from marey_schemas.validation.reasons import first_reason

SCHEMA = "marey/model-graph@1"
FEW = 3
"""Maximum number of models that an error lists if several have the same name."""


@dataclass(frozen=True)
class NamedModel:
    """A model of the project or of the same import: its path, and the reference to it in documents."""

    path: str
    ref: dict[str, Any]


FindModels = Callable[[str, str | None], tuple[int, Sequence[NamedModel]]]
"""Function that returns the number of models with a name, and the first `FEW` of them.

Its arguments are the name and a collection, or None for the whole project.
"""


def graph_item(graph: ImportedGraph, find: FindModels) -> ImportedItem:
    """Make the item of an imported graph of models, in which each node refers to a model of the project.

    The model of a node is the one with the node's name. A model in the collection of the graph is preferred to models
    in other collections.

    Parameters
    ----------
    graph : ImportedGraph    the graph
    find : callable    returns the models with a given name

    Returns
    -------
    ImportedItem    the item

    Raises
    ------
    FormatError    if a model is missing or ambiguous, or if the graph is inconsistent
    """
    names = dict.fromkeys(name for _, name in graph.graph.nodes)
    models = {name: _find_model(find, name, graph.collection) for name in names}
    actions: dict[str, Any] = {}
    for (action, name), node in graph.graph.nodes.items():
        primitives = actions.setdefault(action, {"primitives": {}})["primitives"]
        primitives[name] = {
            "model": models[name],
            "type": node.type,
            "transitions": [{"action": other, "primitive": one} for other, one in node.transitions],
            "source_id": node.model_id,
        }
    start = {"action": graph.graph.start[0], "primitive": graph.graph.start[1]}
    document = {"schema": SCHEMA, "actions": actions, "start": start}
    document["original"] = original_of("graph", document, graph.file, graph.digest)
    try:
        ModelGraph.model_validate(document)
    except ValidationError as error:
        raise FormatError(f"the graph is not valid as {SCHEMA}: {first_reason(error)}", code="invalid") from error
    return ImportedItem(graph.file, Kind.GRAPH, graph.name, graph.collection, {"graph": document}, graph.tags)


def _find_model(find: FindModels, name: str, collection: str) -> dict[str, Any]:
    """Return the reference to the model called `name` in `collection`.

    If the collection does not have exactly one model of this name, the whole project is searched. Raises `FormatError`
    if the project does not have exactly one either.
    """
    count, models = find(name, collection)
    if count != 1:
        count, models = find(name, None)
    if count == 1:
        return models[0].ref
    places = ", ".join(one.path for one in models)
    there = f"{count} models are called {name!r} ({places})" if count else f"no model is called {name!r}"
    advice = "import the models first, into the collection of the graph"
    raise FormatError(f"The graph has a node for the model {name!r}, but {there}; {advice}.", code=NO_MODEL)
