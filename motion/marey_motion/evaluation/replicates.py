"""Replicates of trials: the same trial with another start, which shows how much its metrics vary by chance.

A replicate differs from its trial in two respects on which no result should depend. The character starts up to
`START_S` seconds later in the motion that the first search finds, and thus in another phase of its stride. And the
approach is up to `APPROACH_S` seconds longer. Both times are drawn from a random stream that depends only on the seed,
the trial and the number of the replicate, so that results depend neither on threads nor on the division into tasks.
Replicate 0 is the trial itself.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from marey_motion.evaluation.held_out import index_for
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.metrics import measure_trial
from marey_motion.evaluation.relevance import UsageTally, treading_steps
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.running import CancelCallback, ProgressCallback, run_each
from marey_motion.evaluation.scenario import LOOK_AHEAD_S, Reference, Trial, reference
from marey_motion.matching.controller import run_trial
from marey_motion.matching.copies import index_of
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import Status, TrialRecord
from marey_motion.matching.search import SearchIndex
from marey_schemas.options.evaluation import EvaluationOptions

START_S = 1.0
"""Greatest delay of the start, in seconds: about a stride, and as far as the first search looks ahead."""
APPROACH_S = 1.0
"""Greatest lengthening of the approach, in seconds."""


@dataclass(frozen=True)
class TrialReplicate:
    """One run of a trial.

    `driven` is a copy of the trial with the approach time of this replicate; `start_ticks` is the delay of the start.
    """

    trial: Trial
    replicate: int
    driven: Trial
    start_ticks: int


def run_of(trial: Trial, replicate: int, options: EvaluationOptions) -> TrialReplicate:
    """Draw the start and the approach of one replicate of a trial.

    Parameters
    ----------
    trial : Trial    the trial
    replicate : int    number of the replicate; 0 is the trial itself
    options : EvaluationOptions    seed and rate

    Returns
    -------
    TrialReplicate    the start and the approach of the replicate, in whole ticks
    """
    if replicate == 0:
        return TrialReplicate(trial, 0, trial, 0)
    rate_hz = options.database.rate_hz
    key = hashlib.sha256(f"{options.seed} {trial.name}".encode()).digest()[:16]
    stream = np.random.Philox(key=int.from_bytes(key, "little"), counter=replicate << 128)
    later, longer = np.random.Generator(stream).random(2).tolist()
    approach_s = trial.approach_s + round(longer * APPROACH_S * rate_hz) / rate_hz
    return TrialReplicate(trial, replicate, replace(trial, approach_s=approach_s), round(later * START_S * rate_hz))


def trajectory_for(trial: Trial, database: MatchingDatabase) -> Reference:
    """Compute a trial's trajectory, extended beyond the end of the trial by the look-ahead of the database.

    Parameters
    ----------
    trial : Trial    the trial
    database : MatchingDatabase    frame rate, and horizons up to which its features look ahead

    Returns
    -------
    Reference    the trajectory
    """
    horizon_s = max(LOOK_AHEAD_S, *database.options.horizons_s)
    return reference(trial, database.options.rate_hz, horizon_s)


def simulate(
    database: MatchingDatabase, index: SearchIndex, options: EvaluationOptions, run: TrialReplicate
) -> TrialRecord:
    """Simulate motion matching along the trajectory of one replicate.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    index : SearchIndex    index of the database's normalised features
    options : EvaluationOptions    options of the controller
    run : TrialReplicate    the replicate

    Returns
    -------
    TrialRecord    displayed row, position, heading and costs at each tick
    """
    trajectory = trajectory_for(run.driven, database)
    own = index_for(database, index, run.trial)
    return run_trial(database, own, trajectory, options.controller, start_ticks=run.start_ticks)


def measure_run(
    database: MatchingDatabase, options: EvaluationOptions, looks: LooksMeter, run: TrialReplicate, record: TrialRecord
) -> TrialResult:
    """Compute the metrics of one replicate; the result names the trial that is replicated.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    looks : LooksMeter    measurement of feet and smoothness over the database
    run : TrialReplicate    the replicate
    record : TrialRecord    simulated ticks of the replicate

    Returns
    -------
    TrialResult    metrics by name
    """
    asked = reference(run.driven, database.options.rate_hz)
    return replace(measure_trial(run.driven, asked, record, options, looks), trial=run.trial)


@dataclass(frozen=True)
class MeasuredRun:
    """Metrics of one replicate, the number of its chosen jumps, and how many of them tread on the spot."""

    outcome: TrialResult
    jumps: int
    treading: int


@dataclass(frozen=True, eq=False)
class MeasuredReplicates:
    """Replicates of some trials, from the second on, and the use of clips in them.

    Parameters
    ----------
    runs : replicates 1, 2, … of each trial, by the name of the trial
    usage : use of the clips, over all these replicates
    """

    runs: Mapping[str, tuple[MeasuredRun, ...]]
    usage: UsageTally

    def as_tree(self) -> dict[str, Any]:
        """Convert to plain values and arrays.

        Returns
        -------
        dict    input of `from_trees`
        """
        return {
            "runs": {
                name: [
                    {
                        "metrics": dict(run.outcome.metrics),
                        "regimes": {regime: dict(own) for regime, own in run.outcome.regimes.items()},
                        "jumps": run.jumps,
                        "treading": run.treading,
                    }
                    for run in runs
                ]
                for name, runs in self.runs.items()
            },
            "usage": asdict(self.usage),
        }

    @classmethod
    def from_trees(cls, trees: Sequence[Mapping[str, Any]], trials: Sequence[Trial]) -> MeasuredReplicates | None:
        """Join the replicates of several tasks.

        Parameters
        ----------
        trees : sequence of mapping    written by `as_tree`
        trials : sequence of Trial    the trials

        Returns
        -------
        MeasuredReplicates or None    None if there are no trees
        """
        known = {trial.name: trial for trial in trials}
        runs = {
            name: tuple(
                MeasuredRun(TrialResult(known[name], one["metrics"], one["regimes"]), one["jumps"], one["treading"])
                for one in several
            )
            for tree in trees
            for name, several in tree["runs"].items()
        }
        return cls(runs, UsageTally.total([UsageTally(**tree["usage"]) for tree in trees])) if trees else None


@dataclass(eq=False)
class _FinishedReplicates:
    """Metrics of the replicates that have ended, and the use of clips in them."""

    usage: UsageTally
    runs: dict[tuple[str, int], MeasuredRun] = field(default_factory=dict)


def run_replicates(
    database: MatchingDatabase,
    options: EvaluationOptions,
    trials: Sequence[Trial],
    *,
    index: SearchIndex | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> MeasuredReplicates | None:
    """Simulate and measure all replicates of the trials except replicate 0, which is the trial itself.

    The simulated ticks are discarded after they are measured.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation, with the number of replicates
    trials : sequence of Trial    the trials
    index : SearchIndex, optional    index of the database's normalised features, built if None
    threads : int, optional    number of replicates at a time; one per processor if None
    progress : callable, optional    called as progress(replicates done, total, name of the last trial)
    cancelled : callable, optional    called before replicates are started; returns True to stop

    Returns
    -------
    MeasuredReplicates or None    None if the options ask for one replicate only, which is the trial itself

    Raises
    ------
    EvaluationCancelled    if cancelled
    """
    if options.replicates == 1:
        return None
    searched = index or index_of(database)
    looks = LooksMeter(database, options.controller)
    runs = [run_of(trial, number, options) for trial in trials for number in range(1, options.replicates)]
    ended = _FinishedReplicates(UsageTally.of(database.clips))
    report = progress or (lambda _done, _total, _note: None)

    def run(one: TrialReplicate) -> tuple[MeasuredRun, TrialRecord]:
        record = simulate(database, searched, options, one)
        jumps = int(np.count_nonzero(record.status[1:] == Status.REPLACING))
        treading = int(np.count_nonzero(treading_steps(database.clips, record)))
        return MeasuredRun(measure_run(database, options, looks, one, record), jumps, treading), record

    def keep(one: TrialReplicate, made: tuple[MeasuredRun, TrialRecord]) -> None:
        measured, record = made
        ended.usage.add(database.clips, one.trial.name, record)
        ended.runs[one.trial.name, one.replicate] = measured
        report(len(ended.runs), len(runs), one.trial.name)

    run_each(run, runs, keep, threads or os.cpu_count() or 1, cancelled or (lambda: False))
    numbers = range(1, options.replicates)
    ordered = {trial.name: tuple(ended.runs[trial.name, number] for number in numbers) for trial in trials}
    return MeasuredReplicates(ordered, ended.usage)
