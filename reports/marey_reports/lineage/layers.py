"""Positions of the boxes of an acyclic directed graph, in layers from left to right.

The method follows Sugiyama, Tagawa and Toda (1981). Every box is to the right of all boxes that have arrows to it.
An arrow that crosses layers gets a node in each of them. The nodes of a layer are sorted by the mean positions of their
neighbours.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

SWEEPS = 12
"""Number of times that the order of all layers is improved."""
MOST_PASSED = 100_000
"""Greatest total length of all arrows; the length of an arrow is the number of layers from its source to its target."""


class Layout(NamedTuple):
    """Layers of a graph with the boxes in them, and the route of each arrow.

    A node is a number. With n boxes, the numbers 0 to n - 1 are the boxes, and greater numbers are points at which
    arrows cross a layer.
    """

    layers: list[list[int]]
    """For each layer, from left to right, its nodes from top to bottom."""
    routes: list[list[int]]
    """For each arrow, the nodes from its source to its target, both included."""


def lay_out(count: int, arrows: Sequence[tuple[int, int]]) -> Layout:
    """Return the layers of `count` boxes with arrows between them.

    Raises `ValueError` if the arrows form a cycle, or if their total length is more than `MOST_PASSED` layers.
    """
    depth = _depths(count, arrows)
    if sum(depth[target] - depth[source] for source, target in arrows) > MOST_PASSED:
        raise ValueError("the lineage is too deep for a picture; choose a smaller depth, or write a .dot file")
    layers: list[list[int]] = [[] for _ in range(max(depth, default=-1) + 1)]
    for box, layer in enumerate(depth):
        layers[layer].append(box)
    routes = []
    new = count
    for source, target in arrows:
        route = [source]
        for layer in range(depth[source] + 1, depth[target]):
            layers[layer].append(new)
            route.append(new)
            new += 1
        routes.append([*route, target])
    _reorder(layers, routes)
    return Layout(layers, routes)


def _depths(count: int, arrows: Sequence[tuple[int, int]]) -> list[int]:
    """Return the layer of each box; a box without incoming arrows is one layer before the first of its targets."""
    before, after = defaultdict(list), defaultdict(list)
    for source, target in arrows:
        before[target].append(source)
        after[source].append(target)
    waiting = [len(before[box]) for box in range(count)]
    order = [box for box in range(count) if not waiting[box]]
    depth = [0] * count
    for box in order:
        for target in after[box]:
            depth[target] = max(depth[target], depth[box] + 1)
            waiting[target] -= 1
            if not waiting[target]:
                order.append(target)
    if len(order) < count:
        raise ValueError("the graph cannot be drawn in layers, because its arrows form a cycle")
    for box in reversed(order):
        if not before[box] and after[box]:
            depth[box] = min(depth[target] for target in after[box]) - 1
    return depth


def _reorder(layers: list[list[int]], routes: Sequence[Sequence[int]]) -> None:
    left, right = defaultdict(list), defaultdict(list)
    for route in routes:
        for one, other in pairwise(route):
            right[one].append(other)
            left[other].append(one)
    position: dict[int, float] = {}
    for layer in layers:
        _number(layer, position)
    for sweep in range(SWEEPS):
        forward = sweep % 2 == 0
        neighbours = left if forward else right
        for layer in layers if forward else reversed(layers):
            _sort_layer(layer, position, neighbours)


def _number(layer: list[int], position: dict[int, float]) -> None:
    """Set the position of each node of a layer in `position`, from 0 at the top to 1 at the bottom."""
    position.update((node, (index + 0.5) / len(layer)) for index, node in enumerate(layer))


def _sort_layer(layer: list[int], position: dict[int, float], neighbours: dict[int, list[int]]) -> None:
    """Sort a layer by the mean position of each node's neighbours; a node without neighbours keeps its position."""
    means = {
        node: sum(position[other] for other in neighbours[node]) / len(neighbours[node])
        if neighbours[node]
        else position[node]
        for node in layer
    }
    layer.sort(key=means.__getitem__)
    _number(layer, position)
