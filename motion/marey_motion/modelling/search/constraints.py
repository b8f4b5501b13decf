"""Conversion of the constraints of a search to joints and canonical frames of a model, and to tolerances.

In the modules of this folder, a `Placement` is the position and heading, in the world of the constraints, at which the
model's motions begin; by default, they begin at the origin of the world.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import radians

from marey_motion.errors import MotionError
from marey_motion.modelling.primitive import MotionPrimitive
from marey_schemas.search_constraints import (
    JointPositionConstraint,
    KeyframeTimeConstraint,
    Moment,
    RootPositionConstraint,
    SearchConstraint,
)

START, END = "start", "end"


class InvalidConstraint(MotionError):
    """The model cannot meet the constraint, or lacks the joint or keyframe that the constraint names."""

    default_code = "constraint-invalid"


def tolerance_of(constraint: SearchConstraint) -> float:
    """Look up the tolerance of a constraint, in the unit of its error.

    Parameters
    ----------
    constraint : constraint    a constraint of any kind

    Returns
    -------
    float    metres, radians or seconds
    """
    match constraint:
        case JointPositionConstraint() | RootPositionConstraint():
            return constraint.tolerance_m
        case KeyframeTimeConstraint():
            return constraint.tolerance_s
        case _:
            return radians(constraint.tolerance_deg)


def frame_at(primitive: MotionPrimitive, at: Moment) -> float:
    """Convert the time of a constraint to a canonical frame.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    at : str or float    label of a keyframe, "start", "end", or a canonical frame

    Returns
    -------
    float    canonical frame

    Raises
    ------
    InvalidConstraint    if the model lacks the keyframe or the frame; the error names the existing ones
    """
    last = primitive.frame_count - 1
    if isinstance(at, str):
        moments: Mapping[str, int] = {START: 0, END: last, **primitive.keyframes}
        if at not in moments:
            known = ", ".join(moments)
            raise InvalidConstraint(f"the model {primitive.name} has no keyframe {at!r}; it has {known}", where="at")
        return float(moments[at])
    if not 0 <= at <= last:
        raise InvalidConstraint(
            f"canonical frame {at:g} does not exist; the canonical frames are 0 to {last}", where="at"
        )
    return float(at)


def joint_index(primitive: MotionPrimitive, name: str, standard_joints: Mapping[str, int]) -> int:
    """Find a joint by its name or its standard name.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    name : str    name in the skeleton, or standard name
    standard_joints : mapping of str to int    joint index by standard name

    Returns
    -------
    int    joint index

    Raises
    ------
    UnknownJoint    if neither name exists
    """
    if name not in primitive.skeleton and name in standard_joints:
        return standard_joints[name]
    return primitive.skeleton.index_of(name)
