"""Refinement of motions, compared with closed forms if these exist, otherwise checked for general properties."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from tests.support.search_primitives import FRAMES, sliding, standard_joints, walking

from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_kinematics
from marey_motion.modelling.mixture import LatentMixture
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.constraints import tolerance_of
from marey_motion.modelling.search.objective import Objective, build_objective
from marey_motion.modelling.search.optimise import _Prior, refine
from marey_motion.modelling.search.samples import search_tree
from marey_motion.modelling.search.steps import SeveralSteps, Step
from marey_motion.modelling.search.tree import build_tree
from marey_schemas.options.modelling import TreeOptions
from marey_schemas.options.searching import LIKELIHOOD_WEIGHT, RefineOptions
from marey_schemas.search_constraints import (
    JointPositionConstraint,
    KeyframeTimeConstraint,
    RootHeadingConstraint,
    RootPositionConstraint,
)

WRIST = (JointPositionConstraint(joint="left_wrist", at="middle", target_m=(0.35, 1.0, 0.6)),)


def on_walks(constraints: tuple[Any, ...], mixtures: int = 2) -> SeveralSteps:
    return SeveralSteps.of([Step(walking(mixtures=mixtures)[0], tuple(constraints), standard_joints())])


def objective_of(primitive: MotionPrimitive, constraints: tuple[Any, ...], joints: dict[str, int]) -> Objective:
    return build_objective(primitive, constraints, joints)


def posterior(
    primitive: MotionPrimitive, constraints: tuple[Any, ...], joints: dict[str, int], weight: float
) -> Callable[..., Any]:
    """Return the function ½ Σ w (e / σ)² - λ ln p of a latent vector, computed from the errors alone."""
    objective = objective_of(primitive, constraints, joints)
    scales = np.array(
        [one.weight / tolerance**2 for one, tolerance in zip(constraints, tolerances(constraints), strict=True)]
    )

    def cost(latent: Floats) -> float:
        errors = objective.errors(latent[None])[0]
        return 0.5 * float(scales @ errors**2) - weight * float(primitive.log_density(latent[None])[0])

    return cost


def tolerances(constraints: tuple[Any, ...]) -> list[float]:
    return [tolerance_of(one) for one in constraints]


@pytest.mark.parametrize("weight", [1.0, 0.01, 25.0])
def test_with_one_gaussian_and_linear_constraints_the_result_is_that_of_ridge_regression(weight: float) -> None:
    primitive = sliding(2)
    constraints = (RootPositionConstraint(at="middle", target_m=(0.25, None), tolerance_m=0.02, weight=3.0),)
    problem = SeveralSteps.of([Step(primitive, constraints, {})])
    found = refine(problem, np.array([2.0, -3.0]), RefineOptions(likelihood_weight=weight))
    # The root's x is 0.1 times the first score.
    slope = np.array([[0.1, 0.0]]) * np.sqrt(3.0) / 0.02
    precision = weight * np.linalg.inv(primitive.mixture.covariances[0])
    mean = primitive.mixture.means[0]
    right = slope.T @ (np.sqrt(3.0) / 0.02 * np.array([0.25])) + precision @ mean
    np.testing.assert_allclose(found.latents, np.linalg.solve(slope.T @ slope + precision, right), rtol=1e-7)


def test_without_constraints_the_result_is_the_mean() -> None:
    primitive = sliding(2)
    found = refine(SeveralSteps.of([Step(primitive, (), {})]), np.array([5.0, 5.0]))
    np.testing.assert_allclose(found.latents, primitive.mixture.means[0], atol=1e-9)


def slopes_of(cost: Callable[..., Any], latents: Floats) -> list[float]:
    """Return the derivatives of a cost, computed by central differences."""
    return [(cost(latents + 1e-5 * one) - cost(latents - 1e-5 * one)) / 2e-5 for one in np.eye(len(latents))]


@pytest.mark.parametrize("mixtures", [1, 2, 3])
@pytest.mark.parametrize("weight", [1.0, 0.05])
def test_where_it_ends_nothing_nearby_is_better(weight: float, mixtures: int) -> None:
    primitive, _ = walking(mixtures=mixtures)
    constraints = (
        *WRIST,
        RootHeadingConstraint(at="end", heading_deg=11.0),
        KeyframeTimeConstraint(at="end", seconds=0.9),
    )
    cost = posterior(primitive, constraints, standard_joints(), weight)
    found = refine(
        on_walks(constraints, mixtures=mixtures), primitive.mixture.means[0], RefineOptions(likelihood_weight=weight)
    )
    np.testing.assert_allclose(found.cost, cost(found.latents), rtol=1e-9)
    np.testing.assert_allclose(slopes_of(cost, found.latents), 0.0, atol=1e-4)


@pytest.mark.parametrize("weight", [1.0, 0.05])
def test_the_gradient_of_the_prior_is_that_of_its_cost(weight: float) -> None:
    prior = _Prior([walking(mixtures=1)[0].mixture, sliding(2).mixture], weight)
    for latents in np.random.default_rng(6).normal(size=(10, 10)):
        expected = slopes_of(prior.cost, latents)
        np.testing.assert_allclose(prior.quadratic(latents).gradient, expected, rtol=1e-6, atol=1e-6)


def test_the_result_is_never_worse_than_the_start() -> None:
    primitive, _ = walking(mixtures=3)
    cost = posterior(primitive, WRIST, standard_joints(), 1.0)
    for start in primitive.sample(40, 9) * 2.0:
        found = refine(on_walks(WRIST, mixtures=3), start, RefineOptions(likelihood_weight=1.0))
        np.testing.assert_allclose((found.start_cost, found.cost), (cost(start), cost(found.latents)), rtol=1e-9)
        assert found.cost <= found.start_cost


def test_no_iterations_return_the_start() -> None:
    start = walking()[0].sample(1, 1)[0]
    found = refine(on_walks(WRIST), start, RefineOptions.model_construct(likelihood_weight=1.0, iterations=0))
    assert np.array_equal(found.latents, start)


def test_what_a_motion_does_already_is_met_within_a_millimetre() -> None:
    primitive, latents = walking()
    tree = build_tree(primitive, 1, TreeOptions(samples=3000, features="latent"))
    for example in latents[::8]:
        pose = primitive.poses(example[None], [float(FRAMES // 2)])[:, 0]
        place = forward_kinematics(primitive.skeleton, pose)[0, standard_joints()["left_wrist"]]
        wanted = (JointPositionConstraint(joint="left_wrist", at="middle", target_m=tuple(place.tolist())),)
        objective = objective_of(primitive, wanted, standard_joints())
        sample = search_tree(objective, tree, candidates=8)
        assert sample.costs[0] < 3.0
        refined = refine(on_walks(wanted), sample.latents[0], RefineOptions(likelihood_weight=0.01))
        assert objective.errors(refined.latents[None])[0, 0] < 1e-3
        assert primitive.log_density(refined.latents[None])[0] > primitive.log_density(latents).min()


def test_out_of_reach_a_smaller_weight_comes_nearer_and_a_larger_one_stays_likelier() -> None:
    primitive, _ = walking(mixtures=1)
    wanted = (JointPositionConstraint(joint="left_wrist", at="middle", target_m=(1.5, 2.0, 0.0), tolerance_m=0.1),)
    objective = objective_of(primitive, wanted, standard_joints())
    errors, densities = [], []
    for weight in (100.0, 10.0, 1.0, 0.1, 0.01):
        found = refine(
            on_walks(wanted, mixtures=1),
            primitive.mixture.means[0],
            RefineOptions(likelihood_weight=weight, iterations=200),
        ).latents[None]
        errors.append(objective.errors(found)[0, 0])
        densities.append(primitive.log_density(found)[0])
    assert (np.diff(errors) < 0).all()
    assert (np.diff(densities) < 0).all()


def test_the_component_of_the_mixture_is_picked_anew_on_the_way() -> None:
    primitive = sliding(1)
    two = LatentMixture(np.array([0.5, 0.5]), np.array([[-2.0], [2.0]]), np.full((2, 1, 1), 0.25))
    problem = SeveralSteps.of(
        [Step(replace(primitive, mixture=two), (RootPositionConstraint(at="middle", target_m=(0.2, None)),), {})]
    )
    found = refine(problem, np.array([-2.0]))
    # At 2 both the target and the second component are met.
    np.testing.assert_allclose(found.latents, 2.0, atol=1e-3)


def test_a_model_that_never_varies_stays_as_it_is() -> None:
    found = refine(
        SeveralSteps.of([Step(sliding(0), (RootPositionConstraint(at=0, target_m=(1.0, 0.0)),), {})]), np.zeros(0)
    )
    assert found.latents.shape == (0,)
    assert found.cost == found.start_cost


@pytest.mark.parametrize("options", [{"lambda": -1.0}, {"lambda": np.nan}, {"iterations": -1}])
def test_options_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(options))):
        RefineOptions.model_validate(options)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_target_out_of_all_reach_and_all_proportion_is_approached_as_far_as_rounding_allows(weight: float) -> None:
    constraints = (
        JointPositionConstraint(joint="head", at="end", target_m=(1e6, 1e6, 1e6), tolerance_m=1e-5, weight=1e6),
    )
    start = walking()[0].mixture.means[0]
    found = refine(on_walks(constraints), start, RefineOptions(likelihood_weight=weight))
    assert np.isfinite(found.latents).all()
    assert np.isfinite(found.cost)
    assert found.cost <= found.start_cost


def test_slopes_without_any_curvature_are_damped_instead_of_failing() -> None:
    class Flat:
        """Objective whose error is always 1, although its derivatives are stated as 1e20; the prior is constant."""

        priors = (LatentMixture(np.ones(1), np.zeros((1, 2)), 1e40 * np.eye(2)[None]),)

        def linearise(self, stacked: Floats) -> tuple[Floats, Floats]:
            return np.ones(1), np.array([[1e20, 1e20]]) * (1.0 + 0.0 * stacked)

    found = refine(Flat(), np.zeros(2), RefineOptions(likelihood_weight=0.0))
    np.testing.assert_array_equal(found.latents, 0.0)


def test_errors_too_large_to_compute_with_are_refused() -> None:
    step = Step(
        walking()[0], (JointPositionConstraint(joint="head", at="end", target_m=(0.0, 0.0, 0.0)),), standard_joints()
    )
    problem = SeveralSteps.of([step], Placement(0.0, 1e200, 0.0))
    with pytest.raises(MotionError, match="too large"):
        refine(problem, walking()[0].mixture.means[0])


@pytest.mark.parametrize("seed", range(6))
def test_by_default_the_errors_never_end_larger_than_they_began(seed: int) -> None:
    """With a weight of 1, which was the default, the errors of a good start became larger."""
    primitive = sliding(2)
    start = np.random.default_rng(seed).normal(0.0, 2.0, 2)
    # A target 0.01 mm from where the start is: nearer than the likelihood lets the result stay.
    target = 0.1 * start[0] + 1e-5
    constraints = (RootPositionConstraint(at="middle", target_m=(target, None), tolerance_m=0.02),)
    problem = SeveralSteps.of([Step(primitive, constraints, {})])

    def error(found: Floats) -> float:
        return float(problem.measure(found).errors[0][0])

    assert error(refine(problem, start).latents) <= error(start) + 1e-15
    assert error(refine(problem, start, RefineOptions(likelihood_weight=1.0)).latents) > error(start)


def test_the_tries_of_a_refinement_that_is_repeated_are_counted_too() -> None:
    primitive = sliding(2)
    start = np.random.default_rng(0).normal(0.0, 2.0, 2)
    constraints = (RootPositionConstraint(at="middle", target_m=(0.1 * start[0] + 1e-8, None), tolerance_m=0.02),)
    problem = SeveralSteps.of([Step(primitive, constraints, {})])
    parts = [refine(problem, start, RefineOptions(likelihood_weight=weight)) for weight in (LIKELIHOOD_WEIGHT, 0.0)]
    found = refine(problem, start)
    assert np.array_equal(found.latents, parts[1].latents)
    assert found.iterations == sum(one.iterations for one in parts)
    assert found.evaluations == sum(one.evaluations for one in parts)
