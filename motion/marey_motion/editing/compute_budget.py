"""Limit of the work of an edit: computed in advance, so that the same edit is always made or always refused.

Work is about nanoseconds of one thread, with measured weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from marey_motion.errors import EditError

PER_COMMAND, PER_NUMBER = 1_000_000, 100
"""Of most commands, and for each number of the motion."""
PER_RIG = 10_000_000
"""Of finding out which joints are limbs, and how they bend."""
PER_PLANTED_NUMBER = 600
PER_TAP, MOST_OF_TAPS = 0.35, 200.0
"""Of means over time, for each number: by each frame of the window, and where that is long, at most."""
PER_MEETING, PER_MET_NUMBER = 1_000_000, 10
"""Of one range of constraints that is met and blended in."""


@dataclass
class ComputeBudget:
    """Remaining work that an edit may take.

    Parameters
    ----------
    left : float    nanoseconds of one thread
    """

    left: float = inf

    def spend(self, work: float) -> None:
        """Subtract work before it is done.

        Parameters
        ----------
        work : float    nanoseconds of one thread

        Raises
        ------
        EditError    where less is left
        """
        self.left -= work
        if self.left < 0.0:
            raise EditError("the edit takes longer than it may", code="edit-too-long")
