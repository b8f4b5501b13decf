"""Two built-in human skeletons: one for generated gaits, and one with other names, proportions, rest pose and axes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.errors import SkeletonError
from marey_motion.skeleton import EndSite, Skeleton

STUDIO_STATURE_M = 1.78

Point = tuple[float, float, float]


class _Bone(NamedTuple):
    """A joint in the table of a skeleton: its parent, and its position in the rest pose in metres."""

    parent: str | None
    position: Point


# Rest pose of the studio skeleton at STUDIO_STATURE_M: a T-pose that faces +Z with the palms down. Segment lengths
# follow the fractions of stature in Drillis and Contini (1966). Names with {side} stand for a left and a right joint.
_STUDIO: dict[str, _Bone] = {
    "Hips": _Bone(None, (0.0, 0.970, 0.0)),
    "Spine": _Bone("Hips", (0.0, 1.070, -0.010)),
    "Spine1": _Bone("Spine", (0.0, 1.190, -0.015)),
    "Spine2": _Bone("Spine1", (0.0, 1.310, -0.015)),
    "Neck": _Bone("Spine2", (0.0, 1.480, -0.005)),
    "Head": _Bone("Neck", (0.0, 1.570, 0.010)),
    "{side}Shoulder": _Bone("Spine2", (0.035, 1.420, 0.0)),
    "{side}Arm": _Bone("{side}Shoulder", (0.190, 1.430, -0.010)),
    "{side}ForeArm": _Bone("{side}Arm", (0.485, 1.430, -0.010)),
    "{side}Hand": _Bone("{side}ForeArm", (0.745, 1.430, -0.010)),
    "{side}HandMiddle1": _Bone("{side}Hand", (0.835, 1.430, -0.010)),
    "{side}HandThumb1": _Bone("{side}Hand", (0.775, 1.420, 0.025)),
    "{side}UpLeg": _Bone("Hips", (0.092, 0.940, 0.0)),
    "{side}Leg": _Bone("{side}UpLeg", (0.092, 0.507, 0.0)),
    "{side}Foot": _Bone("{side}Leg", (0.092, 0.078, 0.0)),
    "{side}ToeBase": _Bone("{side}Foot", (0.092, 0.020, 0.135)),
}
_STUDIO_TIPS: dict[str, Point] = {
    "Head": (0.0, 1.780, 0.010),
    "{side}HandThumb1": (0.825, 1.405, 0.060),
    "{side}HandMiddle1": (0.925, 1.430, -0.010),
    "{side}ToeBase": (0.092, 0.020, 0.205),
}

# A long-legged, broad-shouldered figure of 1.95 m in an A-pose, as game engines keep them: a root on the floor, twist
# joints along the limbs, five spine joints and a prop.
_GAME: dict[str, _Bone] = {
    "root": _Bone(None, (0.0, 0.0, 0.0)),
    "pelvis": _Bone("root", (0.0, 1.080, 0.0)),
    "spine_01": _Bone("pelvis", (0.0, 1.115, -0.005)),
    "spine_02": _Bone("spine_01", (0.0, 1.180, -0.012)),
    "spine_03": _Bone("spine_02", (0.0, 1.255, -0.018)),
    "spine_04": _Bone("spine_03", (0.0, 1.340, -0.018)),
    "spine_05": _Bone("spine_04", (0.0, 1.450, -0.010)),
    "neck_01": _Bone("spine_05", (0.0, 1.610, 0.0)),
    "neck_02": _Bone("neck_01", (0.0, 1.660, 0.008)),
    "head": _Bone("neck_02", (0.0, 1.710, 0.015)),
    "clavicle_{side}": _Bone("spine_05", (0.030, 1.575, 0.010)),
    "upperarm_{side}": _Bone("clavicle_{side}", (0.225, 1.565, -0.015)),
    "upperarm_twist_01_{side}": _Bone("upperarm_{side}", (0.325, 1.465, -0.018)),
    "lowerarm_{side}": _Bone("upperarm_{side}", (0.425, 1.365, -0.021)),
    "lowerarm_twist_01_{side}": _Bone("lowerarm_{side}", (0.520, 1.280, 0.004)),
    "hand_{side}": _Bone("lowerarm_{side}", (0.615, 1.195, 0.029)),
    "middle_01_{side}": _Bone("hand_{side}", (0.685, 1.115, 0.043)),
    "thumb_01_{side}": _Bone("hand_{side}", (0.625, 1.160, 0.070)),
    "weapon_r": _Bone("hand_r", (-0.660, 1.120, 0.060)),
    "thigh_{side}": _Bone("pelvis", (0.105, 1.050, 0.010)),
    "thigh_twist_01_{side}": _Bone("thigh_{side}", (0.115, 0.810, 0.008)),
    "calf_{side}": _Bone("thigh_{side}", (0.125, 0.570, 0.005)),
    "calf_twist_01_{side}": _Bone("calf_{side}", (0.133, 0.330, -0.010)),
    "foot_{side}": _Bone("calf_{side}", (0.140, 0.095, -0.025)),
    "ball_{side}": _Bone("foot_{side}", (0.150, 0.020, 0.130)),
}
_GAME_TIPS: dict[str, Point] = {
    "head": (0.0, 1.950, 0.020),
    "thumb_01_{side}": (0.645, 1.110, 0.100),
    "middle_01_{side}": (0.745, 1.045, 0.055),
    "weapon_r": (-0.690, 1.060, 0.180),
    "ball_{side}": (0.155, 0.020, 0.215),
}


@lru_cache(maxsize=16)
def studio_skeleton(stature_m: float = STUDIO_STATURE_M) -> Skeleton:
    """Build the skeleton of an adult in a T-pose, facing +Z on the floor y = 0, without rest rotations.

    Parameters
    ----------
    stature_m : float    height of the top of the head in metres; all lengths scale with it

    Returns
    -------
    Skeleton    26 joints

    Raises
    ------
    SkeletonError    unless the stature is positive

    Examples
    --------
    >>> from marey_motion import studio_skeleton
    >>> skeleton = studio_skeleton(stature_m=1.78)
    >>> skeleton.joint_count, skeleton.joint_names[0]
    (26, 'Hips')
    """
    if not (np.isfinite(stature_m) and stature_m > 0):
        raise SkeletonError(f"the stature must be positive, not {stature_m} m", where="stature_m")
    bones, tips = _both_sides(_STUDIO, _STUDIO_TIPS, ("Left", "Right"))
    scale = stature_m / STUDIO_STATURE_M
    return _assembled(
        {name: (parent, scale * position) for name, (parent, position) in bones.items()},
        {name: scale * tip for name, tip in tips.items()},
        {name: quaternions.identity() for name in bones},
    )


def game_skeleton() -> Skeleton:
    """Build a skeleton in an A-pose with twist joints and a prop, which differs from the studio skeleton.

    The figure is taller than the studio skeleton and has other joint names, proportions and local axes.
    The x axis of the joints of the trunk and of the left side points along the bone; on the mirrored right side, it
    points against the bone. The root is rotated by a quarter turn about x, as in files converted from a Z-up world.

    Returns
    -------
    Skeleton    39 joints

    Examples
    --------
    >>> from marey_motion import game_skeleton
    >>> game_skeleton().joint_names[:3]
    ('root', 'pelvis', 'spine_01')
    """
    bones, tips = _both_sides(_GAME, _GAME_TIPS, ("l", "r"))
    aims = {**tips}
    for _, (parent, position) in reversed(bones.items()):
        if parent is not None:
            aims[parent] = position  # ends as the first child
    rotations: dict[str, AnyFloats] = {}
    for name, (parent, position) in bones.items():
        if parent is None:
            rotations[name] = quaternions.from_axis_angle((1.0, 0.0, 0.0), -0.5 * np.pi)
        elif name in aims:
            rotations[name] = _rotation_along(aims[name] - position, against=name.endswith("_r"))
        else:
            rotations[name] = rotations[parent]
    return _assembled(bones, tips, rotations)


def _both_sides(
    table: Mapping[str, _Bone], tips: Mapping[str, Point], sides: tuple[str, str]
) -> tuple[dict[str, tuple[str | None, AnyFloats]], dict[str, AnyFloats]]:
    """Return all joints, depth first, as {name: (parent, position)}, and tips as {name: position}.

    The joints and tips of the right side are mirrored from the left side.
    """

    def expanded(name: str) -> list[tuple[str, int, str]]:
        if "{side}" not in name:
            return [(name, 1, sides[0])]
        return [(name.format(side=side), sign, side) for side, sign in zip(sides, (1, -1), strict=True)]

    children: dict[str | None, list[tuple[str, AnyFloats]]] = {}
    for template, bone in table.items():
        for name, sign, side in expanded(template):
            parent = bone.parent.format(side=side) if bone.parent else None
            children.setdefault(parent, []).append((name, np.array(bone.position) * (sign, 1, 1)))
    ordered: dict[str, tuple[str | None, AnyFloats]] = {}

    def visit(parent: str | None) -> None:
        for name, position in children.get(parent, ()):
            ordered[name] = (parent, position)
            visit(name)

    visit(None)
    ends: dict[str, AnyFloats] = {
        name: np.array(tip) * (sign, 1, 1) for key, tip in tips.items() for name, sign, _ in expanded(key)
    }
    return ordered, ends


def _rotation_along(direction: AnyFloats, *, against: bool) -> AnyFloats:
    """Compute the global rotation whose x axis points along `direction`, or opposite to it if `against` is True.

    The y axis is as close as possible to forward (+Z) or, if the x axis is nearly parallel to Z, to up (+Y).
    """
    x = direction / np.linalg.norm(direction) * (-1.0 if against else 1.0)
    hint = (0.0, 1.0, 0.0) if abs(x[2]) > 0.8 else (0.0, 0.0, 1.0)
    y = quaternions.perpendicular(hint, x)
    return quaternions.from_matrix(np.stack((x, y, np.cross(x, y)), axis=-1))


def _assembled(
    bones: Mapping[str, tuple[str | None, AnyFloats]], tips: Mapping[str, AnyFloats], rotations: Mapping[str, AnyFloats]
) -> Skeleton:
    """Build a skeleton from global rest positions and global rest rotations."""
    index = {name: joint for joint, name in enumerate(bones)}
    offsets, rest_rotations = [], []
    for name, (parent, position) in bones.items():
        if parent is None:
            offsets.append(position)
            rest_rotations.append(rotations[name])
        else:
            to_parent = quaternions.conjugate(rotations[parent])
            offsets.append(quaternions.rotate_vectors(to_parent, position - bones[parent][1]))
            rest_rotations.append(quaternions.multiply(to_parent, rotations[name]))
    sites = []
    for name, tip in tips.items():
        local = quaternions.rotate_vectors(quaternions.conjugate(rotations[name]), tip - bones[name][1])
        sites.append(EndSite(index[name], np.asarray(local, dtype=np.float64)))
    return Skeleton(
        joint_names=tuple(bones),
        parents=np.array([-1 if parent is None else index[parent] for parent, _ in bones.values()], dtype=np.int32),
        offsets=np.array(offsets),
        rest_rotations=np.array(rest_rotations),
        end_sites=tuple(sorted(sites, key=lambda site: site.joint)),
    )
