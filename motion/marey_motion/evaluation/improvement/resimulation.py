"""A suite of trials over parts of one database, in which only affected trials are simulated again.

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

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.improvement.selection import clips_by_source, require_sources, rows_of_sources, source_of
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.metrics import measure_trial
from marey_motion.evaluation.replicates import guide_for
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.running import CancelCallback
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_motion.evaluation.suite import run_suite
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import switched_rows
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import Method, SearchIndex, build_index
from marey_schemas.options.evaluation import EvaluationOptions

Sources = frozenset[str]
NONE: Sources = frozenset()


@dataclass(frozen=True)
class Outcome:
    """Result of a trial over some clips, and the source clips whose rows were displayed or chosen in the trial."""

    result: TrialResult
    needed: Sources


class Resimulation:
    """Trials of a suite over a database from which clips are removed.

    Parameters
    ----------
    trials : the trials; all trials of the suite if None
    records : records of these trials over the whole database, if they exist already
    threads, cancelled : as in `suite.run_suite`

    The attribute `simulated` is the number of trials that were run; `sources` maps the uid of each source clip to the
    indices of this clip and its mirrored copy.
    """

    def __init__(
        self,
        database: MatchingDatabase,
        options: EvaluationOptions,
        *,
        trials: Sequence[Trial] | None = None,
        records: Sequence[TrialRecord] | None = None,
        threads: int | None = None,
        cancelled: CancelCallback | None = None,
    ) -> None:
        self.database, self.options = database, options
        self.trials = suite_trials(options) if trials is None else tuple(trials)
        self.sources = clips_by_source(database.clips)
        self.simulated = 0
        self._threads, self._cancelled = threads, cancelled
        self._source_of_clip = np.array([source_of(clip) for clip in database.clips], dtype=object)
        self.index = build_index(database.normaliser.apply(database.features), database.starts, database.selectable)
        self._looks = LooksMeter(database, options.controller)
        self._known: list[list[tuple[Sources, Outcome]]] = [[] for _ in self.trials]
        if records is not None:
            self._keep(NONE, range(len(self.trials)), records, self.index)

    def outcomes(self, removed: Collection[str] = NONE) -> tuple[Outcome, ...]:
        """Simulate the trials without some source clips and their mirrored copies.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        tuple of Outcome    one per trial, in the order of the trials

        Raises
        ------
        MotionError    if a source is unknown or no selectable row is left
        EvaluationCancelled    if cancelled
        """
        gone = frozenset(removed)
        require_sources(self.sources, gone)
        found = [self._find(number, gone) for number in range(len(self.trials))]
        ahead = [number for number, outcome in enumerate(found) if outcome is None]
        if ahead:
            index = self._index_without(gone)
            records = run_suite(
                self.database,
                self.options,
                trials=[self.trials[number] for number in ahead],
                index=index,
                threads=self._threads,
                cancelled=self._cancelled,
            )
            self.simulated += len(ahead)
            for number, outcome in zip(ahead, self._keep(gone, ahead, records, index), strict=True):
                found[number] = outcome
        return tuple(outcome for outcome in found if outcome is not None)

    def results(self, removed: Collection[str] = NONE) -> tuple[TrialResult, ...]:
        """Simulate the trials without some source clips, and return the metrics of the trials.

        Parameters
        ----------
        removed : collection of str    uids of these clips

        Returns
        -------
        tuple of TrialResult    one per trial, in the order of the trials
        """
        return tuple(outcome.result for outcome in self.outcomes(removed))

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
        selectable = self.database.selectable & ~rows_of_sources(self.database.clips, gone)
        method: Method = "boxes" if self.index.boxed else "scan"
        return build_index(self.index.rows, self.database.starts, selectable, method=method)

    def _keep(
        self, gone: Sources, numbers: Sequence[int], records: Sequence[TrialRecord], index: SearchIndex
    ) -> list[Outcome]:
        outcomes = []
        for number, record in zip(numbers, records, strict=True):
            trial = self.trials[number]
            asked = reference(trial, self.database.options.rate_hz)
            rows = needed_rows(self.database, index, trial, record, self.options)
            clips = np.unique(self.database.clip_of_row[rows])
            outcome = Outcome(
                measure_trial(trial, asked, record, self.options, self._looks),
                frozenset(self._source_of_clip[clips].tolist()),
            )
            self._known[number].append((gone, outcome))
            outcomes.append(outcome)
        return outcomes


def needed_rows(
    database: MatchingDatabase, index: SearchIndex, trial: Trial, record: TrialRecord, options: EvaluationOptions
) -> NDArray[np.int64]:
    """Find the rows that a trial displayed or chose.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    index : SearchIndex    the index that the trial was run with
    trial : Trial    the trial
    record : TrialRecord    record of the trial
    options : EvaluationOptions    options of the evaluation

    Returns
    -------
    (n,) int64    rows, ascending
    """
    from marey_motion.matching.explain import explain_choice

    chosen = switched_rows(database, record.rows)
    rows = [record.rows.astype(np.int64), chosen[chosen >= 0]]
    # What the last search chose is not displayed any more when it was made at the last tick.
    if not np.isnan(record.match_cost[-1]):
        asked, last = guide_for(trial, database), len(record.rows) - 1
        reason = explain_choice(database, index, asked, options.controller, record, last, count=1)
        rows.append(np.array([reason.chosen]))
    return np.unique(np.concatenate(rows))
