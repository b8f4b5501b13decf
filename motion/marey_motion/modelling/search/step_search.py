"""Search for motions of several steps: first each step in its tree, starting at the end of the previous step, then
refinement of all steps together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion.alignment.aligned import Placement
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.modelling.search.constraints import START
from marey_motion.modelling.search.objective import AT_ORIGIN, build_objective
from marey_motion.modelling.search.optimise import DEFAULT_REFINING, Refined, refine
from marey_motion.modelling.search.samples import FoundSamples, search_closely
from marey_motion.modelling.search.steps import (
    DEFAULT_TRANSITIONS,
    Measured,
    SeveralSteps,
    Step,
    StepStart,
)
from marey_motion.modelling.search.tree import SampleTree
from marey_schemas.options.searching import CANDIDATES, PASSES, RefineOptions, TransitionOptions
from marey_schemas.search_constraints import JointPositionConstraint


@dataclass(frozen=True, eq=False)
class Sequel:
    """Motions that were found for several steps.

    Parameters
    ----------
    latents : one latent vector (L,) per step
    measured : placements and errors of the motions
    joints : standard names of the joints whose jumps are measured; a jump is the change of position from the end of one
        step to the start of the next. `Measured.jumps_m` lists the jump of the pelvis, then the jumps of `joints`
    searched : result of the search in each tree
    sampled : placements and errors before refining
    refined : result of refining, None if it was not requested
    """

    latents: tuple[Floats, ...]
    measured: Measured
    joints: tuple[str, ...]
    searched: tuple[FoundSamples, ...]
    sampled: Measured
    refined: Refined | None


def search_steps(
    steps: Sequence[Step],
    trees: Sequence[SampleTree],
    *,
    start: Placement = AT_ORIGIN,
    candidates: int = CANDIDATES,
    passes: int = PASSES,
    refining: RefineOptions | None = DEFAULT_REFINING,
    transitions: TransitionOptions = DEFAULT_TRANSITIONS,
) -> Sequel:
    """Find a motion for each step.

    Parameters
    ----------
    steps : sequence of Step    the steps with their constraints
    trees : sequence of SampleTree    samples of each step's primitive
    start : Placement    position and heading in the world at which the first step begins
    candidates : int    nodes of a tree that are followed from each level to the next
    passes : int    searches of each tree; every search after the first one moves the samples closer to the best one
    refining : RefineOptions or None    None to keep the samples that were found
    transitions : TransitionOptions    continuity between steps

    Returns
    -------
    Sequel    latent vectors, placements and errors

    Raises
    ------
    InvalidConstraint    naming step and constraint
    MotionError    if the errors or costs become too large to compute with
    """
    problem = SeveralSteps.of(steps, start, transitions)
    searched: list[FoundSamples] = []
    for step, tree in zip(steps, trees, strict=True):
        begun = problem.start_of_next([one.latents[0] for one in searched])
        searched.append(_search_step(step, tree, begun, candidates, passes, transitions))
    stacked = np.concatenate([one.latents[0] for one in searched])
    measured = sampled = problem.measure(stacked)
    refined = None if refining is None else refine(problem, stacked, refining)
    if refined is not None:
        stacked = refined.latents
        measured = problem.measure(stacked)
    _require_finite(stacked, *measured.errors, *measured.jumps_m)
    return Sequel(problem.parts(stacked), measured, problem.joints, tuple(searched), sampled, refined)


def _require_finite(*found: Floats) -> None:
    if not all(np.isfinite(numbers).all() for numbers in found):
        raise MotionError(
            "the constraints lead to numbers that are not finite; move them closer to the motions of the model",
            code="search-not-finite",
        )


def _search_step(
    step: Step, tree: SampleTree, begun: StepStart, candidates: int, passes: int, transitions: TransitionOptions
) -> FoundSamples:
    """Find the best motion in the tree of a step that starts at `begun`, where the previous step ended."""
    _require_finite(*begun.joints.values())
    # The end of a motion may lie outside of the range that requests are limited to, so these are not validated.
    going_on = tuple(
        JointPositionConstraint.model_construct(
            joint=name, at=START, target_m=(x, y, z), tolerance_m=transitions.tolerance_m, weight=transitions.weight
        )
        for name, (x, y, z) in ((name, point.tolist()) for name, point in begun.joints.items())
    )
    constraints = (*step.constraints, *going_on)
    objective = build_objective(step.primitive, constraints, step.standard_joints, placement=begun.placement)
    return search_closely(objective, tree, candidates=candidates, passes=passes)
