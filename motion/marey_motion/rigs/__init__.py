"""Rigs: standard joints, known rigs, and the recognition of a skeleton's joints and axes."""

from marey_motion.rigs.axes import JointAxes, axes_from_motion, doubtful_joints, guess_axes, rest_pose_doubts
from marey_motion.rigs.mapping import JointMapping, map_joints, require_trust, symmetric_joints
from marey_motion.rigs.standard import ESSENTIAL_JOINTS, STANDARD_JOINTS, mirrored

__all__ = [
    "ESSENTIAL_JOINTS",
    "STANDARD_JOINTS",
    "JointAxes",
    "JointMapping",
    "axes_from_motion",
    "doubtful_joints",
    "guess_axes",
    "map_joints",
    "mirrored",
    "require_trust",
    "rest_pose_doubts",
    "symmetric_joints",
]
