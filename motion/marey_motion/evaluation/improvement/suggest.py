"""Suggestions after an evaluation: unused and redundant clips, duplicates, and clips that fill holes.

Each suggestion is a proposal; the set of clips is not changed. Effects on the trials are estimated in some replicates,
to choose what to propose, and confirmed in others (`confirming`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.confirming import Confirmed, confirm
from marey_motion.evaluation.improvement.defects import Defects
from marey_motion.evaluation.improvement.duplicates import (
    NearDuplicate,
    NearDuplicates,
    find_near_duplicates,
    spared_sources,
)
from marey_motion.evaluation.improvement.effects import Effect, estimation_replicates
from marey_motion.evaluation.improvement.filling import Addition, Filling, plan_fillings, rank_fillings
from marey_motion.evaluation.improvement.lost_poses import LostPoses
from marey_motion.evaluation.improvement.redundancy import (
    Appearance,
    PlannedRemoval,
    Removal,
    leave_one_out,
    plan_removals,
)
from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.improvement.unused import Unused, find_unused
from marey_motion.evaluation.perceived import PerceivedRows, indistinguishable
from marey_motion.evaluation.provenance import provenance_of
from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.running import CancelCallback
from marey_motion.evaluation.similarity import PoseSimilarity, accepted_distance, measure_similarity
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.documents.metrics import MetricDocument
from marey_schemas.options.improvement import SuggestionOptions

ProgressCallback = Callable[[int, int, str], None]

USUAL_BLENDABLE_M = 0.5
"""Distance up to which poses count as blendable if the options set none and the suite made no transition.

The distance is a pose cost, in metres, summed over seven joints.
"""


@dataclass(frozen=True, eq=False)
class Suggestions:
    """Proposals for one set of clips, each list with the best first.

    Parameters
    ----------
    unused : data whose removal changes no trial
    redundant : all clips that were tried, ranked by the harm of their removal per second saved
    plan : a sequence of removals from the set without its unused clips, with confirmed effects
    confirmed : effects, measured in replicates that were not used to choose suggestions; None if the options ask for no
        such replicates
    spared : near-duplicates to remove, each with the pair to which it belongs; the other clip of the pair stays
    fillings, additions : clips of other collections that fill holes. In `fillings`, each is measured alone; `additions`
        is a sequence in which each is measured after all earlier clips were added
    tried : number of clips that were left out one at a time, and number of all clips that a trial needs
    metric : perceptual metric by which poses and near-duplicates were compared
    defects : defects of the clips in `fillings` beside those of the set, by uid; empty if they were not measured.
        `suggest` does not measure them: the caller can add them
    """

    result: EvaluationResult
    options: SuggestionOptions
    unused: Unused
    redundant: tuple[Removal, ...]
    plan: tuple[PlannedRemoval, ...]
    duplicates: NearDuplicates
    spared: tuple[tuple[str, NearDuplicate], ...]
    similarity: PoseSimilarity
    fillings: tuple[Filling, ...]
    additions: tuple[Addition, ...]
    tried: tuple[int, int]
    metric: MetricDocument | None = None
    confirmed: Confirmed | None = None
    defects: Mapping[str, Defects] = field(default_factory=dict)

    @property
    def harmless_steps(self) -> int:
        """Number of steps of the plan before the first one that was confirmed to move trials away from their paths."""
        worse = (number for number, step in enumerate(self.plan) if step.confirmed and _departs(step.confirmed))
        return next(worse, len(self.plan))


def _departs(effect: Effect) -> bool:
    return effect.headlines["offset_mean"].verdict == "worse"


def suggest(
    database: MatchingDatabase,
    result: EvaluationResult,
    *,
    collections: Mapping[str, MatchingDatabase] | None = None,
    options: SuggestionOptions | None = None,
    metric: MetricDocument | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> Suggestions:
    """Collect everything that an evaluation suggests about its set of clips.

    Parameters
    ----------
    database : MatchingDatabase    the set
    result : EvaluationResult    evaluation of the set, with all records
    collections : mapping of str to MatchingDatabase, optional    other collections to search for clips, by name; of any
        skeleton
    options : SuggestionOptions, optional    options
    metric : MetricDocument, optional    perceptual metric: poses are compared by it instead of metres, removals are
        also judged by the poses that are lost, and near-duplicates that look different are kept
    threads : int, optional    threads to use, one per processor if None
    progress : callable, optional    called as progress(done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    Suggestions    proposals with their effects

    Raises
    ------
    MotionError    if the evaluation does not belong to this database, or if it was read without its records
    EvaluationCancelled    if cancelled
    """
    how, others = options or SuggestionOptions(), dict(collections or {})
    _require_same(database, result)
    stages = _SuggestionStages(progress, cancelled)
    simulation = _simulation(database, result, how, threads, cancelled)
    rows = None if metric is None else PerceivedRows(database, metric)
    unused = _unused(simulation, result)
    duplicates = find_near_duplicates(
        database, threshold_cm=how.duplicate_cm, perceived_rows=rows, threads=threads, **stages.watch("duplicates")
    )
    limit = _threshold(how, result, rows)
    similarity = measure_similarity(database, result.coverage, limit, perceived_rows=rows, **stages.watch("similarity"))
    fillings = rank_fillings(
        database, result.coverage, others, result.options, limit, perceived_rows=rows, **stages.watch("filling")
    )
    gone = frozenset(clip.source for clip in unused.clips)
    appearance = _appearance(database, how, rows, limit, stages)
    redundant, plan = _redundancy(simulation, how, gone, appearance, stages)
    additions = plan_fillings(fillings, result.coverage, others, result.options)
    confirmed = confirm(
        database, result, how, unused, plan, additions, others, threads=threads, **stages.watch("confirming")
    )
    if confirmed is not None:
        plan, additions = confirmed.plan, confirmed.additions
    return Suggestions(
        result=result,
        options=how,
        unused=unused,
        redundant=redundant,
        plan=plan,
        duplicates=duplicates,
        spared=_spared(database, result, duplicates, metric),
        metric=metric,
        similarity=similarity,
        fillings=fillings,
        additions=additions,
        tried=(len(redundant), len(simulation.needed(gone))),
        confirmed=confirmed,
    )


def _simulation(
    database: MatchingDatabase,
    result: EvaluationResult,
    how: SuggestionOptions,
    threads: int | None,
    cancelled: CancelCallback | None,
) -> Resimulation:
    """Make a simulation of the replicates in which effects are estimated; the evaluation's records are reused."""
    return Resimulation(
        database,
        result.options,
        trials=[trial.trial for trial in result.trials],
        records=result.records,
        replicates=estimation_replicates(how),
        headlines_only=True,
        threads=threads,
        cancelled=cancelled,
    )


def _unused(simulation: Resimulation, result: EvaluationResult) -> Unused:
    """Find the data that no trial needs, from the records of the first replicate and the usage over all replicates."""
    shown = np.concatenate([use.popularity > 0 for use in result.usage])
    return find_unused(
        simulation.database,
        simulation.trials,
        result.records,
        result.options,
        index=simulation.index,
        shown=shown,
    )


def _spared(
    database: MatchingDatabase, result: EvaluationResult, duplicates: NearDuplicates, metric: MetricDocument | None
) -> tuple[tuple[str, NearDuplicate], ...]:
    """Choose clips to remove, so that no near-duplicates that look alike are left.

    Of each pair, the clip that the trials use less is removed.
    """
    ticks = {use.uid: use.ticks for use in sum_by_source(database.clips, result.usage)}
    most = np.inf if metric is None else indistinguishable(metric)
    return spared_sources(database, duplicates, ticks, most_perceived=most)


def _threshold(how: SuggestionOptions, result: EvaluationResult, perceived_rows: PerceivedRows | None) -> float:
    """Return the greatest distance of poses that can be blended: in metres or, with a metric, without unit."""
    if perceived_rows is None:
        return how.blendable_m or accepted_distance(result.records) or USUAL_BLENDABLE_M
    return (
        how.blendable_distance
        or perceived_rows.transitions(result.switches).median
        or indistinguishable(perceived_rows.document)
    )


def _appearance(
    database: MatchingDatabase,
    how: SuggestionOptions,
    perceived_rows: PerceivedRows | None,
    threshold: float,
    stages: _SuggestionStages,
) -> Appearance | None:
    """Compare the poses of all clips by the perceptual metric; None if no metric was chosen."""
    if perceived_rows is None:
        return None
    return Appearance(LostPoses(database, perceived_rows, threshold, **stages.watch("lost poses")), how.lost_pose)


def _redundancy(
    simulation: Resimulation,
    how: SuggestionOptions,
    gone: frozenset[str],
    appearance: Appearance | None,
    stages: _SuggestionStages,
) -> tuple[tuple[Removal, ...], tuple[PlannedRemoval, ...]]:
    """Rank the clips by the harm of their removal, and plan several removals.

    Both computations start from the set without the unused clips; `gone` contains the uids of these clips.
    """
    found = leave_one_out(
        simulation,
        how.objective,
        removed=gone,
        consider=how.consider,
        appearance=appearance,
        progress=stages.within("leaving out"),
    )
    plan = plan_removals(
        simulation,
        found,
        how.removals,
        how.objective,
        removed=gone,
        appearance=appearance,
        progress=stages.within("planning"),
    )
    return found, plan


def _require_same(database: MatchingDatabase, result: EvaluationResult) -> None:
    if len(result.records) != len(result.trials):
        raise MotionError(
            "the evaluation lacks the records of its trials; read it with its records, or make it again",
            code="records-missing",
        )
    own = provenance_of(database, result.options, [trial.trial for trial in result.trials])
    different = [name for name in ("dataset", "normaliser") if getattr(own, name) != getattr(result.provenance, name)]
    if different:
        raise MotionError(
            f"the evaluation was made from other data ({', '.join(different)}); evaluate this set of clips first",
            code="not-comparable",
            where=", ".join(different),
        )


class _SuggestionStages:
    """Progress over several stages as one count, with a thousand units for each stage."""

    NAMES = ("duplicates", "similarity", "filling", "lost poses", "leaving out", "planning", "confirming")

    def __init__(self, progress: ProgressCallback | None, cancelled: CancelCallback | None) -> None:
        self._report = progress or (lambda _done, _total, _note: None)
        self._cancelled = cancelled

    def within(self, stage: str) -> ProgressCallback:
        """Make the progress callback of a stage."""
        before = 1000 * self.NAMES.index(stage)

        def report(done: int, total: int, note: str) -> None:
            self._report(before + 1000 * done // max(total, 1), 1000 * len(self.NAMES), f"{stage}: {note}")

        return report

    def watch(self, stage: str) -> dict[str, Any]:
        """Make the keyword arguments `progress` and `cancelled` for a stage."""
        return {"progress": self.within(stage), "cancelled": self._cancelled}
