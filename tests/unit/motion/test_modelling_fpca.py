"""Principal component analysis of motions: principal functions, signs of quaternions, and weights of channels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.decomposition import PCA
from tests.support.modelling_examples import bending_chains, chain, unit_poses, walks
from tests.support.present import present
from tests.support.tiers import examples

from marey_motion import quaternions
from marey_motion.alignment.signs import consistent_signs
from marey_motion.arrays import Floats
from marey_motion.modelling import scaling
from marey_motion.modelling.fpca import Keep, PrincipalExamples, find_components
from marey_motion.modelling.scaled_fpca import SMALLEST_WEIGHT, _logarithms, _Problem, optimised_weights
from marey_motion.modelling.scaling import LEAST_WEIGHT_M, jacobian_weights, root_max_weights
from marey_motion.modelling.splines import SplineBasis
from marey_motion.skeleton import Skeleton
from marey_schemas.options.modelling import InnerProduct

BASIS = SplineBasis.clamped(30, 8)
CHANNELS = 11


def some(examples: int = 12, seed: int = 0, rank: int | None = None) -> Floats:
    """Return coefficients (examples, 8, 11) of full rank, or of the rank `rank`."""
    random = np.random.default_rng(seed)
    if rank is None:
        return random.standard_normal((examples, 8, CHANNELS))
    modes = random.standard_normal((rank, 8, CHANNELS))
    return 1.0 + np.tensordot(random.standard_normal((examples, rank)), modes, axes=1)


def all_of(
    coefficients: Floats, weights: Floats | None = None, inner_product: InnerProduct = "coefficients"
) -> PrincipalExamples:
    weights = np.ones(coefficients.shape[2]) if weights is None else weights
    return find_components(BASIS, coefficients, weights, Keep(1.0), inner_product)


@settings(max_examples=examples(20))
@given(st.integers(2, 25), st.integers(0, 10_000), st.sampled_from(["coefficients", "l2"]))
def test_all_components_together_reconstruct_the_examples(
    examples: int, seed: int, inner_product: InnerProduct
) -> None:
    coefficients = some(examples, seed)
    weights = np.exp(np.random.default_rng(seed).uniform(-4.0, 4.0, CHANNELS))
    found = all_of(coefficients, weights, inner_product)
    functions = found.functions
    made = functions.coefficients(functions.scores(coefficients))
    np.testing.assert_allclose(made, coefficients, atol=1e-9)
    np.testing.assert_allclose(functions.scores(coefficients), found.scores, atol=1e-9)


@given(st.integers(0, 10_000))
def test_projections_undo_directions(seed: int) -> None:
    weights = np.exp(np.random.default_rng(seed).uniform(-3.0, 3.0, CHANNELS))
    functions = all_of(some(10, seed), weights).functions
    products = np.tensordot(functions.directions, functions.projections, axes=([1, 2], [1, 2]))
    np.testing.assert_allclose(products, np.eye(functions.count), atol=1e-9)


def test_components_are_those_of_an_independent_library() -> None:
    coefficients = some(15, 3)
    found, known = all_of(coefficients), PCA().fit(coefficients.reshape(15, -1))
    count = found.functions.count
    assert count == 14
    np.testing.assert_allclose(found.functions.variances, known.explained_variance_[:count], rtol=1e-9)
    ours = found.functions.directions.reshape(count, -1)
    np.testing.assert_allclose(np.abs(np.sum(ours * known.components_[:count], axis=1)), 1.0, atol=1e-9)


def test_the_share_of_variance_counts_every_component() -> None:
    """A truncated decomposition lacks the last components, so its share of variance would be too high."""
    coefficients = some(9, 5)
    deviations = np.linalg.svd((coefficients - coefficients.mean(axis=0)).reshape(9, -1), compute_uv=False)
    share = np.cumsum(deviations**2) / np.sum(deviations**2)
    found = all_of(coefficients)
    np.testing.assert_allclose(found.energy, share[:8], rtol=1e-9)
    assert (np.diff(found.energy) >= 0.0).all()
    assert found.energy[-1] == pytest.approx(1.0)
    few = find_components(BASIS, coefficients, np.ones(CHANNELS), Keep(0.8)).functions.count
    assert share[few - 1] >= 0.8 > share[few - 2]


def test_as_many_components_are_kept_as_the_examples_have() -> None:
    coefficients = some(20, 1, rank=3)
    weights = np.ones(CHANNELS)
    assert all_of(coefficients).functions.count == 3
    assert find_components(BASIS, coefficients, weights, Keep(count=2)).functions.count == 2
    assert find_components(BASIS, coefficients, weights, Keep(count=9)).functions.count == 3
    assert find_components(BASIS, coefficients, weights, Keep(1.0, most=1)).functions.count == 1


@pytest.mark.parametrize("examples", [1, 2, 7])
def test_copies_of_one_example_have_no_components(examples: int) -> None:
    coefficients = np.repeat(some(1, 4), examples, axis=0)
    found = all_of(coefficients)
    assert found.functions.count == 0
    np.testing.assert_allclose(found.functions.coefficients(np.zeros((1, 0)))[0], coefficients[0], atol=1e-12)


@settings(max_examples=examples(10))
@given(st.integers(0, 10_000))
def test_more_components_never_reconstruct_worse(seed: int) -> None:
    coefficients = some(12, seed)
    errors = []
    for count in range(12):
        functions = find_components(BASIS, coefficients, np.ones(CHANNELS), Keep(count=count)).functions
        errors.append(np.linalg.norm(functions.coefficients(functions.scores(coefficients)) - coefficients))
    assert (np.diff(errors) <= 1e-9).all()


def test_as_functions_components_do_not_depend_on_the_knots() -> None:
    coarse, fine = SplineBasis.clamped(41, 8), SplineBasis(_refined(SplineBasis.clamped(41, 8).knots))
    coefficients = some(10, 2)[..., :3]
    finer = fine.fit(coarse.at_frames @ coefficients)
    np.testing.assert_allclose(fine.at_frames @ finer, coarse.at_frames @ coefficients, atol=1e-9)
    ones = np.ones(3)
    one = find_components(coarse, coefficients, ones, Keep(1.0), "l2")
    other = find_components(fine, finer, ones, Keep(1.0), "l2")
    np.testing.assert_allclose(np.abs(other.scores), np.abs(one.scores), atol=1e-7)
    plain = find_components(fine, finer, ones, Keep(1.0))
    assert np.abs(np.abs(plain.scores) - np.abs(one.scores)).max() > 1e-2


def _refined(knots: Floats) -> Floats:
    inner = np.unique(knots)
    return np.sort(np.concatenate((knots, 0.5 * (inner[1:] + inner[:-1]))))


def test_signs_of_components_do_not_depend_on_the_order_of_the_examples() -> None:
    coefficients = some(9, 8)
    one, other = all_of(coefficients), all_of(coefficients[::-1])
    np.testing.assert_allclose(one.functions.directions, other.functions.directions, atol=1e-9)
    flat = one.functions.directions.reshape(8, -1)
    assert (flat[np.arange(8), np.abs(flat).argmax(axis=1)] > 0.0).all()


# -- signs of quaternions ----------------------------------------------------------------------------------------------


def turning(turns: float, frames: int = 60) -> Floats:
    """Return the rotations (frames, 1, 4) of one joint that turns about y."""
    angles = np.linspace(0.0, 2.0 * np.pi * turns, frames)
    return quaternions.from_axis_angle((0.0, 1.0, 0.0), angles).astype(np.float64)[:, None]


def test_a_turn_beyond_half_a_turn_stays_in_one_piece() -> None:
    """A comparison of each frame with one fixed pose would change the signs of quaternions during the turn."""
    rotations = turning(0.9)
    jumping = rotations * np.where(rotations @ rotations[0, 0] < 0.0, -1.0, 1.0)[..., None]
    assert np.abs(np.diff(jumping, axis=0)).max() > 1.0
    found = consistent_signs(jumping[None], jumping)
    assert np.abs(np.diff(found[0], axis=0)).max() < 0.1


@given(st.lists(st.booleans(), min_size=60, max_size=60), st.booleans())
def test_signs_are_those_of_the_reference_whatever_they_were(flips: list[bool], all_flipped: bool) -> None:
    reference = turning(0.7)
    mine = turning(0.65) * np.where(flips, -1.0, 1.0)[:, None, None] * (-1.0 if all_flipped else 1.0)
    found = consistent_signs(mine[None], reference)[0]
    np.testing.assert_allclose(found, turning(0.65), atol=1e-12)


# -- scalings ----------------------------------------------------------------------------------------------------------


def test_root_axes_are_scaled_one_by_one_and_a_still_one_is_left() -> None:
    poses = np.zeros((3, 10, 3 + 4))
    poses[..., 0], poses[..., 2] = 1e-5, np.linspace(-4.0, 2.0, 10)
    np.testing.assert_allclose(root_max_weights(poses), [1.0, 1.0, 0.25, 1.0, 1.0, 1.0, 1.0])


def test_a_joint_weighs_what_a_step_of_it_moves_the_body() -> None:
    """All bones lie in a plane, and joints rotate about the normal of this plane, so levers have their full length."""
    skeleton = chain(5)
    pose = np.concatenate((np.zeros(3), np.tile([1.0, 0.0, 0.0, 0.0], 5)))
    weights = jacobian_weights(skeleton, pose[None])
    from marey_motion.kinematics import forward_kinematics

    still, step = forward_kinematics(skeleton, pose[None]), 1e-6
    for joint in range(4):
        bent = pose.copy()
        bent[3 + 4 * joint + 3] = step
        moved = forward_kinematics(skeleton, unit_poses(bent[None])) - still
        assert np.sqrt((moved**2).sum(axis=2).mean()) / step == pytest.approx(weights[3 + 4 * joint], rel=1e-4)
    assert weights[3 + 4 * 4] == LEAST_WEIGHT_M
    np.testing.assert_array_equal(weights[:3], 1.0)


def test_weights_of_a_mean_pose_are_those_of_its_normalised_rotations() -> None:
    skeleton = chain(5)
    poses = unit_poses(np.random.default_rng(4).normal(size=(9, 3 + 4 * 5)))
    shorter = poses.copy()
    shorter[:, 3:] *= 0.93
    np.testing.assert_allclose(jacobian_weights(skeleton, shorter), jacobian_weights(skeleton, poses), rtol=1e-12)


def test_weights_do_not_depend_on_how_many_frames_are_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    skeleton = chain(5)
    poses = unit_poses(np.random.default_rng(2).normal(size=(17, 3 + 4 * 5)))
    whole = jacobian_weights(skeleton, poses)
    monkeypatch.setattr(scaling, "MOST_DIFFERENCES", 5 * 5 * 4)
    np.testing.assert_allclose(jacobian_weights(skeleton, poses), whole, rtol=1e-12)


@pytest.mark.parametrize("inner_product", ["coefficients", "l2"])
def test_the_gradient_of_the_optimised_scaling_is_that_of_its_error(inner_product: InnerProduct) -> None:
    aligned = walks(10, 30)
    basis = SplineBasis.clamped(30, 8)
    problem = _Problem(aligned.skeleton, basis, basis.fit(aligned.poses), 3, inner_product)
    weights = 0.3 * np.random.default_rng(1).standard_normal(3 + aligned.skeleton.joint_count)
    _, gradient = problem.value_and_gradient(weights)
    step = 1e-5
    for place in range(0, len(weights), 3):
        change = step * np.eye(len(weights))[place]
        ahead, behind = (problem.value_and_gradient(weights + way * change)[0] for way in (1, -1))
        assert gradient[place] == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-10)


def test_optimised_weights_bring_joints_nearer_than_those_they_start_from() -> None:
    aligned = walks(14, 30)
    basis = SplineBasis.clamped(30, 8)
    coefficients = basis.fit(aligned.poses)
    ones, root_max = np.ones(coefficients.shape[2]), root_max_weights(aligned.poses)
    weights, keep = optimised_weights(aligned.skeleton, basis, coefficients, (root_max, ones), Keep(0.9))
    problem = _Problem(aligned.skeleton, basis, coefficients, present(keep.count), "coefficients")
    before, after = (
        [problem.value_and_gradient(_logarithms(one))[0] for one in many] for many in ((ones, root_max), (weights,))
    )
    assert after[0] < 0.9 * min(before)
    assert (weights >= SMALLEST_WEIGHT * (1 - 1e-9)).all()
    np.testing.assert_array_equal(weights[3::4], weights[6::4])


def test_an_optimised_scaling_of_copies_is_no_trouble() -> None:
    skeleton: Skeleton = chain()
    aligned = bending_chains(1)
    coefficients = np.repeat(SplineBasis.clamped(30, 7).fit(aligned.poses), 4, axis=0)
    ones = np.ones(coefficients.shape[2])
    weights, keep = optimised_weights(skeleton, SplineBasis.clamped(30, 7), coefficients, (ones,), Keep())
    np.testing.assert_allclose(weights, ones)
    assert keep.count == 0
