"""Limit on the computing work of an edit.

The work is estimated in advance, in nanoseconds of one thread and with measured weights, so the same edit is always
accepted or always refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from marey_motion.errors import EditError

PER_COMMAND, PER_NUMBER = 1_000_000, 100
"""Estimated work of most commands, in nanoseconds: a fixed part, and a part for each value of the motion's arrays."""
PER_RIG = 10_000_000
"""Work, in nanoseconds, to find the limbs of a skeleton and the axes about which the limbs bend."""
PER_PLANTED_NUMBER = 600
PER_TAP, MOST_OF_TAPS = 0.35, 200.0
"""Work of a moving mean for each value of the motion, in nanoseconds.

The first number is the work per frame of the window; the second is the upper limit for the whole window.
"""
PER_COMPARED_POSES = 4_000
"""Work, in nanoseconds, to compute the perceptual distance of two poses."""
PER_CONSTRAINT_GROUP, PER_CONSTRAINED_NUMBER = 1_000_000, 10
"""Work to apply a group of constraints, in nanoseconds: a fixed part, and a part for each value of the rotations.

The work of the solver is not included.
"""


@dataclass
class ComputeBudget:
    """Remaining computing work that an edit may do.

    Parameters
    ----------
    left : float    nanoseconds of one thread
    """

    left: float = inf

    def spend(self, work: float) -> None:
        """Subtract work from the budget; call this before the work is done.

        Parameters
        ----------
        work : float    nanoseconds of one thread

        Raises
        ------
        EditError    if the work exceeds the remaining budget
        """
        self.left -= work
        if self.left < 0.0:
            raise EditError(
                "the edit needs more computing time than one edit may use; use fewer frames or fewer constraints",
                code="edit-too-long",
            )
