"""Options of searches for motions of models that meet constraints."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Options
from marey_schemas.documents.standard_joints import LIMB_ENDS
from marey_schemas.names import JointName

CANDIDATES = 8
"""Default number of nodes of the sample tree that a search follows at each level.

The published method uses 4 nodes. With 8, the error of the result is a sixth smaller, and a search takes a millisecond
more.
"""
PASSES = 2
"""Default number of passes of a search: one over the samples of the tree, then one over samples near the best one."""

LIKELIHOOD_WEIGHT = 0.01
"""Default weight of the motion's likelihood when a result is refined by numerical optimisation.

At 100 positions of wrists in unseen takes, the median error was 0.003 cm, and every motion was as likely as the
examples. A weight of 1 made the error of the search larger at half of the positions.
"""

TRANSITION_TOLERANCE_M = 0.02


class RefineOptions(Options):
    """Options for refining the best sample of a search by numerical optimisation."""

    likelihood_weight: float | None = Field(
        None,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        alias="lambda",
        description="Weight of the motion's likelihood; smaller values bring the motion closer to the targets. Absent: "
        f"{LIKELIHOOD_WEIGHT:g}, or 0 if the errors would otherwise become larger than before the refinement.",
    )
    iterations: int = Field(50, ge=1, le=200, description="Greatest number of iterations of the optimisation.")


class TransitionOptions(Options):
    """Options for the continuity between two motions of a sequence."""

    joints: tuple[JointName, ...] = Field(
        LIMB_ENDS,
        max_length=256,
        description="Standard names of the joints that should not jump between motions; joints that the skeleton of "
        "one of the motions lacks are ignored.",
    )
    tolerance_m: float = Field(
        TRANSITION_TOLERANCE_M,
        ge=1e-5,
        le=1e4,
        allow_inf_nan=False,
        description="Size of a jump between two motions that counts as an error of 1, in metres; jumps of joints and "
        "of the height of the pelvis are measured.",
    )
    weight: float = Field(
        1.0,
        ge=1e-6,
        le=1e6,
        allow_inf_nan=False,
        description="Weight of the continuity, relative to the weights of the constraints.",
    )
