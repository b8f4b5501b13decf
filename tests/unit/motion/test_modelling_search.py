"""Searches of trees, compared with a simple search in Python and with an evaluation of all samples."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.support.modelling_examples import walks
from tests.support.search_primitives import sliding, standard_joints, walking
from tests.support.tiers import examples

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_kinematics
from marey_motion.modelling.search.objective import Objective, build_objective
from marey_motion.modelling.search.optimise import refine
from marey_motion.modelling.search.samples import FoundSamples, search_closely, search_tree
from marey_motion.modelling.search.steps import SeveralSteps, Step
from marey_motion.modelling.search.tree import END_EFFECTORS, SampleTree, build_tree
from marey_motion.modelling.training import train_primitive
from marey_schemas.options.modelling import ModelOptions, TreeOptions
from marey_schemas.options.searching import RefineOptions
from marey_schemas.search_constraints import JointPositionConstraint, RootPositionConstraint, SearchConstraint

EVERYTHING = 10**6


def search_all(objective: Objective, tree: SampleTree, *, top: int = 1) -> FoundSamples:
    """Return the best samples, found by evaluating all samples without the tree."""
    costs = objective.costs(tree.samples.astype(np.float64))
    chosen = np.lexsort((np.arange(len(costs)), costs))[:top]
    return FoundSamples(chosen, tree.samples[chosen].astype(np.float64), costs[chosen], len(costs))


@cache
def grown(leaf_size: int = 1, samples: int = 2000) -> SampleTree:
    return build_tree(walking()[0], 2, TreeOptions(samples=samples, leaf_size=leaf_size, features="latent"))


def wrist_at(x: float, y: float, z: float) -> Objective:
    return build_objective(
        walking()[0], [JointPositionConstraint(joint="left_wrist", at="middle", target_m=(x, y, z))], standard_joints()
    )


TARGETS = st.tuples(st.floats(-0.5, 0.8), st.floats(0.5, 1.5), st.floats(0.0, 1.5))


def plain_beam(objective: Objective, tree: SampleTree, candidates: int) -> tuple[float, int]:
    """Return the cost and the index of the best sample that a beam search finds, one node at a time."""

    def cost(latent: NDArray[Any]) -> float:
        return float(objective.costs(np.asarray(latent, dtype=np.float64)[None])[0])

    frontier, found = [0], []
    while frontier:
        following = []
        for node in frontier:
            if not tree.children[node]:
                rows = range(tree.starts[node], tree.starts[node] + tree.sizes[node])
                found += [(cost(tree.samples[row]), row) for row in rows]
            for child in range(tree.first_children[node], tree.first_children[node] + tree.children[node]):
                if tree.sizes[child] == 1:
                    found.append((cost(tree.samples[tree.starts[child]]), int(tree.starts[child])))
                else:
                    following.append((cost(tree.means[child]), child))
        frontier = [node for _, node in sorted(following)[:candidates]]
    return min(found)


@settings(max_examples=examples(25))
@given(target=TARGETS, candidates=st.integers(1, 20), leaf_size=st.sampled_from((1, 5, 30)))
def test_the_beam_keeps_the_true_best_of_each_level(
    target: tuple[float, float, float], candidates: int, leaf_size: int
) -> None:
    objective, tree = wrist_at(*target), grown(leaf_size)
    found = search_tree(objective, tree, candidates=candidates)
    cost, row = plain_beam(objective, tree, candidates)
    assert (found.costs[0], found.samples[0]) == (cost, row)


@settings(max_examples=examples(25))
@given(target=TARGETS, leaf_size=st.sampled_from((1, 5, 30)), top=st.integers(1, 50))
def test_a_beam_of_all_nodes_is_an_exhaustive_search(
    target: tuple[float, float, float], leaf_size: int, top: int
) -> None:
    objective, tree = wrist_at(*target), grown(leaf_size)
    beam, everything = (
        search_tree(objective, tree, candidates=EVERYTHING, top=top),
        search_all(objective, tree, top=top),
    )
    assert np.array_equal(beam.samples, everything.samples)
    assert np.array_equal(beam.costs, everything.costs)
    assert np.array_equal(beam.latents, everything.latents)


def test_few_of_many_samples_are_looked_at() -> None:
    found = search_tree(wrist_at(0.3, 1.0, 0.4), grown(), candidates=4)
    assert found.evaluations < 150


def test_what_is_found_is_a_sample_and_never_a_mean() -> None:
    tree = grown()
    found = search_tree(wrist_at(0.3, 1.0, 0.4), tree, candidates=1)
    assert (tree.samples == found.latents[0].astype(np.float32)).all(axis=1).any()


def test_where_everything_costs_the_same_the_first_in_the_tree_are_found() -> None:
    tree = grown()
    free = build_objective(walking()[0], [], standard_joints())
    assert search_all(free, tree, top=3).samples.tolist() == [0, 1, 2]
    first = search_tree(free, tree, candidates=4)
    assert first.costs.tolist() == [0.0]


def test_a_root_that_is_a_leaf_is_searched() -> None:
    tree = build_tree(walking()[0], 2, TreeOptions(samples=50, leaf_size=50, features="latent"))
    objective = wrist_at(0.3, 1.0, 0.4)
    assert search_tree(objective, tree).costs == search_all(objective, tree).costs


def test_the_target_that_is_a_samples_own_is_found() -> None:
    tree, primitive = grown(), walking()[0]
    wanted = primitive.poses(tree.samples[777:778].astype(np.float64), [0.0])[0, 0, :3]
    objective = build_objective(
        primitive, [JointPositionConstraint(joint="pelvis", at=0, target_m=tuple(wanted))], {"pelvis": 0}
    )
    assert search_all(objective, tree).costs[0] < 1e-6


def test_threads_find_the_same() -> None:
    tree = grown()
    tree.means  # noqa: B018

    def found(_number: int) -> bytes:
        one = search_tree(wrist_at(0.2, 1.1, 0.5), tree, candidates=6, top=10)
        return one.latents.tobytes() + one.costs.tobytes()

    with ThreadPoolExecutor(2) as pool:
        assert len(set(pool.map(found, range(8)))) == 1


def test_a_tree_of_another_model_is_refused() -> None:
    with pytest.raises(MotionError, match="the model needs") as caught:
        search_tree(build_objective(sliding(), [RootPositionConstraint(at=0, target_m=(0.0, 0.0))], {}), grown())
    assert caught.value.code == "tree-of-another"


def test_a_beam_is_at_least_one_wide() -> None:
    with pytest.raises(MotionError):
        search_tree(wrist_at(0.0, 0.0, 0.0), grown(), candidates=0)


def test_a_model_that_never_varies_has_one_motion_to_find() -> None:
    primitive = sliding(0)
    tree = SampleTree(np.zeros((1, 0), np.float32), np.array([1], np.int32), np.array([0], np.int32))
    found = search_tree(build_objective(primitive, [RootPositionConstraint(at=0, target_m=(0.5, None))], {}), tree)
    np.testing.assert_allclose(found.costs, 50.0)


def test_looking_closer_comes_nearer_and_stays_as_likely() -> None:
    primitive, tree = walking()[0], grown()
    once, twice = [], []
    for target in primitive.sample(25, 31):
        place = primitive.poses(target[None], [0.0])[0, 0, :3]
        wanted: list[SearchConstraint] = [
            JointPositionConstraint(joint="pelvis", at=0, target_m=tuple(place)),
            RootPositionConstraint(at="end", target_m=(0.05, 1.1)),
        ]
        objective = build_objective(primitive, wanted, standard_joints())
        once.append(search_tree(objective, tree, candidates=4))
        twice.append(search_closely(objective, tree, candidates=4, passes=2))
    costs = np.array([[one.costs[0], other.costs[0]] for one, other in zip(once, twice, strict=True)])
    assert (costs[:, 1] <= costs[:, 0]).all()
    assert np.median(costs[:, 1]) < 0.7 * np.median(costs[:, 0])
    densities = primitive.log_density(np.concatenate([one.latents for one in twice]))
    assert np.median(densities) > np.percentile(primitive.log_density(tree.samples.astype(float)), 10)


def test_what_lies_between_samples_is_told_from_samples_and_costs_what_it_says() -> None:
    objective, tree = wrist_at(0.3, 1.0, 0.4), grown()
    found = search_closely(objective, tree)
    assert found.samples.tolist() == [-1]
    assert np.array_equal(objective.costs(found.latents), found.costs)
    assert search_closely(objective, tree, passes=1).samples[0] >= 0


def own_keyframes(**options: Any) -> tuple[list[Objective], SampleTree, list[tuple[JointPositionConstraint]], Floats]:
    """Return a search for each example of a model of walks: the target is the example's own left wrist at a keyframe.

    The result consists of the objectives by example, the tree of the model, the constraints by example, and the
    examples' latent vectors (m, L).
    """
    aligned, joints = walks(24), standard_joints()
    primitive = train_primitive(aligned, ModelOptions(leave_one_out=False, report_samples=0, **options)).primitive
    tree = build_tree(primitive, 0, TreeOptions(samples=10_000), end_effectors=[joints[name] for name in END_EFFECTORS])
    poses = aligned.poses[:, aligned.keyframes["contact"]]
    wrists = forward_kinematics(aligned.skeleton, poses)[:, joints["left_wrist"]]
    wanted = [
        (JointPositionConstraint(joint="left_wrist", at="contact", target_m=tuple(place)),) for place in wrists.tolist()
    ]
    objectives = [build_objective(primitive, one, joints) for one in wanted]
    return objectives, tree, wanted, primitive.latents_of(aligned.poses, aligned.time_functions)


def test_what_an_example_does_at_a_keyframe_is_found_as_near_as_the_model_holds_that_example() -> None:
    objectives, tree, _, latents = own_keyframes()
    for objective, own in zip(objectives, latents, strict=True):
        found = search_closely(objective, tree)
        assert objective.errors(found.latents)[0, 0] <= objective.errors(own[None])[0, 0]


def test_a_model_that_keeps_more_finds_it_within_millimetres_and_refined_within_one() -> None:
    objectives, tree, wanted, _ = own_keyframes(spatial_share=0.999)
    searched, refined = [], []
    for objective, constraints in zip(objectives, wanted, strict=True):
        found = search_closely(objective, tree).latents
        problem = SeveralSteps.of([Step(objective.primitive, constraints, standard_joints())])
        searched.append(objective.errors(found)[0, 0])
        refined.append(
            objective.errors(refine(problem, found[0], RefineOptions(likelihood_weight=0.01)).latents[None])[0, 0]
        )
    assert np.median(searched) < 1e-3
    assert max(searched) < 5e-3
    assert max(refined) < 1e-3
