"""How much work inverse kinematics is where nothing can be reached: about nanoseconds of one thread."""

from __future__ import annotations

from typing import Literal

from marey_motion.editing.inverse_kinematics.targets import SolverOptions

_PER_FRAME = 40_000
"""Preparing, measuring, and closed forms."""
_LIMIT_PASSES = 4


def solving_work(
    frames: int,
    joints: int,
    targets: int,
    method: Literal["ccd", "two_bone", "least_squares"],
    *,
    limited: bool = False,
    options: SolverOptions | None = None,
) -> float:
    """Of solving so many frames with so many targets, on which so many joints have an influence.

    Parameters
    ----------
    limited : whether joints have limits, which take steps of their own
    """
    if method == "two_bone":
        return float(frames * _PER_FRAME)
    if method == "ccd":
        round_ = joints * (400 + 30 * targets)
    else:
        rows, columns = 3 * targets, 3 * joints + 3
        products = rows**2 * columns / 2 + rows**3 / 6 + 3 * rows * columns
        step = 0.45 * products * (_LIMIT_PASSES if limited else 1)
        round_ = int(2000 + 150 * joints + 60 * joints * targets + step)
    return float(frames * (_PER_FRAME + (options or SolverOptions()).most_iterations * round_))
