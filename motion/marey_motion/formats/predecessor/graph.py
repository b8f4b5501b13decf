"""Graphs of models of Marey's predecessor: nodes with transitions, and the node where sequences start.

A document contains the nodes by action and by the id that the model has in the predecessor's database. The form is
`{"nodes": {action: {model id: {"name", "type", "transitions": {"action:model": {"action_name", "model_name",
"model_id"}}}}}, "start_node": [action, model]}`; some programs write `startNode`. Transitions and the start node refer
to a model by its id or by its name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marey_motion.errors import FormatError
from marey_motion.formats.document_fields import field_of
from marey_motion.formats.predecessor.encoding import Encoding, encode_document
from marey_schemas.documents.graphs import MOST_PRIMITIVES, NODE_TYPES

START_FIELDS = ("start_node", "startNode")

Place = tuple[str, str]
"""Action and name of a motion primitive."""


@dataclass(frozen=True)
class GraphNode:
    """Node of a graph: the model (motion primitive) of one part of an action.

    Parameters
    ----------
    model_id : id of the model in the database of Marey's predecessor
    type : type of the node, one of `NODE_TYPES`
    transitions : nodes that may follow
    """

    model_id: str
    type: str
    transitions: tuple[Place, ...]


@dataclass(frozen=True)
class PredecessorGraph:
    """A graph of models: the nodes by action and model, and the action and model of the start node."""

    nodes: Mapping[Place, GraphNode]
    start: Place


def is_graph(document: Mapping[str, Any]) -> bool:
    """Check whether a document is a graph of models.

    Parameters
    ----------
    document : mapping    the document

    Returns
    -------
    bool    True for a graph
    """
    return isinstance(document.get("nodes"), Mapping) and any(name in document for name in START_FIELDS)


def graph_of_document(document: Mapping[str, Any], file: str) -> PredecessorGraph:
    """Read the graph of a document.

    Parameters
    ----------
    document : mapping    the document
    file : str    name of the file, for messages

    Returns
    -------
    PredecessorGraph    the graph

    Raises
    ------
    FormatError    naming the invalid node or field
    """
    listed: dict[tuple[str, str], Mapping[str, Any]] = {}
    names: dict[tuple[str, str], Place] = {}
    places: set[Place] = set()
    nodes = field_of(document, "nodes", dict, file)
    for action in nodes:
        for model_id, node in field_of(nodes, action, dict, file).items():
            place = (action, field_of(node, "name", str, file))
            if place in places:
                raise FormatError(f"action {action}: two nodes are called {place[1]!r}; rename one", file=file)
            if len(places) == MOST_PRIMITIVES:
                raise FormatError(f"the graph has more than {MOST_PRIMITIVES} nodes, which is the limit", file=file)
            places.add(place)
            listed[action, model_id] = node
            names[action, model_id] = place
    known = _Known(names, {place: place for place in places})
    found = {
        names[key]: GraphNode(key[1], _type(node, names[key], file), _transitions(node, names[key], known, file))
        for key, node in listed.items()
    }
    return PredecessorGraph(found, _start(document, known, file))


def write_predecessor_graph(graph: PredecessorGraph, *, encoding: Encoding = "json") -> bytes:
    """Write a graph, with the action and the model name of its start node.

    The start node is written twice, as `start_node` and as `startNode`, since programs read different fields.

    Parameters
    ----------
    graph : PredecessorGraph    the graph
    encoding : str    "json", "bson" or "bson.bz2"

    Returns
    -------
    bytes    content of the file
    """
    nodes: dict[str, dict[str, Any]] = {}
    for (action, name), node in graph.nodes.items():
        nodes.setdefault(action, {})[node.model_id] = {
            "name": name,
            "type": node.type,
            "transitions": {
                f"{other_action}:{other}": {
                    "action_name": other_action,
                    "model_name": other,
                    "model_id": graph.nodes[other_action, other].model_id,
                }
                for other_action, other in node.transitions
            },
        }
    start = list(graph.start)  # by name: the predecessor's loader looks the start up by the name of the model
    return encode_document({"nodes": nodes, "start_node": start, "startNode": start}, encoding)


@dataclass(frozen=True)
class _Known:
    """Nodes by action and id of the model, and by action and name; a name may equal the id of another node."""

    by_id: Mapping[tuple[str, str], Place]
    by_name: Mapping[tuple[str, str], Place]

    def with_id(self, key: tuple[str, str]) -> Place | None:
        """Return the node with an id, else the node with this name, else None."""
        return self.by_id.get(key) or self.by_name.get(key)

    def with_name(self, key: tuple[str, str]) -> Place | None:
        """Return the node with a name, else the node with this id, else None."""
        return self.by_name.get(key) or self.by_id.get(key)


def _type(node: Mapping[str, Any], place: Place, file: str) -> str:
    kind = node.get("type", "standard")
    if kind not in NODE_TYPES:
        raise FormatError(
            f"{'/'.join(place)}: {kind!r} is not a type of node; the types are {', '.join(NODE_TYPES)}", file=file
        )
    return str(kind)


def _transitions(node: Mapping[str, Any], place: Place, known: _Known, file: str) -> tuple[Place, ...]:
    given = node.get("transitions", {})
    if not isinstance(given, Mapping):
        raise FormatError(f"{'/'.join(place)}: 'transitions' must be an object", file=file)
    found = []
    for key, target in given.items():
        action, _, model = key.rpartition(":")
        wanted = target if isinstance(target, Mapping) else {}
        action = str(wanted.get("action_name", action))
        other = (
            known.with_id((action, str(wanted.get("model_id", ""))))
            or known.with_name((action, str(wanted.get("model_name", ""))))
            or known.with_id((action, model))
        )
        if other is None:
            raise FormatError(
                f"{'/'.join(place)}: a transition leads to the node {key!r}, which does not exist", file=file
            )
        found.append(other)
    return tuple(dict.fromkeys(found))


def _start(document: Mapping[str, Any], known: _Known, file: str) -> Place:
    name = next((name for name in START_FIELDS if name in document), None)
    if name is None:
        raise FormatError(
            f"field {START_FIELDS[0]!r} is missing; it must name the first action and its first model", file=file
        )
    given = document[name]
    if not isinstance(given, list) or len(given) != 2:
        raise FormatError(f"field {name!r} must be a list of two names: an action and a model", file=file)
    start = known.with_name((str(given[0]), str(given[1])))  # as the predecessor's loader reads it
    if start is None:
        raise FormatError(f"field {name!r} refers to the node {given!r}, which does not exist", file=file)
    return start
