"""Inverse kinematics that removes the remaining errors of a motion found by a search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from marey_motion.editing.constraining import Constraint as Constrained
from marey_motion.editing.finish import finish
from marey_motion.editing.inverse_kinematics.limbs import limb_ending_at
from marey_motion.editing.inverse_kinematics.targets import LookAtTarget, OrientationTarget, PositionTarget, Target
from marey_motion.errors import MappingError
from marey_motion.modelling.search.constraints import joint_index
from marey_motion.modelling.search.found_motions import FoundMotion
from marey_motion.modelling.search.steps import Step
from marey_motion.rigs import JointAxes, JointMapping, guess_axes
from marey_schemas.editing.constraints import Axes
from marey_schemas.search_constraints import (
    JointOrientationConstraint,
    JointPositionConstraint,
    LookDirectionConstraint,
    SearchConstraint,
)

FAR_AWAY_M = 1000.0
"""Distance in metres from a joint to the point that replaces the direction of a look direction constraint."""


@dataclass(frozen=True, eq=False)
class Finished:
    """A motion after inverse kinematics.

    Parameters
    ----------
    errors : remaining error, in metres or radians, of each constraint that a solver can meet; the keys are the index of
        the step and the index of the constraint in the step
    """

    found: FoundMotion
    errors: dict[tuple[int, int], float]


def finish_motion(steps: Sequence[Step], found: FoundMotion, mapping: JointMapping) -> Finished:
    """Bring joints to their targets by inverse kinematics, at the frames nearest to the times of the constraints.

    Only the limb, or the chain up to the pelvis, moves; the position of the body and the timing stay the same. Only
    constraints on the position, orientation or look direction of a joint are met; constraints on the pelvis are not.

    Parameters
    ----------
    steps : sequence of Step    the steps with their constraints
    found : FoundMotion    the motion found for them
    mapping : JointMapping    standard joints of the skeleton

    Returns
    -------
    Finished    the motion and the remaining errors
    """
    axes = _axes_if_known(found, mapping)
    places: list[tuple[int, int]] = []
    wanted: list[Constrained] = []
    for number, step in enumerate(steps):
        for place, constraint in enumerate(step.constraints):
            one = _constrained(step, number, constraint, found, mapping, axes)
            if one is not None:
                places.append((number, place))
                wanted.append(one)
    if not wanted:
        return Finished(found, {})
    made = finish(found.skeleton, found.motion, wanted)
    left = dict(zip(places, made.residual_after.tolist(), strict=True))
    return Finished(replace(found, motion=made.motion), left)


def _axes_if_known(found: FoundMotion, mapping: JointMapping) -> dict[str, JointAxes] | None:
    """Return the axes of the mapped joints by name; None if the mapping is not sufficient to compute them."""
    try:
        return guess_axes(found.skeleton, mapping, found.motion.as_clip(found.skeleton, found.frame_rate_hz))
    except MappingError:
        return None


def _constrained(
    step: Step,
    number: int,
    constraint: SearchConstraint,
    found: FoundMotion,
    mapping: JointMapping,
    axes: Mapping[str, JointAxes] | None,
) -> Constrained | None:
    """Convert a constraint of step `number` for inverse kinematics; None if inverse kinematics cannot meet it."""
    if not isinstance(constraint, JointPositionConstraint | JointOrientationConstraint | LookDirectionConstraint):
        return None
    joint = joint_index(step.primitive, constraint.joint, step.standard_joints)
    chain = _chain(found, joint, step.standard_joints.get("pelvis", 0))
    if not chain:
        return None
    frame = found.frame_of(number, step.primitive, constraint.at)
    limb = limb_ending_at(found.skeleton, mapping, joint, axes)
    return Constrained(_target(constraint, joint, frame, found), frame, frame + 1, chain, limb)


def _chain(found: FoundMotion, joint: int, pelvis: int) -> tuple[int, ...]:
    """List a joint and its ancestors below the pelvis; the pelvis is left out because it would turn the whole body."""
    path = found.skeleton.path_to_root(joint)
    return path[: path.index(pelvis)] if pelvis in path else path[:-1]


def _target(
    constraint: JointPositionConstraint | JointOrientationConstraint | LookDirectionConstraint,
    joint: int,
    frame: int,
    found: FoundMotion,
) -> Target:
    match constraint:
        case JointPositionConstraint(target_m=target):
            axes = "".join(axis for axis, value in zip("xyz", target, strict=True) if value is not None)
            return PositionTarget(joint, tuple(value or 0.0 for value in target), axes=cast(Axes, axes))
        case JointOrientationConstraint(rotation=rotation):
            return OrientationTarget(joint, rotation)
        case LookDirectionConstraint(point_m=None, direction=direction):
            here = found.motion.at_frames(np.array([frame])).positions(found.skeleton)[0, joint]
            along = np.asarray(direction) / np.linalg.norm(np.asarray(direction))
            return LookAtTarget(joint, here + FAR_AWAY_M * along, axis=constraint.axis)
        case LookDirectionConstraint(point_m=point):
            assert point is not None
            return LookAtTarget(joint, point, axis=constraint.axis)
