"""Draw of the trials of new participants of a study."""

from __future__ import annotations

import numpy as np

from marey_motion.perception.judging import draw_trials
from marey_server.store.studies.conducting import Plan, PlannedDraw


def draw_plans(planned: PlannedDraw, count: int) -> list[Plan]:
    """Return the motions of each trial for the next `count` participants.

    The same study draws the same trials for its first, second and further participants, however many links are created
    at once.
    """
    design = planned.design
    earlier = np.array(planned.earlier, np.int64) if planned.earlier else None
    drawn = draw_trials(len(design.motions), count, design.seed, design.trials, earlier=earlier)
    plans: list[Plan] = drawn.tolist()
    return plans
