"""Subjects of figures: the one or two evaluation results that a figure shows, and single trials of these results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.evaluation.judgement import judge_trial, rank_trials
from marey_motion.evaluation.metrics import TrialSeries, trial_series
from marey_motion.evaluation.relevance import count_switches, measure_usage
from marey_motion.evaluation.result import ClipUsage, EvaluationResult
from marey_motion.evaluation.scenario import Trial, reference
from marey_motion.matching.record import Status, TrialRecord
from marey_reports.drawing.paper import labels_of
from marey_schemas.options.evaluation import Family


@dataclass(frozen=True)
class FigureOptions:
    """Options for drawing figures.

    Parameters
    ----------
    negate_errors : draw errors as desired minus simulated, as figure 8 of Abichequer Sangalli et al. (2022), instead of
        simulated minus desired
    logarithmic : whether the sizes of dots and the lengths of bars have a logarithmic scale
    most_clips : number of clips that are drawn one by one; all other clips are summed up
    """

    negate_errors: bool = False
    logarithmic: bool = False
    most_clips: int = 20


@dataclass(frozen=True, eq=False)
class Subject:
    """Result of an evaluation, and its name in figures: "" if the figure shows only this result."""

    label: str
    result: EvaluationResult

    @property
    def seconds_per_row(self) -> float:
        """Duration of a row of the database, in seconds."""
        return 1.0 / self.result.options.database.rate_hz

    @property
    def prefix(self) -> str:
        """Start of a sentence about this subject: its name and a colon; "" if it is the only subject."""
        return f"{self.label}: " if self.label else ""

    def column(self, name: str) -> str:
        """Return the name of this subject's column in a table: `name`, after the subject's label if there are two."""
        return f"{self.label}_{name}" if self.label else name

    def usage(self, trial: str | None) -> tuple[ClipUsage, ...]:
        """Return the use of every clip in one trial, or in the whole suite if `trial` is None."""
        return self.result.usage if trial is None else measure_usage(self.result.clips, [find_record(self, trial)])

    def switches(self, trial: str | None) -> NDArray[np.int64]:
        """Return the jumps (S, 3) in one trial, or in the whole suite if `trial` is None.

        Columns are the database row before the jump, the row after the jump, and the number of these jumps.
        """
        return self.result.switches if trial is None else count_switches(self.result.clips, [find_record(self, trial)])


def shorter_labels(subjects: Sequence[Subject], longest: int) -> list[Subject]:
    """Return the subjects with labels of at most `longest` characters; different labels stay different."""
    labels = labels_of([subject.label for subject in subjects], longest)
    return [replace(subject, label=label) for subject, label in zip(subjects, labels, strict=True)]


@dataclass(frozen=True, eq=False)
class TrialView:
    """One trial of a subject: its desired motion, and every step of its record."""

    subject: Subject
    trial: Trial
    record: TrialRecord
    series: TrialSeries

    @property
    def evaluated(self) -> NDArray[np.bool_]:
        """Mask (S,) of the steps that the metrics are computed from."""
        everything = self.subject.result.options.window == "all"
        return np.asarray(everything | (self.series.pieces >= 0))

    @property
    def switched(self) -> NDArray[np.bool_]:
        """Mask (S,) of the steps that jump to another frame because of a search, not because a clip ended."""
        return np.asarray(self.record.status[1:] == Status.REPLACING)


def view_trial(subject: Subject, trial: Trial) -> TrialView:
    """Find a trial with its record. Raises `MotionError` if the record was not stored."""
    record = find_record(subject, trial.name)
    return TrialView(subject, trial, record, trial_series(trial, reference(trial, record.rate_hz), record))


def find_record(subject: Subject, name: str) -> TrialRecord:
    """Find the record of a trial by its name. Raises `MotionError` if there is none."""
    names = [each.trial.name for each in subject.result.trials]
    if name not in names:
        raise MotionError(f"the evaluation has no trial {name!r}", code="unknown-trial")
    if len(subject.result.records) != len(names):
        raise MotionError(
            "this figure needs the records of all trials, but they were not read with the evaluation; read its part "
            "`records`, too",
            code="records-missing",
            where=name,
        )
    return subject.result.records[names.index(name)]


def choose_trial(subjects: Sequence[Subject], name: str | None, families: Sequence[Family]) -> Trial:
    """Choose the trial that a figure shows, among the trials that all `subjects` have.

    `families` are kinds of trials in the order of preference: the first family with a possible trial is used. If `name`
    is given, only the trial with this name is possible. Of several possible trials, the worst one is chosen: the trial
    with the largest error relative to its limit, in the first subject. Raises `MotionError` if no trial is possible.
    """
    known = [{each.trial.name for each in subject.result.trials} for subject in subjects]
    shared = [each for each in subjects[0].result.trials if all(each.trial.name in names for names in known)]
    for family in families:
        candidates = [each for each in shared if each.trial.family == family and name in (None, each.trial.name)]
        if candidates:
            limits = subjects[0].result.options.limits
            return rank_trials(judge_trial(each, limits) for each in candidates)[0].outcome.trial
    wanted = f"trial {name!r}" if name is not None else "trial"
    owner = "the evaluation has" if len(subjects) == 1 else "the two evaluations share"
    raise MotionError(
        f"the figure cannot be drawn: {owner} no {wanted} of the kind {' or '.join(families)}",
        code="unknown-trial",
    )
