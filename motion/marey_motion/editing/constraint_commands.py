"""Edit commands that use inverse kinematics: `constrain` and `plant_feet`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import radians
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.editing.compute_budget import PER_NUMBER, PER_PLANTED_NUMBER, PER_RIG
from marey_motion.editing.constraining import Constraint, constrain_motion, current_values, residuals_of
from marey_motion.editing.constraint_warnings import contradictions, joined, jumps, missed, require_acting
from marey_motion.editing.constraint_windows import join_windows
from marey_motion.editing.foot_plants import Foot, FootContacts, find_contacts, find_feet
from marey_motion.editing.foot_plants import plant_feet as plant
from marey_motion.editing.inverse_kinematics.limbs import limb_ending_at, straight_hinge
from marey_motion.editing.inverse_kinematics.targets import (
    Freedom,
    JointLimit,
    LookAtTarget,
    OrientationTarget,
    PositionTarget,
    SolverOptions,
    Target,
    chain_of,
)
from marey_motion.editing.limb_smoothing import largest_steps
from marey_motion.editing.take import EditFinding, Take
from marey_motion.errors import MappingError, MotionError
from marey_motion.rigs import JointAxes, guess_axes
from marey_schemas.editing.constraints import (
    AnyConstraint,
    AnyLimit,
    Constrain,
    HingeLimit,
    LookAtConstraint,
    OrientationConstraint,
    PlantFeet,
)

_OPTIONS = SolverOptions()
# Standard joints whose forward axis is directed at a look-at target; other joints use the direction of their bone.
_LOOKING = ("pelvis", "spine", "spine_1", "spine_2", "neck", "head")


def constrain(take: Take, command: Constrain) -> Take:
    """Change a motion to meet constraints in ranges of frames, and record their errors before and after the change.

    Parameters
    ----------
    take : Take    F frames
    command : Constrain    constraints, solver, blend, limits and stiffness of joints

    Returns
    -------
    Take    F frames, with a finding that contains the errors

    Raises
    ------
    UnknownJoint    if a joint does not exist; the error names it
    MappingError    if joint limits or a look-at constraint need axes that cannot be determined
    EditError    if a constraint is invalid; the error names it
    """
    take.budget.spend(PER_RIG)
    rig = _Rig(take)
    wanted = [_named(number, _constraint, rig, one) for number, one in enumerate(command.constraints)]
    for number, one in enumerate(wanted):
        _named(number, partial(require_acting, root_moves=command.root_moves), take.skeleton, one)
    freedom = Freedom(
        root_moves=command.root_moves,
        limits={rig.joint(one.joint): _limit(rig, one) for one in command.limits},
        stiffness={rig.joint(name): value for name, value in command.stiffness.items()},
    )
    blend = take.count_frames(command.blend_s)
    usual = largest_steps(np.asarray(take.motion.positions(take.skeleton), dtype=np.float64))
    windows, pairs = join_windows(wanted, usual, blend)
    made = constrain_motion(
        take.skeleton, take.motion, windows, blend_frames=blend, freedom=freedom,
        solver=command.solver, budget=take.budget, damping_zone_rad=radians(command.stretch_damping_deg),
    )  # fmt: skip
    before, after = (
        [residuals_of(take.skeleton, motion, one) for one in wanted] for motion in (take.motion, made.motion)
    )
    found = [_finding(*each) for each in zip(command.constraints, wanted, before, after, strict=True)]
    edited = take.with_motion(made.motion).with_finding(EditFinding("constrain", {"constraints": found}))
    warnings = [*contradictions(wanted), *joined(pairs), *missed(wanted, after)]
    warnings += jumps(take.skeleton, take.motion, made.motion, wanted, blend)
    if blend > take.frame_count:
        warnings.append(f"the blend of {command.blend_s:g} s is longer than the clip")
    for warning in warnings:
        edited = edited.with_warning("constrain", warning)
    return edited


def plant_feet(take: Take, command: PlantFeet) -> Take:
    """Fix planted feet to the ground, and record their sliding distances before and after.

    Parameters
    ----------
    take : Take    F frames
    command : PlantFeet    contacts (detected by speed if None), and the blending around them

    Returns
    -------
    Take    F frames, with a finding that contains the sliding distances

    Raises
    ------
    MappingError    if the mapping does not define both legs
    EditError    if the take lacks one of the frames
    """
    take.budget.spend(PER_RIG + PER_PLANTED_NUMBER * take.size)
    rig = _Rig(take)
    feet = find_feet(take.skeleton, take.body.mapping, rig.axes_if_known())
    given = None if command.contacts is None else _given_contacts(take, feet, command)
    made = plant(take.skeleton, take.motion, take.frame_rate_hz, feet, contacts=given, options=command)
    values = {
        "slide_before_m": made.slide_before_m,
        "slide_after_m": made.slide_after_m,
        "lowered_m": made.lowered_m,
    }
    return take.with_motion(made.motion).with_finding(EditFinding("plant_feet", values))


class _Rig:
    """The joints of a take with their names and axes."""

    def __init__(self, take: Take) -> None:
        self.take = take
        self._axes: dict[str, JointAxes] | None = None

    def joint(self, name: str) -> int:
        """Find the index of a joint by its name in the skeleton or by its standard name."""
        skeleton = self.take.skeleton
        standard = None if name in skeleton else self.take.body.mapping.joints.get(name)
        return skeleton.index_of(standard or name)

    @property
    def axes(self) -> dict[str, JointAxes]:
        """Axes of the mapped joints by name; axes that the rest pose does not define are computed from the motion."""
        if self._axes is None:
            take = self.take
            clip = take.motion.as_clip(take.skeleton, take.frame_rate_hz)
            self._axes = guess_axes(take.skeleton, take.body.mapping, clip)
        return self._axes

    def axes_of(self, joint: int) -> JointAxes:
        """Return the axes of a joint. Raises `MappingError` if the joint is not mapped."""
        name = self.take.skeleton.joint_names[joint]
        if name not in self.axes:
            raise MappingError(
                "the axes of this joint are unknown; add the joint to the joint mapping of the skeleton", where=name
            )
        return self.axes[name]

    def axes_if_known(self) -> dict[str, JointAxes] | None:
        """Return the axes of the mapped joints; None if the mapping is not sufficient to compute them."""
        try:
            return self.axes
        except MappingError:
            return None


def _named(number: int, make: Any, *arguments: Any) -> Any:
    """Call `make`; if it raises a `MotionError`, add the number of the constraint to the error's `where`."""
    try:
        return make(*arguments)
    except MotionError as error:
        place = f"constraints[{number}]"
        error.where = place if error.where is None else f"{place}, {error.where}"
        raise


def _constraint(rig: _Rig, asked: AnyConstraint) -> Constraint:
    start, stop = rig.take.frames(asked.frames)
    rig.take.budget.spend(PER_NUMBER * (stop - start) * rig.take.size / rig.take.frame_count)
    joint, top = rig.joint(asked.joint), asked.top
    skeleton = rig.take.skeleton
    target = _target(rig, joint, asked, start, stop)
    limb = limb_ending_at(skeleton, rig.take.body.mapping, joint, rig.axes_if_known())
    if top is not None:
        joints = chain_of(skeleton, joint, rig.joint(top))
        return Constraint(target, start, stop, joints, limb if limb is not None and joints[-1] == limb.start else None)
    if limb is not None:
        return Constraint(target, start, stop, limb.joints, limb)
    path = skeleton.path_to_root(joint)
    return Constraint(target, start, stop, path[:-1] or path)


def _target(rig: _Rig, joint: int, asked: AnyConstraint, start: int, stop: int) -> Target:
    part, skeleton = rig.take.motion.at_frames(np.arange(start, stop)), rig.take.skeleton
    if isinstance(asked, LookAtConstraint):
        axis = asked.axis or _looking_axis(rig, joint)
        return LookAtTarget(joint, asked.point_m, axis, asked.offset_m, asked.weight)
    if isinstance(asked, OrientationConstraint):
        target = OrientationTarget(joint, asked.rotation or (1.0, 0.0, 0.0, 0.0), asked.weight)
        if asked.rotation is not None:
            return target
        return replace(target, rotation=current_values(skeleton, part.at_frames(np.arange(1)), target)[0])
    place = PositionTarget(
        joint, asked.point_m or (0.0, 0.0, 0.0), asked.axes, asked.offset_m, asked.weight, asked.pole_m
    )
    if asked.point_m is not None:
        return place
    now = current_values(skeleton, part, place)
    return replace(place, position=now[0] if asked.shift_m is None else now + np.array(asked.shift_m))


def _looking_axis(rig: _Rig, joint: int) -> NDArray[np.float64]:
    """Choose the axis (3,), in the joint's frame, that a look-at constraint directs at its target.

    This axis is the forward axis for head and trunk joints, and the direction of the bone for all other joints.
    """
    try:
        axes = rig.axes_of(joint)
    except MappingError as error:
        raise MappingError(f"{error.message}; alternatively, set the axis of the constraint", where="axis") from error
    mapping = rig.take.body.mapping.joints
    name = rig.take.skeleton.joint_names[joint]
    looks = any(mapping.get(standard) == name for standard in _LOOKING)
    return np.cross(axes.swing, axes.twist) if looks else np.array(axes.twist)


def _limit(rig: _Rig, asked: AnyLimit) -> JointLimit:
    joint = rig.joint(asked.joint)
    axes, rest = rig.axes_of(joint), rig.take.skeleton.rest_rotations[joint]
    if isinstance(asked, HingeLimit):
        least, greatest = asked.angle_deg
        axes, straight = straight_hinge(rig.take.skeleton, rig.take.body.mapping, joint, axes)
        return JointLimit.hinge(axes, radians(least), radians(greatest), straight)
    (about, across), (least, greatest) = asked.swing_deg, asked.twist_deg
    return JointLimit.cone(axes, (radians(about), radians(across)), (radians(least), radians(greatest)), rest)


def _finding(asked: AnyConstraint, constraint: Constraint, before: Any, after: Any) -> dict[str, Any]:
    """Describe the largest errors of a constraint, and count the frames that satisfy it.

    `before` and `after` are the errors of the constraint in each of its frames, before and after solving, in metres or
    radians.
    """
    is_position = isinstance(constraint.target, PositionTarget)
    unit = "m" if is_position else "rad"
    tolerance = _OPTIONS.tolerance_m if is_position else _OPTIONS.tolerance_rad
    return {
        "joint": asked.joint,
        "kind": asked.kind,
        f"residual_before_{unit}": float(before.max()),
        f"residual_after_{unit}": float(after.max()),
        "frames": len(after),
        "frames_reached": int((after <= 1.01 * tolerance).sum()),
    }


def _given_contacts(take: Take, feet: Sequence[Foot], command: PlantFeet) -> tuple[FootContacts, ...]:
    """Return, for each foot, the contacts that the command lists.

    In the frames of a contact, the toe is always planted; the heel is planted only while it is slow.
    """
    positions = take.motion.positions(take.skeleton)
    contacts = []
    for side, foot in zip(("left", "right"), feet, strict=True):
        toe = np.zeros(take.frame_count, dtype=np.bool_)
        for one in command.contacts or ():
            if one.foot == side:
                start, stop = take.frames(one.frames)
                toe[start:stop] = True
        slow = find_contacts(positions, foot, take.frame_rate_hz, command)
        contacts.append(FootContacts(toe, slow.heel & toe))
    return tuple(contacts)
