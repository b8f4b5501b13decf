"""Trees of samples: their contents, and that building a tree again gives the same tree."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.support.search_primitives import sliding, standard_joints, walking
from tests.support.tiers import examples

from marey_motion.arrays import AnyFloats
from marey_motion.errors import MotionError
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.objective import build_objective
from marey_motion.modelling.search.samples import search_tree
from marey_motion.modelling.search.tree import END_EFFECTORS, SampleTree, build_tree
from marey_motion.modelling.search.tree_documents import sample_tree_from_tree, sample_tree_to_tree
from marey_schemas.documents.sample_trees import SampleTreeDocument
from marey_schemas.encoding.codecs import MEDIA_TYPES, decode_tree, encode_tree
from marey_schemas.options.modelling import TreeOptions
from marey_schemas.search_constraints import JointPositionConstraint

LATENT = TreeOptions(samples=600, features="latent")


def members(tree: SampleTree, node: int) -> AnyFloats:
    return tree.samples[tree.starts[node] : tree.starts[node] + tree.sizes[node]]


def children(tree: SampleTree, node: int) -> Any:
    first = tree.first_children[node]
    return range(first, first + tree.children[node])


def test_a_tree_holds_each_sample_of_the_model_once() -> None:
    primitive, _ = walking()
    tree = build_tree(primitive, 7, LATENT)
    drawn = primitive.sample(600, 7).astype(np.float32)
    assert sorted(map(bytes, tree.samples)) == sorted(map(bytes, drawn))


@settings(max_examples=examples(30))
@given(
    seed=st.integers(0, 2**63 - 1),
    samples=st.integers(1, 300),
    branching=st.integers(2, 7),
    leaf_size=st.integers(1, 40),
    depth=st.integers(1, 9),
)
def test_children_share_the_samples_of_their_parent(
    seed: int, samples: int, branching: int, leaf_size: int, depth: int
) -> None:
    primitive, _ = walking()
    tree = build_tree(
        primitive,
        seed,
        TreeOptions(samples=samples, branching=branching, leaf_size=leaf_size, depth=depth, features="latent"),
    )
    levels = np.zeros(len(tree.sizes), dtype=int)
    for node in range(len(tree.sizes)):
        below = children(tree, node)
        assert len(below) != 1
        assert len(below) <= branching
        if len(below):
            assert tree.sizes[node] > leaf_size
            assert np.array_equal(np.concatenate([members(tree, child) for child in below]), members(tree, node))
            levels[list(below)] = levels[node] + 1
        else:
            assert tree.sizes[node] <= leaf_size or levels[node] == depth or same(members(tree, node))
        np.testing.assert_allclose(tree.means[node], members(tree, node).mean(axis=0, dtype=np.float64), atol=1e-12)
    assert levels.max() <= depth


def same(rows: AnyFloats) -> np.bool:
    return (rows == rows[0]).all()


def test_a_node_of_one_sample_has_it_as_its_mean_to_the_last_bit() -> None:
    tree = build_tree(walking()[0], 1, LATENT)
    alone = np.flatnonzero(tree.sizes == 1)
    assert alone.size > 500
    assert np.array_equal(tree.means[alone], tree.samples[tree.starts[alone]].astype(np.float64))


def test_splitting_brings_samples_together() -> None:
    primitive, _ = walking()
    tree = build_tree(primitive, 3, LATENT)
    spatial = primitive.spatial.count
    around = [((members(tree, node)[:, :spatial] - tree.means[node, :spatial]) ** 2).sum() for node in range(5)]
    assert sum(around[1:]) < 0.8 * around[0]


def test_two_clear_groups_are_told_apart() -> None:
    primitive = sliding(1)
    far = LatentMixture(np.array([0.3, 0.7]), np.array([[-50.0], [50.0]]), np.full((2, 1, 1), 1.0))
    object.__setattr__(primitive, "mixture", far)
    tree = build_tree(primitive, 4, TreeOptions(samples=200, branching=2, features="latent"))
    left, right = (members(tree, node) for node in children(tree, 0))
    assert (np.sign(left) != np.sign(right[0])).all()
    assert same(np.sign(right))


def test_threads_and_repetitions_make_the_same_bytes() -> None:
    primitive, _ = walking()
    wanted = [standard_joints()[name] for name in END_EFFECTORS]

    def built(_number: int) -> bytes:
        tree = build_tree(primitive, 11, TreeOptions(samples=1500), end_effectors=wanted)
        return tree.samples.tobytes() + tree.sizes.tobytes() + tree.children.tobytes()

    alone = {built(0), built(1)}
    with ThreadPoolExecutor(2) as pool:
        together = set(pool.map(built, range(4)))
    assert len(alone | together) == 1


def test_another_seed_makes_another_tree() -> None:
    primitive, _ = walking()
    one, other = (build_tree(primitive, seed, LATENT) for seed in (1, 2))
    assert not np.array_equal(one.samples, other.samples)


def test_equal_samples_are_one_leaf_and_a_model_without_components_one_sample() -> None:
    primitive, _ = walking()
    still = LatentMixture(np.ones(1), np.zeros((1, primitive.dimensions)), 1e-120 * np.eye(primitive.dimensions)[None])
    frozen = build_tree(with_mixture(primitive, still), 0, LATENT)
    assert (frozen.sizes.tolist(), frozen.children.tolist()) == ([600], [0])
    nothing = build_tree(sliding(0), 0, LATENT)
    assert nothing.samples.shape == (1, 0)


def with_mixture(primitive: MotionPrimitive, mixture: LatentMixture) -> MotionPrimitive:
    return replace(primitive, mixture=mixture)


def test_a_tree_of_ten_thousand_samples_is_stored_in_less_than_two_megabytes() -> None:
    primitive, _ = walking()
    tree = build_tree(primitive, 0, end_effectors=[standard_joints()[name] for name in END_EFFECTORS])
    document = document_of(tree)
    assert len(encode_tree(document, "application/msgpack", arrays="blocks")) < 2_000_000


def document_of(tree: SampleTree) -> dict[str, Any]:
    return sample_tree_to_tree(tree, model_digest="sha256:" + "0" * 64, seed=0, options=TreeOptions())


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
def test_a_tree_comes_back_from_its_document_bit_by_bit(media_type: str) -> None:
    tree = build_tree(walking()[0], 5, LATENT)
    read = decode_tree(encode_tree(document_of(tree), media_type), media_type)
    SampleTreeDocument.model_validate(read)
    again = sample_tree_from_tree(read)
    for name in ("samples", "sizes", "children", "starts", "means"):
        assert np.array_equal(getattr(again, name), getattr(tree, name)), name


@pytest.mark.parametrize(
    ("sizes", "children"),
    [
        ([3], [1]),
        ([3, 1, 1], [2, 0, 0]),
        ([3, 2, 1], [0, 2, 0]),
        ([4, 2, 1], [2, 0, 0]),
        ([3, 3], [1, -1]),
        ([3, 0, 3], [2, 0, 0]),
        ([], []),
        ([3, 2, 1, 1], [2, 0, 0, 0]),
    ],
)
def test_nodes_that_make_no_tree_are_refused(sizes: list[int], children: list[int]) -> None:
    with pytest.raises(MotionError, match="tree"):
        SampleTree(np.zeros((3, 2), np.float32), np.array(sizes, np.int32), np.array(children, np.int32))


@pytest.mark.parametrize(
    ("field", "value"), [("samples", 0), ("branching", 1), ("leaf_size", 0), ("depth", 0), ("samples", 10**8)]
)
def test_options_out_of_range_are_refused_by_name(field: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=field):
        TreeOptions(**{field: value})


def test_end_effectors_are_needed_to_group_by_them() -> None:
    with pytest.raises(MotionError, match="positions of hands, feet and head"):
        build_tree(sliding(), 0)


@pytest.mark.parametrize(("branching", "leaf_size", "depth"), [(4, 1, 64), (3, 10, 64), (2, 5, 3), (16, 1, 1)])
@pytest.mark.parametrize("candidates", [1, 4, 1000])
def test_no_search_evaluates_more_motions_than_its_tree_tells_before(
    branching: int, leaf_size: int, depth: int, candidates: int
) -> None:
    primitive = walking()[0]
    options = TreeOptions(samples=300, branching=branching, leaf_size=leaf_size, depth=depth, features="latent")
    tree = build_tree(primitive, 1, options)
    for height in (0.8, 1.2):
        constraints = (JointPositionConstraint(joint="left_wrist", at="middle", target_m=(0.3, height, 0.5)),)
        objective = build_objective(primitive, constraints, standard_joints())
        evaluated = search_tree(objective, tree, candidates=candidates).evaluations
        assert evaluated <= tree.most_evaluations(candidates)
