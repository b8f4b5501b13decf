"""What figures are drawn of: one result, or two under their names, and one trial of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.evaluation.result import EvaluationResult, TrialResult
from marey_motion.evaluation.scenario import Family, Reference, Trial, reference
from marey_motion.matching.record import TrialRecord

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FigureOptions:
    """What can be chosen about how figures are drawn.

    Parameters
    ----------
    negate_errors : draw reference minus recorded, as the paper's figure 8, instead of recorded minus reference
    logarithmic : popularity of frames, and lengths of bars of usage, on a logarithmic scale
    most_clips : clips that are drawn one by one; the rest is summed up
    """

    negate_errors: bool = False
    logarithmic: bool = False
    most_clips: int = 20


@dataclass(frozen=True, eq=False)
class Subject:
    """A result under the name that figures give it; the name is "" when it is the only one."""

    label: str
    result: EvaluationResult

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """First row of each clip."""
        return np.array([clip.start for clip in self.result.clips], dtype=np.int64)

    def clips_of(self, rows: NDArray[np.integer]) -> NDArray[np.int64]:
        """Index of the clip that holds each row."""
        return np.asarray(np.searchsorted(self.starts, rows, side="right") - 1, dtype=np.int64)

    @property
    def seconds_per_row(self) -> float:
        """Of the database."""
        return 1.0 / self.result.options.database.rate_hz


@dataclass(frozen=True, eq=False)
class TrialView:
    """One trial of a subject: what it asked for and every tick of what happened."""

    subject: Subject
    outcome: TrialResult
    record: TrialRecord
    reference: Reference

    @property
    def times_s(self) -> Floats:
        """(T,) of the ticks."""
        return np.arange(len(self.record.rows)) / self.record.rate_hz

    @property
    def speeds_m_s(self) -> Floats:
        """(T,) length of the chord that leads to each tick; the first tick has that of the second."""
        return self._rates(np.linalg.norm(np.diff(self.record.positions, axis=0), axis=1))

    @property
    def turn_rates_deg_s(self) -> Floats:
        """(T,) of where the character faces."""
        return np.degrees(self._rates(np.diff(self.record.headings)))

    @property
    def wished_speeds_m_s(self) -> Floats:
        """(T,)."""
        return self.reference.speeds_m_s[: len(self.record.rows)]

    @property
    def wished_turn_rates_deg_s(self) -> Floats:
        """(T,)."""
        return np.degrees(self.reference.turn_rates_rad_s[: len(self.record.rows)])

    @property
    def evaluated(self) -> NDArray[np.bool_]:
        """(T,) the ticks that the metrics are taken over."""
        if self.subject.result.options.window == "all":
            return np.ones(len(self.record.rows), dtype=np.bool_)
        return np.asarray(self.times_s >= self.outcome.trial.approach_s - 1e-9)

    def _rates(self, steps: Floats) -> Floats:
        return np.concatenate((steps[:1], steps)) * self.record.rate_hz


def view_trial(subject: Subject, name: str) -> TrialView:
    """One trial by name, with its record. Raises `MotionError` when there is none."""
    index = next((index for index, each in enumerate(subject.result.trials) if each.trial.name == name), None)
    if index is None:
        raise MotionError(f"the evaluation has no trial {name!r}", code="unknown-trial")
    if len(subject.result.records) != len(subject.result.trials):
        raise MotionError("this figure needs the records of the trials", code="records-missing", where=name)
    outcome, record = subject.result.trials[index], subject.result.records[index]
    return TrialView(subject, outcome, record, reference(outcome.trial, record.rate_hz))


def choose_trial(subjects: Sequence[Subject], name: str | None, families: Sequence[Family]) -> Trial:
    """The trial of a name that all subjects have; without a name that with the largest mean offset of the first subject,
    from the first of the families that has any.

    Raises `MotionError` when there is none.
    """
    known = [{each.trial.name for each in subject.result.trials} for subject in subjects]
    shared = [each for each in subjects[0].result.trials if all(each.trial.name in names for names in known)]
    for family in families:
        candidates = [each for each in shared if each.trial.family == family and name in (None, each.trial.name)]
        if candidates:
            return max(candidates, key=lambda each: each.metrics.get("offset_mean") or 0.0).trial
    wanted = f"trial {name!r}" if name is not None else "trial"
    raise MotionError(f"the evaluation has no {wanted} of the kind {' or '.join(families)}", code="unknown-trial")
