"""Axes of known rigs whose rest pose is no standing body, by the frames that the rig gives its joints.

In the rest pose of such a rig all bones of a limb are on one line, or the limbs point anywhere, so the rest pose does
not show about which axis a knee or an elbow bends. But all files of the rig have the same frames: a tool that aligns
the frame of each joint with its bone puts the hinge on the same axis of the frame in every file. The axes are therefore
a property of the rig, as the names of its joints are, and must not be read from whichever motion comes first.

The tables below list a joint only where its axes differ from those of the joint above it. All other joints have the
axes of the nearest listed joint above them, carried over by the rest rotations. The numbers are rounded means over the
takes of each rig that were at hand; axes within 3 degrees of an axis of the frame are that axis.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.rigs.standard import split_side
from marey_motion.skeleton import Skeleton

# Cosine between a listed twist axis and the bone; a limb that disagrees more belongs to other frames.
AGREEING = 0.9

_Axis = tuple[float, float, float]
_Axes = tuple[_Axis, _Axis]

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_BACK_X, _BACK_Y, _BACK_Z = (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)

_CONVENTIONS: Mapping[str, Mapping[str, _Axes]] = {
    "bandai-namco": {
        "pelvis": (_X, _BACK_Y),
        "spine": (_X, _Z),
        "head": ((0.97, -0.25, 0.0), _Z),
        "left_clavicle": (_X, (0.0, 0.99, -0.16)),
        "left_shoulder": (_X, _Y),
        "left_hip": (_X, _Y),
        "right_clavicle": (_BACK_X, (0.0, 0.99, -0.16)),
        "right_shoulder": (_BACK_X, _Y),
        "right_hip": (_BACK_X, _Y),
    },
    "game-engine": {
        "pelvis": (_Y, _X),
        "head": (_X, _BACK_Z),
        "left_clavicle": (_Z, (0.1, 1.0, 0.0)),
        "left_thumb_base": (_Z, (0.84, 0.54, 0.0)),
        "left_hip": (_X, _Z),
        "right_clavicle": (_BACK_Z, (-0.1, 1.0, 0.0)),
        "right_thumb_base": (_BACK_Z, (0.84, 0.54, 0.0)),
        "right_hip": (_X, _Z),
    },
    "geno": {
        "left_clavicle": (_Y, _BACK_X),
        "right_clavicle": (_Y, _BACK_X),
    },
    "mh-cmu": {
        "pelvis": (_Y, _X),
        "left_clavicle": (_Y, _BACK_X),
        "left_thumb_base": ((0.82, 0.42, 0.40), (0.55, -0.76, -0.34)),
        "left_finger": (_Y, (-0.58, 0.0, -0.81)),
        "left_hip": (_Y, _X),
        "right_clavicle": (_Y, _BACK_X),
        "right_thumb_base": ((-0.82, 0.42, 0.40), (0.55, 0.76, 0.34)),
        "right_finger": (_Y, (-0.58, 0.0, 0.81)),
        "right_hip": (_Y, _X),
    },
    "reallusion": {
        "pelvis": (_Y, _X),
        "left_clavicle": (_Y, _BACK_X),
        "left_shoulder": (_Y, (-0.86, 0.0, -0.52)),
        "left_wrist": (_Y, (-0.96, 0.0, -0.29)),
        "left_hip": (_Y, _BACK_X),
        "right_clavicle": (_Y, _BACK_X),
        "right_shoulder": (_Y, (-0.86, 0.0, 0.52)),
        "right_wrist": (_Y, (-0.96, 0.0, 0.29)),
        "right_hip": (_Y, _BACK_X),
    },
}


def conventional_axes(
    skeleton: Skeleton, rig: str | None, joints: Mapping[str, int], ends: Mapping[str, str]
) -> dict[str, tuple[Floats, Floats]]:
    """Find the twist and swing axes that a known rig gives its joints, without any motion.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    rig : str or None    the known rig whose joint names the skeleton has
    joints : mapping of str to int    indices of joints by standard name
    ends : mapping of str to str    the standard joint at the other end of the bone, by standard name

    Returns
    -------
    dict of str to (array, array)    twist and swing (3,) in the frame of the joint, by standard name; the swing need
        not be perpendicular to the twist. Empty if the rig has no stated axes, or if the skeleton contradicts them
    """
    listed = {joints[name]: axes for name, axes in _CONVENTIONS.get(rig or "", {}).items() if name in joints}
    found: dict[str, tuple[Floats, Floats]] = {}
    for standard, joint in joints.items():
        above = next((one for one in skeleton.path_to_root(joint) if one in listed), None)
        if above is None:
            continue
        turn = quaternions.conjugate(skeleton.rest_global_rotations[joint])
        turn = quaternions.multiply(turn, skeleton.rest_global_rotations[above])
        twist, swing = quaternions.rotate_vectors(turn, np.array(listed[above])).astype(np.float64)
        twist /= np.linalg.norm(twist)
        bone = _bone(skeleton, joints, standard, ends)
        if bone is not None and _is_limb(standard) and bone @ twist < AGREEING:
            return {}
        found[standard] = (twist if bone is None else bone, swing)
    return found


def _bone(skeleton: Skeleton, joints: Mapping[str, int], standard: str, ends: Mapping[str, str]) -> Floats | None:
    """Return the unit direction (3,) of a bone whose other end is a child of the joint; None for other bones."""
    end = joints.get(ends.get(standard, ""))
    if end is None or skeleton.parents[end] != joints[standard]:
        return None
    offset: Floats = skeleton.offsets[end].astype(np.float64)
    length = float(np.linalg.norm(offset))
    return offset / length if length > quaternions.TINY else None


def _is_limb(standard: str) -> bool:
    side, joint = split_side(standard)
    return bool(side) and joint in ("shoulder", "elbow", "hip", "knee")
