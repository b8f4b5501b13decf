"""Final step for a motion sampled from a model or found by search: removal of the remaining constraint errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.editing.constraining import Constraint, constrain_motion
from marey_motion.editing.inverse_kinematics.targets import Freedom, PositionTarget, SolverOptions
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

FAR_M = 0.05
"""Error of a position constraint before the final step, in metres, above which the model counts as unable to meet it.
"""


@dataclass(frozen=True, eq=False)
class FinishedMotion:
    """A motion whose constrained joints were moved to their targets in a final step.

    Parameters
    ----------
    motion : the whole motion
    residual_before, residual_after : (C,) largest error of each constraint in its frames, before and after the final
        step: metres for a position, radians for an orientation or look-at target
    far : (C,) True for position constraints with `residual_before` above `FAR_M`
    """

    motion: Motion
    residual_before: NDArray[np.float64]
    residual_after: NDArray[np.float64]
    far: NDArray[np.bool_]


def finish(
    skeleton: Skeleton,
    motion: Motion,
    constraints: Sequence[Constraint],
    *,
    window_frames: int = 20,
    freedom: Freedom | None = None,
    options: SolverOptions | None = None,
) -> FinishedMotion:
    """Move constrained joints to their targets by inverse kinematics, and blend the change with a cubic spline.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames, such as a sample brought close by search and refinement
    constraints : sequence of Constraint    C constraints with their frames and the joints that may turn
        (`inverse_kinematics.limbs.limb_ending_at` and `inverse_kinematics.targets.chain_of` find such joints)
    window_frames : int    number of frames before and after the constrained frames that may change
    freedom : Freedom, optional    limits and stiffness
    options : SolverOptions, optional    tolerances and iterations

    Returns
    -------
    FinishedMotion    F frames and the errors before and after

    Raises
    ------
    EditError    if a constraint is invalid; the error names it
    """
    made = constrain_motion(skeleton, motion, constraints, blend_frames=window_frames, freedom=freedom, options=options)
    before, after = (
        np.array([float(one.max()) for one in many]) for many in (made.residuals_before, made.residuals_after)
    )
    positions = np.array([isinstance(one.target, PositionTarget) for one in constraints], dtype=np.bool_)
    return FinishedMotion(made.motion, before, after, positions & (before > FAR_M))
