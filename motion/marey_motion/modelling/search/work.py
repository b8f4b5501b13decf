"""Estimates of the work of a search, in nanoseconds of one thread.

They are computed from the numbers of samples, canonical frames, joints, nodes of trees, constraints and iterations,
with measured weights, so that the same request is always accepted or always refused, whatever the load of the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log

from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.search.found_motions import FoundMotion
from marey_motion.modelling.search.objective import Objective
from marey_motion.modelling.search.steps import SeveralSteps, Step
from marey_motion.modelling.search.tree import DEFAULT_TREE, SampleTree, feature_frames
from marey_schemas.options.modelling import TreeOptions
from marey_schemas.options.searching import RefineOptions
from marey_schemas.search_constraints import (
    JointOrientationConstraint,
    JointPositionConstraint,
    LookDirectionConstraint,
)

# Nanoseconds, measured on one thread of a server of 2020 and rounded up.
_PER_NODE, _PER_ROW, _PER_STEP_OF_TIME = 50, 50, 20
_PER_SLOPE = 30
_PER_LINEARISED_STEP = 100_000
_PRODUCTS_AT_ONCE = 8
_ROUNDS_OF_MEANS = 12
_PER_SPAN, _PER_NUMBER_OF_SPAN, _ROUNDS_OF_SPANS = 2_000_000, 10, 13


def drawing_work(
    primitive: MotionPrimitive, options: TreeOptions = DEFAULT_TREE, *, end_effectors: Sequence[int] = ()
) -> float:
    """Estimate the work of `build_tree` for the same arguments.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    options : TreeOptions    number of samples and shape of the tree
    end_effectors : sequence of int    joint indices

    Returns
    -------
    float    nanoseconds of one thread
    """
    spatial, times = primitive.spatial.count, primitive.frame_count * (primitive.temporal.count + _PER_STEP_OF_TIME)
    drawn = primitive.dimensions**2 + (0 if primitive.duration_range_s is None else 4 * times)
    levels = min(options.depth, 1 + log(max(1.0, options.samples / options.leaf_size), options.branching))
    means = options.branching * levels * _ROUNDS_OF_MEANS
    if options.features == "latent":
        return float(options.samples * (drawn + spatial * means))
    moments = len(feature_frames(primitive))
    nodes = len({carrier for joint in end_effectors for carrier in primitive.skeleton.path_to_root(joint)})
    tracked = moments * (spatial * (3 + 4 * nodes) + _PER_NODE * nodes)
    return float(options.samples * (drawn + tracked + 3 * moments * len(end_effectors) * means))


def searching_work(
    problem: SeveralSteps, trees: Sequence[SampleTree], *, candidates: int, passes: int, refining: RefineOptions | None
) -> float:
    """Estimate the time that `search_steps` takes for the steps of a problem.

    Parameters
    ----------
    problem : SeveralSteps    the steps with their constraints
    trees : sequence of SampleTree    samples of each step's primitive
    candidates : int    number of nodes that are followed from each level of a tree to the next
    passes : int    number of searches of each tree
    refining : RefineOptions or None    options of refinement; None if the samples are not refined

    Returns
    -------
    float    nanoseconds of one thread
    """
    width = sum(link.objective.primitive.dimensions for link in problem.links)
    searched = sum(
        passes * tree.most_evaluations(candidates) * _evaluation_work(link.objective)
        for link, tree in zip(problem.links, trees, strict=True)
    )
    linearised = sum(_slope_work(link.objective, width) for link in problem.links)
    searched += 0.5 * len(problem.links) * linearised  # each step begins where those before it end
    if refining is None:
        return searched
    rows = 3 * sum(len(link.objective.constraints) + 1 + len(problem.joints) for link in problem.links)
    priors = sum(mixture.means.size * mixture.dimensions for mixture in problem.priors)
    products = (rows * width**2 + width**3) / _PRODUCTS_AT_ONCE
    tries = 2 if refining.likelihood_weight is None else 1
    return searched + tries * refining.iterations * (linearised + priors + products)


def finishing_work(steps: Sequence[Step], found: FoundMotion) -> float:
    """Estimate the work of `finish_motion` for the same arguments.

    Parameters
    ----------
    steps : sequence of Step    the steps with their constraints
    found : FoundMotion    the motion found for them

    Returns
    -------
    float    nanoseconds of one thread
    """
    kinds = JointPositionConstraint | JointOrientationConstraint | LookDirectionConstraint
    spans = sum(isinstance(constraint, kinds) for step in steps for constraint in step.constraints)
    rounds = _ROUNDS_OF_SPANS if spans > 1 else 1
    return float(rounds * spans * (_PER_SPAN + _PER_NUMBER_OF_SPAN * found.motion.rotations.size))


def _evaluation_work(objective: Objective) -> float:
    """Estimate the work of evaluating one motion in a tree."""
    primitive, chains = objective.primitive, objective.chains
    times = len(objective.clocks.weights) + (primitive.temporal.count + _PER_STEP_OF_TIME)
    timed = primitive.frame_count * times if len(objective.clocks.weights) else 0
    return float(
        chains.directions.size + _PER_NODE * len(chains.parents) + _PER_ROW * len(objective.constraints) + timed
    )


def _slope_work(objective: Objective, width: int) -> float:
    """Estimate the work of evaluating one motion and its derivatives with respect to `width` numbers."""
    timed = objective.primitive.frame_count * width if len(objective.clocks.weights) else 0
    followed = (len(objective.chains.parents) + len(objective.constraints)) * width
    return float(_PER_LINEARISED_STEP + objective.chains.directions.size + _PER_SLOPE * followed + timed)
