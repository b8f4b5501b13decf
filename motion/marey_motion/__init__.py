"""The mathematics of motion: arrays in, arrays out.

The names below load the module they live in when they are first used, so that importing the package costs next to
nothing and compiled kernels load only where something is computed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marey_motion.clip import Clip as Clip
    from marey_motion.errors import AmbiguousUnits as AmbiguousUnits
    from marey_motion.errors import ClipError as ClipError
    from marey_motion.errors import FormatError as FormatError
    from marey_motion.errors import FormatLimit as FormatLimit
    from marey_motion.errors import MappingError as MappingError
    from marey_motion.errors import MotionError as MotionError
    from marey_motion.errors import RotationError as RotationError
    from marey_motion.errors import SkeletonError as SkeletonError
    from marey_motion.errors import UnknownFormat as UnknownFormat
    from marey_motion.errors import UnknownJoint as UnknownJoint
    from marey_motion.formats import read_motion as read_motion
    from marey_motion.formats import write_motion as write_motion
    from marey_motion.gait import game_skeleton as game_skeleton
    from marey_motion.gait import generate_dataset as generate_dataset
    from marey_motion.gait import generate_gait as generate_gait
    from marey_motion.gait import studio_skeleton as studio_skeleton
    from marey_motion.importing.source import ImportedMotion as ImportedMotion
    from marey_motion.importing.source import ImportOptions as ImportOptions
    from marey_motion.kinematics import foot_contacts as foot_contacts
    from marey_motion.kinematics import forward_directions as forward_directions
    from marey_motion.kinematics import forward_kinematics as forward_kinematics
    from marey_motion.kinematics import global_positions as global_positions
    from marey_motion.kinematics import global_rotations as global_rotations
    from marey_motion.kinematics import headings as headings
    from marey_motion.kinematics import turn_rates as turn_rates
    from marey_motion.kinematics import velocities as velocities
    from marey_motion.retargeting import RetargetPlan as RetargetPlan
    from marey_motion.retargeting import plan_retarget as plan_retarget
    from marey_motion.retargeting import retarget as retarget
    from marey_motion.rigs import JointAxes as JointAxes
    from marey_motion.rigs import JointMapping as JointMapping
    from marey_motion.rigs import guess_axes as guess_axes
    from marey_motion.rigs import map_joints as map_joints
    from marey_motion.skeleton import EndSite as EndSite
    from marey_motion.skeleton import Skeleton as Skeleton
    from marey_motion.skeleton import same_hierarchy as same_hierarchy

_HOMES = {
    "clip": ("Clip",),
    "errors": (
        "AmbiguousUnits",
        "ClipError",
        "FormatError",
        "FormatLimit",
        "MappingError",
        "MotionError",
        "RotationError",
        "SkeletonError",
        "UnknownFormat",
        "UnknownJoint",
    ),
    "formats": ("read_motion", "write_motion"),
    "gait": ("game_skeleton", "generate_dataset", "generate_gait", "studio_skeleton"),
    "kinematics": (
        "foot_contacts",
        "forward_directions",
        "forward_kinematics",
        "global_positions",
        "global_rotations",
        "headings",
        "turn_rates",
        "velocities",
    ),
    "retargeting": ("RetargetPlan", "plan_retarget", "retarget"),
    "rigs": ("JointAxes", "JointMapping", "guess_axes", "map_joints"),
    "skeleton": ("EndSite", "Skeleton", "same_hierarchy"),
    "importing.source": ("ImportOptions", "ImportedMotion"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
