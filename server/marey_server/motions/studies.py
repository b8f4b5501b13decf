"""Computations of studies: the draw of trials for new participants, and the differences that they perceived."""

from __future__ import annotations

import numpy as np

from marey_motion.arrays import Ints
from marey_motion.errors import MotionError
from marey_motion.perception.judging import difference_table, draw_trials, judgements_of
from marey_motion.perception.ordering import order_along_first_component
from marey_schemas.studies.conducting import StudyDifferences
from marey_server.store.studies.conducting import Plan, PlannedDraw
from marey_server.store.studies.judgements import CollectedAnswers


def draw_plans(planned: PlannedDraw, count: int) -> list[Plan]:
    """Draw the trials of the next `count` participants of a study.

    Return the motions of each trial, as indices of shape (count, trials, motions per trial). The trials of a
    participant depend only on the study and on the participant's number in it, not on the number of links that are
    created at once.
    """
    design = planned.design
    earlier = np.array(planned.earlier, np.int64) if planned.earlier else None
    drawn = draw_trials(len(design.motions), count, design.seed, design.trials, earlier=earlier)
    plans: list[Plan] = drawn.tolist()
    return plans


def find_differences(collected: CollectedAnswers) -> StudyDifferences:
    """Compute how different the motions of a study look to its participants, and order the motions by this.

    The order is None as long as a motion is in no answered trial.
    """
    count = collected.motion_count
    if not collected.answers:
        none = ((0,) * count,) * count
        unknown = tuple(tuple(0.0 if i == j else None for j in range(count)) for i in range(count))
        return StudyDifferences(
            revision=collected.revision, participants=0, trials=0, shown=none, chosen=none, differences=unknown,
            order=None, noise=None,
        )  # fmt: skip
    # As of one participant: otherwise, tables of each participant would need memory.
    table = difference_table(judgements_of(count, [(0, shown, chosen) for _, shown, chosen in collected.answers]))
    try:
        order = tuple(order_along_first_component(table.differences).tolist())
    except MotionError:  # a motion was in no answered trial yet
        order = None
    return StudyDifferences(
        revision=collected.revision,
        participants=len({answer[0] for answer in collected.answers}),
        trials=len(collected.answers),
        shown=_rows(table.shown),
        chosen=_rows(table.chosen),
        differences=tuple(tuple(None if np.isnan(one) else float(one) for one in row) for row in table.differences),
        order=order,
        noise=table.noise_ceiling,
    )


def _rows(counts: Ints) -> tuple[tuple[int, ...], ...]:
    return tuple(map(tuple, counts.tolist()))
