"""Generated walks, runs, side steps and turns whose root follows an exact path: ground truth for tests, data for demos.

Positions are metres with Y up and the floor at y = 0. Headings are radians: 0 faces +Z, a turn to the left is positive.
"""

from marey_motion.gait.footfalls import FootMotion
from marey_motion.gait.path import PathSegment, RootPath, RootState, start_and_stop, straight_or_arc
from marey_motion.gait.skeletons import game_skeleton, studio_skeleton
from marey_motion.gait.style import GaitStyle
from marey_motion.gait.takes import GeneratedTake, foot_motions, generate_along, generate_dataset, generate_gait

__all__ = [
    "FootMotion",
    "GaitStyle",
    "GeneratedTake",
    "PathSegment",
    "RootPath",
    "RootState",
    "foot_motions",
    "game_skeleton",
    "generate_along",
    "generate_dataset",
    "generate_gait",
    "start_and_stop",
    "straight_or_arc",
    "studio_skeleton",
]
