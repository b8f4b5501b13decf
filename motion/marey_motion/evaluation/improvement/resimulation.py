"""A suite of trials over parts of one database, in which only affected trials are simulated again.

Each trial can run in several replicates; every run is simulated again on its own.

Clips are removed by making their rows unselectable. The trials are then the same as with a database without these
clips, for three reasons:

* A row is displayed only if it was chosen or follows a chosen row of the same clip.
* A trial depends only on the displayed and chosen rows and on the least cost among selectable rows.
* The order of the rows does not change, so ties are decided the same way.

A trial needs a clip if the trial displays or chooses one of the clip's rows. Removing clips that a trial does not need
leaves the trial bit-identical. By induction, the trial is unchanged up to each search; at the search, the cheapest row
is still available, and still the first among equally cheap rows. So after a removal, only the trials that need a
removed clip are simulated again. The same is true if other clips were removed before: the result of a trial is reused
after further removals, as long as all clips that the trial needs remain.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.held_out import index_for
from marey_motion.evaluation.improvement.objective import measure_headlines
from marey_motion.evaluation.improvement.selection import clips_by_source, require_sources, rows_of_sources, source_of
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.replicates import TrialReplicate, measure_run, run_of, simulate, trajectory_for
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.running import CancelCallback, ProgressCallback, run_each
from marey_motion.evaluation.scenario import Trial, reference, require_names, suite_trials
from marey_motion.matching.copies import index_of, searchable
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import switched_rows
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import Method, SearchIndex, build_index
from marey_schemas.options.evaluation import EvaluationOptions

Sources = frozenset[str]
NONE: Sources = frozenset()


@dataclass(frozen=True)
class Outcome:
    """Result of one run of a trial over some clips, and the source clips whose rows the run displayed or chose."""

    result: TrialResult
    needed: Sources


class Resimulation:
    """Trials of a suite over a database from which clips are removed.

    Parameters
    ----------
    trials : the trials; all trials of the suite if None
    records : records of these trials over the whole database, if they exist already: those of replicate 0
    replicates : numbers of the replicates in which each trial runs
    seed : seed of the replicates; that of the options if None
    headlines_only : whether only the headline metrics of each run are computed, which is faster
    threads, cancelled : as in `suite.run_suite`
    progress : called as progress(runs done, runs to do, name of the trial)

    The attribute `simulated` is the number of runs that were made; `sources` maps the uid of each source clip to the
    indices of this clip and its mirrored copy.
    """

    def __init__(
        self,
        database: MatchingDatabase,
        options: EvaluationOptions,
        *,
        trials: Sequence[Trial] | None = None,
        records: Sequence[TrialRecord] | None = None,
        replicates: Sequence[int] = (0,),
        seed: int | None = None,
        headlines_only: bool = False,
        threads: int | None = None,
        cancelled: CancelCallback | None = None,
        progress: ProgressCallback | None = None,
    ) -> None:
        self.database, self.options = database, options
        self.trials = suite_trials(options) if trials is None else tuple(trials)
        require_names(self.trials)
        self.sources = clips_by_source(database.clips)
        self.simulated = 0
        self._threads, self._cancelled = threads or os.cpu_count() or 1, cancelled or (lambda: False)
        self._progress = progress or (lambda _done, _total, _note: None)
        self._source_of_clip = np.array([source_of(clip) for clip in database.clips], dtype=object)
        self.index = index_of(database)
        self._looks = None if headlines_only else LooksMeter(database, options.controller)
        drawn = options if seed is None else options.replace(seed=seed)
        self._runs = [run_of(trial, number, drawn) for number in replicates for trial in self.trials]
        self._known: list[list[tuple[Sources, Outcome]]] = [[] for _ in self._runs]
        known = {trial.name: record for trial, record in zip(self.trials, records or (), strict=False)}
        for number, run in enumerate(self._runs):
            if run.replicate == 0 and run.trial.name in known:
                self._known[number].append((NONE, self._outcome(self.index, run, known[run.trial.name])))

    def outcomes(self, removed: Collection[str] = NONE) -> tuple[Outcome, ...]:
        """Simulate the trials without some source clips and their mirrored copies.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        tuple of Outcome    one per run: all trials of the first replicate, in their order, then all of the next

        Raises
        ------
        MotionError    if a source is unknown or no selectable row is left
        EvaluationCancelled    if cancelled
        """
        gone = frozenset(removed)
        require_sources(self.sources, gone)
        found = {number: self._find(number, gone) for number in range(len(self._runs))}
        ahead = [number for number, outcome in found.items() if outcome is None]
        if ahead:
            index = self._index_without(gone)

            def run(number: int) -> Outcome:
                one = self._runs[number]
                return self._outcome(index, one, simulate(self.database, index, self.options, one))

            def keep(number: int, outcome: Outcome) -> None:
                found[number] = outcome
                self._known[number].append((gone, outcome))
                self.simulated += 1
                ended = sum(one is not None for one in found.values())
                self._progress(ended, len(found), self._runs[number].trial.name)

            run_each(run, ahead, keep, self._threads, self._cancelled)
        return tuple(outcome for outcome in found.values() if outcome is not None)

    def results(self, removed: Collection[str] = NONE) -> tuple[TrialResult, ...]:
        """Simulate the trials without some source clips, and return the metrics of the trials.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        tuple of TrialResult    one per run: all trials of the first replicate, in their order, then all of the next
        """
        return tuple(outcome.result for outcome in self.outcomes(removed))

    def by_replicate(self, removed: Collection[str] = NONE) -> list[tuple[TrialResult, ...]]:
        """Simulate the trials without some source clips, and return the metrics of the trials in each replicate.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        list of tuple of TrialResult    for each replicate, one per trial
        """
        results, count = self.results(removed), len(self.trials)
        return [results[first : first + count] for first in range(0, len(results), count)]

    def trials_needing(self, removed: Collection[str] = NONE) -> Counter[str]:
        """Count, for each source clip, the trials that need it in any replicate.

        Parameters
        ----------
        removed : collection of str    uids of removed sources

        Returns
        -------
        Counter    by uid; sources that no trial needs are missing
        """
        outcomes, count = self.outcomes(removed), len(self.trials)
        needs = (NONE.union(*(one.needed for one in outcomes[number::count])) for number in range(count))
        return Counter(source for own in needs for source in own)

    def needed(self, removed: Collection[str] = NONE) -> Sources:
        """Find the source clips that at least one trial needs.

        Parameters
        ----------
        removed : collection of str    uids of removed sources

        Returns
        -------
        frozenset of str    uids
        """
        return NONE.union(*(outcome.needed for outcome in self.outcomes(removed)))

    def leaves_rows(self, removed: Collection[str]) -> bool:
        """Check whether a selectable row remains after some source clips are removed.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        bool    True if a row remains
        """
        return bool(np.any(self.database.selectable & ~rows_of_sources(self.database.clips, removed)))

    def seconds(self, removed: Collection[str] = NONE) -> float:
        """Compute the duration of the remaining data, without mirrored copies.

        Parameters
        ----------
        removed : collection of str    uids of removed sources

        Returns
        -------
        float    seconds
        """
        return sum(self._frames(source) for source in self.sources if source not in removed) / self._rate_hz

    def seconds_of(self, source: str) -> float:
        """Compute the duration of one source clip, without its mirrored copy.

        Parameters
        ----------
        source : str    uid

        Returns
        -------
        float    seconds
        """
        return self._frames(source) / self._rate_hz

    @property
    def _rate_hz(self) -> float:
        return self.database.options.rate_hz

    def _frames(self, source: str) -> int:
        return max(self.database.clips[own].frame_count for own in self.sources[source])

    def _find(self, number: int, gone: Sources) -> Outcome | None:
        for removed, outcome in self._known[number]:
            if removed <= gone and not outcome.needed & gone:
                return outcome
        return None

    def _index_without(self, gone: Sources) -> SearchIndex:
        if not gone:
            return self.index
        rows = searchable(self.database, rows_of_sources(self.database.clips, gone))
        method: Method = "boxes" if self.index.boxed else "scan"
        return build_index(self.index.rows, self.database.starts, rows, method=method)

    def _outcome(self, index: SearchIndex, run: TrialReplicate, record: TrialRecord) -> Outcome:
        rows = needed_rows(self.database, index, run.driven, record, self.options)
        clips = np.unique(self.database.clip_of_row[rows])
        return Outcome(self._measured(run, record), frozenset(self._source_of_clip[clips].tolist()))

    def _measured(self, run: TrialReplicate, record: TrialRecord) -> TrialResult:
        if self._looks is not None:
            return measure_run(self.database, self.options, self._looks, run, record)
        asked = reference(run.driven, self.database.options.rate_hz)
        return replace(measure_headlines(run.driven, asked, record, self.options), trial=run.trial)


def needed_rows(
    database: MatchingDatabase, index: SearchIndex, trial: Trial, record: TrialRecord, options: EvaluationOptions
) -> NDArray[np.int64]:
    """Find the rows that a trial displayed or chose.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    index : SearchIndex    the index that the trial was run with
    trial : Trial    the trial
    record : TrialRecord    simulated ticks of the trial
    options : EvaluationOptions    options of the evaluation

    Returns
    -------
    (n,) int64    rows, ascending
    """
    from marey_motion.matching.explain import explain_choice

    chosen = switched_rows(database, record.rows)
    rows = [record.rows.astype(np.int64), chosen[chosen >= 0]]
    # If the last search is at the last tick, the row that it chose is never displayed.
    if not np.isnan(record.match_cost[-1]):
        asked, last = trajectory_for(trial, database), len(record.rows) - 1
        own = index_for(database, index, trial)
        reason = explain_choice(database, own, asked, options.controller, record, last, count=1)
        rows.append(np.array([reason.chosen]))
    return np.unique(np.concatenate(rows))
