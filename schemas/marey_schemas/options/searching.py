"""Options of searches for motions of models that meet constraints."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Options
from marey_schemas.names import JointName

CANDIDATES = 8
"""Number of nodes of the tree that a search follows at each level, by default.

The published number is 4; with 8 the result is a sixth nearer, for a millisecond more.
"""
PASSES = 2
"""Number of passes of a search, by default: the tree's samples, then samples near the best of them."""

TRANSITION_TOLERANCE_M = 0.02


class RefineOptions(Options):
    """Refinement of the best sample of a search by numerical optimisation."""

    likelihood_weight: float = Field(
        1.0,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        alias="lambda",
        description="Weight of the motion's likelihood; smaller values bring the motion closer to the targets.",
    )
    iterations: int = Field(50, ge=1, le=200, description="Greatest number of iterations of the optimisation.")


class TransitionOptions(Options):
    """Continuity between two motions of a sequence."""

    joints: tuple[JointName, ...] = Field(
        ("left_wrist", "right_wrist", "left_ankle", "right_ankle"),
        max_length=256,
        description="Standard names of the joints that continue where they were; the joints that the skeletons of all "
        "motions have are used.",
    )
    tolerance_m: float = Field(
        TRANSITION_TOLERANCE_M,
        ge=1e-5,
        le=1e4,
        allow_inf_nan=False,
        description="Discontinuity of the joints and of the height of the pelvis, in metres, at which the weighted "
        "error is 1.",
    )
    weight: float = Field(
        1.0, ge=1e-6, le=1e6, allow_inf_nan=False, description="Weight of the continuity against the constraints."
    )
