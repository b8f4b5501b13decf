"""The commands of an edit that use inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.editing.compute_budget import PER_NUMBER, PER_PLANTED_NUMBER, PER_RIG
from marey_motion.editing.constraining import Constraint, constrain_motion, current_values
from marey_motion.editing.foot_plants import Foot, FootContacts, PlantOptions, find_contacts
from marey_motion.editing.foot_plants import plant_feet as plant
from marey_motion.editing.inverse_kinematics.solving import Solver, limb_ending_at
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
from marey_motion.editing.take import EditFinding, Take
from marey_motion.errors import EditError, MappingError, MotionError
from marey_motion.rigs import JointAxes, guess_axes

Tree = Mapping[str, Any]

_OPTIONS = SolverOptions()
# Joints that look with their front; others point along their bone.
_LOOKING = ("pelvis", "spine", "spine_1", "spine_2", "neck", "head")


def constrain(
    take: Take,
    *,
    constraints: Sequence[Tree],
    solver: Solver = "auto",
    blend_s: float = 0.3,
    root_moves: bool = False,
    limits: Sequence[Tree] = (),
    stiffness: Mapping[str, float] | None = None,
) -> Take:
    """Meet constraints in ranges of frames, and record their errors before and after.

    Parameters
    ----------
    take : Take    F frames
    constraints : sequence of trees    as in `marey_schemas.editing.constraints`, with radians
    solver : str    "auto", "ccd", "two_bone" or "least_squares"
    blend_s : float    seconds before and after the constrained frames that may change
    root_moves : bool    whether the root may move
    limits : sequence of trees    limits of joints, with radians
    stiffness : mapping of str to float, optional    by joint name, 0 (free) to below 1

    Returns
    -------
    Take    F frames with a finding

    Raises
    ------
    UnknownJoint    naming a joint that does not exist
    MappingError    where limits or a look need axes that cannot be determined
    EditError    naming the constraint that is invalid
    """
    take.budget.spend(PER_RIG)
    rig = _Rig(take)
    wanted = [_named(number, _constraint, rig, tree) for number, tree in enumerate(constraints)]
    freedom = Freedom(
        root_moves=root_moves,
        limits={rig.joint(tree["joint"]): _limit(rig, tree) for tree in limits},
        stiffness={rig.joint(name): value for name, value in (stiffness or {}).items()},
    )
    made = constrain_motion(
        take.skeleton, take.motion, wanted, blend_frames=take.count_frames(blend_s), freedom=freedom, solver=solver,
        budget=take.budget,
    )  # fmt: skip
    found = [
        _finding(tree, constraint, before, after)
        for tree, constraint, before, after in zip(
            constraints, wanted, made.residuals_before, made.residuals_after, strict=True
        )
    ]
    return take.moved(made.motion).with_finding(EditFinding("constrain", {"constraints": found}))


def plant_feet(
    take: Take,
    *,
    contacts: Sequence[Tree] | None = None,
    speed_m_s: float = PlantOptions.speed_m_s,
    blend_s: float = PlantOptions.blend_s,
    knee_damping_rad: float = PlantOptions.knee_damping_rad,
) -> Take:
    """Fix planted feet to the ground, and record how far they slid before and after.

    Parameters
    ----------
    take : Take    F frames
    contacts : sequence of trees, optional    {"foot": "left" or "right", "frames": (start, stop)}; detected by speed
        when None
    speed_m_s : float    joints slower than this touch the ground
    blend_s : float    seconds before and after a contact
    knee_damping_rad : float    radians before straight in which a stretching knee is damped

    Returns
    -------
    Take    F frames with a finding

    Raises
    ------
    MappingError    where legs are not known
    EditError    where the frames do not exist
    """
    take.budget.spend(PER_RIG + PER_PLANTED_NUMBER * take.size)
    rig = _Rig(take)
    feet = [_foot(rig, side) for side in ("left", "right")]
    options = PlantOptions(blend_s=blend_s, speed_m_s=speed_m_s, knee_damping_rad=knee_damping_rad)
    given = None if contacts is None else _given_contacts(take, feet, contacts, options)
    made = plant(take.skeleton, take.motion, take.frame_rate_hz, feet, contacts=given, options=options)
    values = {
        "slide_before_m": made.slide_before_m,
        "slide_after_m": made.slide_after_m,
        "lowered_m": made.lowered_m,
    }
    return take.moved(made.motion).with_finding(EditFinding("plant_feet", values))


class _Rig:
    """Names and axes of a take's joints."""

    def __init__(self, take: Take) -> None:
        self.take = take
        self._axes: dict[str, JointAxes] | None = None

    def joint(self, name: str) -> int:
        """Find the index of a joint by its own or its standard name."""
        skeleton = self.take.skeleton
        standard = None if name in skeleton else self.take.body.mapping.joints.get(name)
        return skeleton.index_of(standard or name)

    @property
    def axes(self) -> dict[str, JointAxes]:
        """Axes of the mapped joints by name; where the rest pose does not define those of a limb, from the motion."""
        if self._axes is None:
            take = self.take
            clip = take.motion.as_clip(take.skeleton, take.frame_rate_hz)
            self._axes = guess_axes(take.skeleton, take.body.mapping, clip)
        return self._axes

    def axes_of(self, joint: int) -> JointAxes:
        """Axes of a joint. Raises `MappingError` where it is not mapped."""
        name = self.take.skeleton.joint_names[joint]
        if name not in self.axes:
            raise MappingError("the mapping does not name this joint, so its axes are unknown", where=name)
        return self.axes[name]

    def axes_if_known(self) -> dict[str, JointAxes] | None:
        """Axes of the mapped joints; None where the mapping does not suffice for them."""
        try:
            return self.axes
        except MappingError:
            return None


def _named(number: int, make: Any, *arguments: Any) -> Any:
    """Call `make`; its errors name the constraint."""
    try:
        return make(*arguments)
    except MotionError as error:
        place = f"constraints[{number}]"
        error.where = place if error.where is None else f"{place}, {error.where}"
        raise


def _constraint(rig: _Rig, tree: Tree) -> Constraint:
    start, stop = rig.take.frames(tree.get("frames"))
    rig.take.budget.spend(PER_NUMBER * (stop - start) * rig.take.size / rig.take.frame_count)
    joint, top = rig.joint(tree["joint"]), tree.get("top")
    skeleton = rig.take.skeleton
    target = _target(rig, joint, tree, start, stop)
    limb = limb_ending_at(skeleton, rig.take.body.mapping, joint, rig.axes_if_known())
    if top is not None:
        joints = chain_of(skeleton, joint, rig.joint(top))
        return Constraint(target, start, stop, joints, limb if limb is not None and joints[-1] == limb.start else None)
    if limb is not None:
        return Constraint(target, start, stop, limb.joints, limb)
    path = skeleton.path_to_root(joint)
    return Constraint(target, start, stop, path[:-1] or path)


def _target(rig: _Rig, joint: int, tree: Tree, start: int, stop: int) -> Target:
    part, skeleton = rig.take.motion.at_frames(np.arange(start, stop)), rig.take.skeleton
    weight = tree.get("weight", 1.0)
    offset = tree.get("offset_m", (0.0, 0.0, 0.0))
    if tree["kind"] == "look_at":
        return LookAtTarget(joint, tree["point_m"], tree.get("axis") or _looking_axis(rig, joint), offset, weight)
    if tree["kind"] == "orientation":
        asked = OrientationTarget(joint, tree.get("rotation") or (1.0, 0.0, 0.0, 0.0), weight)
        if tree.get("rotation") is not None:
            return asked
        return OrientationTarget(joint, current_values(skeleton, part.at_frames(np.arange(1)), asked)[0], weight)
    point, axes = tree.get("point_m"), tree.get("axes", "xyz")
    if point is not None:
        return PositionTarget(joint, point, axes, offset, weight)
    now = current_values(skeleton, part, PositionTarget(joint, (0.0, 0.0, 0.0), axes, offset))
    shift = tree.get("shift_m")
    return PositionTarget(joint, now[0] if shift is None else now + np.array(shift), axes, offset, weight)


def _looking_axis(rig: _Rig, joint: int) -> NDArray[np.float64]:
    """Choose the axis that looks: the front of head and trunk, the direction of other bones, in the joint's frame."""
    try:
        axes = rig.axes_of(joint)
    except MappingError as error:
        raise MappingError(f"{error.message}; or say which axis looks", where="axis") from error
    mapping = rig.take.body.mapping.joints
    name = rig.take.skeleton.joint_names[joint]
    looks = any(mapping.get(standard) == name for standard in _LOOKING)
    return np.cross(axes.swing, axes.twist) if looks else np.array(axes.twist)


def _limit(rig: _Rig, tree: Tree) -> JointLimit:
    joint = rig.joint(tree["joint"])
    axes, rest = rig.axes_of(joint), rig.take.skeleton.rest_rotations[joint]
    if tree["kind"] == "hinge":
        low, high = tree["angle_rad"]
        return JointLimit.hinge(axes, low, high, rest)
    return JointLimit.cone(axes, tuple(tree["swing_rad"]), tuple(tree.get("twist_rad", (-np.pi, np.pi))), rest)


def _finding(tree: Tree, constraint: Constraint, before: Any, after: Any) -> dict[str, Any]:
    """Describe the largest errors of a constraint, in metres or radians, and count the frames that reach it."""
    is_position = isinstance(constraint.target, PositionTarget)
    unit = "m" if is_position else "rad"
    tolerance = _OPTIONS.tolerance_m if is_position else _OPTIONS.tolerance_rad
    return {
        "joint": tree["joint"],
        "kind": tree["kind"],
        f"residual_before_{unit}": float(before.max()),
        f"residual_after_{unit}": float(after.max()),
        "frames": len(after),
        "frames_reached": int((after <= 1.01 * tolerance).sum()),
    }


def _foot(rig: _Rig, side: str) -> Foot:
    mapping, skeleton = rig.take.body.mapping, rig.take.skeleton
    *_, ankle = mapping.indices(skeleton, (f"{side}_hip", f"{side}_knee", f"{side}_ankle"))
    leg = limb_ending_at(skeleton, mapping, ankle, rig.axes_if_known())
    if leg is None:
        raise MappingError("hip, knee and ankle do not form one leg", where=f"{side}_ankle")
    toe = f"{side}_toe"
    return Foot(leg, mapping.indices(skeleton, (toe,))[0] if toe in mapping.joints else ankle)


def _given_contacts(
    take: Take, feet: Sequence[Foot], given: Sequence[Tree], options: PlantOptions
) -> tuple[FootContacts, ...]:
    """Toes as given; heels where they are slow meanwhile."""
    positions = take.motion.positions(take.skeleton)
    contacts = []
    for side, foot in zip(("left", "right"), feet, strict=True):
        toe = np.zeros(take.frame_count, dtype=np.bool_)
        for one in given:
            if one["foot"] not in ("left", "right"):
                raise EditError(f"{one['foot']!r} is not a foot; choose left or right", where="contacts")
            if one["foot"] == side:
                start, stop = take.frames(one["frames"])
                toe[start:stop] = True
        slow = find_contacts(positions, foot, take.frame_rate_hz, options)
        contacts.append(FootContacts(toe, slow.heel & toe))
    return tuple(contacts)
