"""Graphs of motion primitives: they define which primitives may follow each primitive."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.originals import StoredOriginal
from marey_schemas.documents.references import OutputRef, RevisionRef

MOST_PRIMITIVES = 10_000
NodeType = Literal["start", "standard", "end", "idle", "single", "cycle_end"]
NODE_TYPES: tuple[NodeType, ...] = get_args(NodeType)
TYPES_TO_END_IN: tuple[NodeType, ...] = ("end", "idle", "single")

NodeName = Annotated[str, StringConstraints(min_length=1, max_length=255)]


class GraphPlace(Request):
    """Reference to a motion primitive: the names of its action and of the primitive."""

    action: NodeName
    primitive: NodeName

    def __str__(self) -> str:
        return f"{self.action}/{self.primitive}"


class GraphPrimitive(Request):
    """A node of the graph, the motion primitive: its model, its type, and the primitives that may follow it."""

    model: RevisionRef | OutputRef
    type: NodeType = "standard"
    transitions: tuple[GraphPlace, ...] = Field((), max_length=MOST_PRIMITIVES)
    source_id: str | None = Field(
        None, max_length=255, description="Id of the model in the imported file; absent: the graph was not imported."
    )


class GraphAction(Request):
    """An action, such as walk, made of primitives, such as leftStance."""

    primitives: dict[NodeName, GraphPrimitive] = Field(min_length=1, max_length=MOST_PRIMITIVES)


class ModelGraph(Request):
    """Part `graph` of an item of the kind `graph`.

    Every primitive can be reached from the start, and from every primitive an end (of type end, idle or single) can be
    reached. Every idle primitive has a transition to itself.
    """

    schema_: Literal["marey/model-graph@1"] = Field("marey/model-graph@1", alias="schema")
    actions: dict[NodeName, GraphAction] = Field(min_length=1, max_length=MOST_PRIMITIVES)
    start: GraphPlace = Field(description="The primitive that every sequence of actions begins with.")
    description: str = Field("", max_length=10_000)
    original: StoredOriginal | None = Field(
        None, description="The file that the graph was imported from; absent: it was not imported."
    )

    @model_validator(mode="after")
    def _check_graph(self) -> Self:
        nodes = {
            GraphPlace(action=action, primitive=name): node
            for action, group in self.actions.items()
            for name, node in group.primitives.items()
        }
        if len(nodes) > MOST_PRIMITIVES:
            raise ValueError(f"actions: the graph has {len(nodes)} primitives; at most {MOST_PRIMITIVES} are accepted")
        _require_known(nodes, "start", [self.start])
        for place, node in nodes.items():
            _require_known(nodes, f"{place}: transitions", node.transitions)
            if node.type == "idle" and place not in node.transitions:
                raise ValueError(f"{place}: an idle primitive must have a transition to itself")
        follows = {place: set(node.transitions) for place, node in nodes.items()}
        if lost := nodes.keys() - _reached([self.start], follows):
            raise ValueError(
                f"{_first(lost)}: this primitive cannot be reached from the start, {self.start}; add "
                "a transition to it, or remove it"
            )
        ends = [place for place, node in nodes.items() if node.type in TYPES_TO_END_IN]
        if not ends:
            raise ValueError(
                f"actions: at least one primitive must have a type that ends a sequence: {', '.join(TYPES_TO_END_IN)}"
            )
        precedes: dict[GraphPlace, set[GraphPlace]] = {place: set() for place in nodes}
        for place, following in follows.items():
            for other in following:
                precedes[other].add(place)
        if stuck := nodes.keys() - _reached(ends, precedes):
            raise ValueError(
                f"{_first(stuck)}: no primitive that ends a sequence can be reached from this one; add a transition"
            )
        return self


def _require_known(nodes: Mapping[GraphPlace, Any], where: str, places: Iterable[GraphPlace]) -> None:
    for place in places:
        if place not in nodes:
            raise ValueError(f"{where}: there is no primitive {place}")


def _reached(starts: Iterable[GraphPlace], follows: Mapping[GraphPlace, set[GraphPlace]]) -> set[GraphPlace]:
    """Return all nodes that can be reached from the starts, including the starts."""
    reached = set(starts)
    waiting = list(reached)
    while waiting:
        new = follows[waiting.pop()] - reached
        reached |= new
        waiting.extend(new)
    return reached


def _first(places: Iterable[GraphPlace]) -> GraphPlace:
    return min(places, key=str)
