"""Reading and writing cluster trees in the format of Marey's predecessor."""

import copy
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.support import predecessor_models as models

from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.tree import is_tree, read_predecessor_tree, write_predecessor_tree
from marey_motion.modelling.search.tree import SampleTree


def read(document: dict[str, Any]) -> SampleTree:
    return read_predecessor_tree(json.dumps(document).encode(), "tree.json")


def walk(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield node
    for child in node["children"]:
        yield from walk(child)


def test_each_node_holds_the_samples_and_the_mean_that_it_had() -> None:
    document = models.tree()
    found = read(document)
    data = np.array(document["data"])
    level, theirs = [document["root"]], []
    while level:
        theirs += level
        level = [child for node in level for child in node["children"]]
    assert len(theirs) == len(found.sizes)
    for node, start, size, mean, children in zip(
        theirs, found.starts, found.sizes, found.means, found.children, strict=True
    ):
        assert len(node["children"]) == children
        held = {tuple(row) for row in found.samples[start : start + size]}
        assert held == {tuple(row) for row in data[node["indices"]].astype(np.float32)}
        np.testing.assert_allclose(mean, node["mean"], atol=1e-6)


def test_a_tree_that_was_written_is_read_again_and_written_the_same() -> None:
    found = read(models.tree())
    written = write_predecessor_tree(found, models.SPATIAL, 4)
    again = read_predecessor_tree(written, "again.json")
    np.testing.assert_array_equal(again.samples, found.samples)
    np.testing.assert_array_equal(again.children, found.children)
    assert write_predecessor_tree(again, models.SPATIAL, 4) == written
    document = json.loads(written)
    assert is_tree(document)
    assert document["options"]["n_subdivisions"] == 4
    assert all(len(node["indices"]) == 1 for node in walk(document["root"]) if not node["children"])


@pytest.mark.parametrize("empty", ["root", "inner nodes"])
def test_nodes_that_list_no_samples_have_those_of_their_children(empty: str) -> None:
    document = models.tree()
    for node in [document["root"]] if empty == "root" else walk(document["root"]):
        if node["children"]:
            node["indices"] = None
    assert is_tree(document)
    found, expected = read(document), read(models.tree())
    np.testing.assert_array_equal(found.samples, expected.samples)
    np.testing.assert_array_equal(found.sizes, expected.sizes)


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (["data"], [], r"'data' has the shape \(0,\)"),
        (["data"], [[1.0], [2.0, 3.0]], "'data'"),
        (["data", 3, 1], 1e308, "'data', row 3: a number is too large for single precision"),
        (["root", "indices"], [0, 1], "root: the field `indices` must contain the number of each of the 40"),
        (["root", "indices"], [*range(39), 40], "root: each number in the field `indices` must be from 0 to 39"),
        (["root", "children", 0, "indices"], [], "root.0: the field `indices` must list at least one sample"),
        (["root", "children", 0, "indices"], [0, 0.5], "root.0"),
        (["root", "children", 0, "children", 0, "children", 0, "indices"], None, "'indices' must be list"),
        (["root", "children", 1, "indices"], [0], "must together have all samples"),
        (["root", "children", 0, "children", 0], 3, r"root\.0\.0: a node must be an object"),
    ],
)
def test_damaged_trees_are_refused_by_the_node(path: list[Any], value: object, told: str) -> None:
    document = copy.deepcopy(models.tree())
    *above, last = path
    place = document
    for step in above:
        place = place[step]
    place[last] = value
    with pytest.raises(FormatError, match=told) as refused:
        read(document)
    assert refused.value.file == "tree.json"


def test_a_node_that_holds_other_samples_than_those_below_it_is_refused() -> None:
    document = models.tree()
    first, second = document["root"]["children"][0]["children"][:2]
    first["indices"] = second["indices"]
    with pytest.raises(FormatError, match="node 5, counted level by level, must contain the samples of its children"):
        read(document)


def test_ends_that_hold_a_sample_twice_are_refused() -> None:
    document = models.tree()
    first, second = document["root"]["children"][0]["children"][:2]
    first |= copy.deepcopy(second)
    with pytest.raises(FormatError, match="do not contain each sample exactly once"):
        read(document)
