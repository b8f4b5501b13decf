"""Conversion of cluster trees (samples of a model in nested nodes) between Marey's predecessor and Marey.

A document of the predecessor holds `data` (samples), `features`, `options` and `root`; a node is
`{mean, indices, children}`, and the `indices` of a node with children, such as the root, may be null. Marey's tree
contains the samples in the order of the tree, in single precision; Marey computes the means from the samples.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import numpy as np

from marey_motion.arrays import Ints
from marey_motion.errors import FormatError, MotionError
from marey_motion.formats.document_fields import field_of, number_array
from marey_motion.formats.predecessor.encoding import Encoding, decode_document, encode_document
from marey_motion.modelling.search.tree import SampleTree

Node = Mapping[str, Any]

MOST_NODES = 1_000_000
MOST_LEVELS = 64


def is_tree(document: Mapping[str, Any]) -> bool:
    """Check whether a document is a cluster tree.

    Parameters
    ----------
    document : mapping    the document

    Returns
    -------
    bool    True for a cluster tree
    """
    return "data" in document and isinstance(document.get("root"), Mapping) and "indices" in document["root"]


def read_predecessor_tree(data: bytes, file: str) -> SampleTree:
    """Read a cluster tree, as JSON, BSON or compressed BSON.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    SampleTree    the samples, grouped in the tree

    Raises
    ------
    FormatError    naming the invalid field or node
    """
    return tree_of_document(decode_document(data, file), file)


def tree_of_document(document: Mapping[str, Any], file: str) -> SampleTree:
    """Read a cluster tree from a decoded document of Marey's predecessor.

    Parameters
    ----------
    document : mapping    the document
    file : str    name of the file, for messages

    Returns
    -------
    SampleTree    the samples

    Raises
    ------
    FormatError    naming the invalid field or node
    """
    samples = number_array(field_of(document, "data", list, file), file, "data")
    if samples.ndim != 2 or not len(samples):
        raise FormatError(
            f"field 'data' has the shape {samples.shape}, but must have one row for each sample", file=file
        )
    if np.abs(samples).max(initial=0.0) > np.finfo(np.float32).max:
        place = int(np.argmax(np.abs(samples).max(axis=1)))
        message = f"field 'data', row {place}: a number is too large for single precision, in which samples are stored"
        raise FormatError(message, code="bad-number", file=file)
    indices, children = _by_levels(field_of(document, "root", dict, file), len(samples), file)
    order = _in_tree_order(indices, children)
    if len(np.unique(order)) != len(samples):
        raise FormatError(
            "the leaves of the tree do not contain each sample exactly once", code="tree-invalid", file=file
        )
    sizes = np.array([len(one) for one in indices], dtype=np.int32)
    try:
        tree = SampleTree(samples[order].astype(np.float32), sizes, np.array(children, dtype=np.int32))
    except MotionError as error:
        raise FormatError(str(error), code="tree-invalid", file=file) from error
    for number, (start, members) in enumerate(zip(tree.starts.tolist(), indices, strict=True)):
        if not np.array_equal(np.sort(order[start : start + len(members)]), np.sort(members)):
            message = f"node {number}, counted level by level, must contain the samples of its children and no others"
            raise FormatError(message, code="tree-invalid", file=file)
    return tree


def write_predecessor_tree(tree: SampleTree, spatial: int, branching: int, *, encoding: Encoding = "json") -> bytes:
    """Write a tree as a document of the predecessor.

    Parameters
    ----------
    tree : SampleTree    the samples
    spatial : int    number of spatial scores at the start of a latent vector; they are written as the sample's features
    branching : int    largest number of children of a node
    encoding : str    "json", "bson" or "bson.bz2"

    Returns
    -------
    bytes    content of the file
    """
    samples = tree.samples.astype(np.float64)
    nodes = [
        {"mean": mean, "indices": list(range(start, start + size)), "children": []}
        for mean, start, size in zip(tree.means.tolist(), tree.starts.tolist(), tree.sizes.tolist(), strict=True)
    ]
    for node, first, count in zip(nodes, tree.first_children.tolist(), tree.children.tolist(), strict=True):
        node["children"] = nodes[first : first + count]
    document = {
        "data": samples.tolist(),
        "features": samples[:, :spatial].tolist(),
        "options": {"n_subdivisions": branching, "clustering_method": 0, "use_feature_mean": False},
        "root": nodes[0],
    }
    return encode_document(document, encoding)


def _by_levels(root: Node, count: int, file: str) -> tuple[list[Ints], list[int]]:
    """List the samples of each node and its number of children, level by level from the root.

    `count` is the number of samples in the document. The samples of a node include those of its children. The
    predecessor's tree builder does not list the samples of the root (`indices: null`). A node with children that lists
    no samples has the samples of its children.
    """
    indices: list[Ints | None] = []
    children: list[int] = []
    waiting: deque[tuple[Node, str, int]] = deque([(root, "root", 0)])
    while waiting:
        node, place, level = waiting.popleft()
        if not isinstance(node, Mapping):
            raise FormatError(f"{place}: a node must be an object", file=file)
        below = node.get("children") or []
        if not isinstance(below, list):
            raise FormatError(f"{place}: the field `children` must be a list of nodes", file=file)
        if level > MOST_LEVELS:
            raise FormatError(
                f"{place}: the tree has more than {MOST_LEVELS} levels below its root, which is the limit", file=file
            )
        indices.append(_indices_of(node, place, count, file) if node.get("indices") is not None or not below else None)
        children.append(len(below))
        if len(indices) + len(waiting) + len(below) > MOST_NODES:
            raise FormatError(
                f"the tree has more than {MOST_NODES} nodes, which is the limit", code="format-limit", file=file
            )
        waiting.extend((child, f"{place}.{number}", level + 1) for number, child in enumerate(below))
    complete = _completed(indices, children)
    if len(np.unique(complete[0])) != count or len(complete[0]) != count:
        raise FormatError(
            f"root: the field `indices` must contain the number of each of the {count} samples once", file=file
        )
    return complete, children


def _indices_of(node: Node, place: str, count: int, file: str) -> Ints:
    """Read the samples of a node; `place` is its path from the root, `count` the number of samples in the document."""
    numbers = number_array(field_of(node, "indices", list, file), file, f"{place}: indices")
    if numbers.ndim != 1 or not len(numbers) or (numbers != np.floor(numbers)).any():
        raise FormatError(f"{place}: the field `indices` must list at least one sample, by whole numbers", file=file)
    if numbers.min() < 0 or numbers.max() >= count:
        raise FormatError(f"{place}: each number in the field `indices` must be from 0 to {count - 1}", file=file)
    return numbers.astype(np.int64)


def _completed(indices: list[Ints | None], children: list[int]) -> list[Ints]:
    """Return the samples of each node; a node that lists none gets the samples of its children.

    `indices` has one element for each node, level by level from the root, and None for a node that lists no samples.
    """
    firsts = _first_children(children)
    complete: list[Ints] = [np.zeros(0, np.int64)] * len(indices)
    for node in range(len(indices) - 1, -1, -1):
        listed = indices[node]
        below = complete[firsts[node] : firsts[node] + children[node]]
        complete[node] = np.concatenate(below) if listed is None else listed
    return complete


def _first_children(children: list[int]) -> list[int]:
    """Return the number of the first child of each node; for a node without children, the number means nothing."""
    return list(accumulate(children[:-1], initial=1))


def _in_tree_order(indices: list[Ints], children: list[int]) -> Ints:
    """Return the samples in the order of the leaves, so that the samples of each node are consecutive.

    Both lists have one element for each node, in the order of `_by_levels`: `indices` contains the samples of the node,
    `children` the number of its children.
    """
    first = _first_children(children)
    order: list[Ints] = []
    path = [0]
    while path:
        node = path.pop()
        if children[node]:
            path.extend(range(first[node] + children[node] - 1, first[node] - 1, -1))
        else:
            order.append(indices[node])
    return np.concatenate(order)
