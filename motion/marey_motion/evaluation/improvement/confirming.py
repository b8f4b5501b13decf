"""Confirmation of suggestions: replicates that did not serve to choose the suggestions measure their effects."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

from marey_motion.evaluation.improvement.effects import (
    Effect,
    chance_of,
    confirmation_replicates,
    corrected_effects,
    effect_between,
    effect_of,
)
from marey_motion.evaluation.improvement.filling import Addition
from marey_motion.evaluation.improvement.redundancy import PlannedRemoval
from marey_motion.evaluation.improvement.resimulation import Resimulation, Sources
from marey_motion.evaluation.improvement.selection import clips_by_source, joined, without_rows, without_sources
from marey_motion.evaluation.improvement.unused import Unused
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.running import CancelCallback
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.options.improvement import SuggestionOptions

ProgressCallback = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Confirmed:
    """Effects of suggestions, measured in replicates that were not used to choose the suggestions.

    The probabilities of each metric are corrected for the total number of these effects; the intervals are not.

    Parameters
    ----------
    chance : standard deviation of each headline metric over these replicates, for the unchanged set
    unused : effect of removing all unused clips; None if there are none
    ranges : effect of removing all unused clips and ranges, compared with the unchanged set; None without ranges
    plan : planned removals with their confirmed effects
    additions : clips to add; the first ones with their confirmed effects
    """

    chance: Mapping[str, float]
    unused: Effect | None
    ranges: Effect | None
    plan: tuple[PlannedRemoval, ...]
    additions: tuple[Addition, ...]


Step = TypeVar("Step", PlannedRemoval, Addition)
Value = TypeVar("Value")


def confirm(
    database: MatchingDatabase,
    result: EvaluationResult,
    how: SuggestionOptions,
    unused: Unused,
    plan: Sequence[PlannedRemoval],
    additions: Sequence[Addition],
    collections: Mapping[str, MatchingDatabase],
    *,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> Confirmed | None:
    """Measure the effects of suggestions in replicates that were not used to choose the suggestions.

    Parameters
    ----------
    database : MatchingDatabase    the set
    result : EvaluationResult    its evaluation
    how : SuggestionOptions    number and seed of the replicates
    unused : Unused    data that no trial needs
    plan : sequence of PlannedRemoval    removals from the set without its unused clips
    additions : sequence of Addition    clips to add, in order
    collections : mapping of str to MatchingDatabase    collections that contain the clips to add, by name
    threads : int, optional    threads to use, one per processor if None
    progress : callable, optional    called as progress(done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    Confirmed or None    the effects; None if the options ask for no replicates to confirm them

    Raises
    ------
    EvaluationCancelled    if cancelled
    """
    if not how.confirmation_replicates:
        return None
    simulated = _to_simulate(additions, how.simulated_additions)
    stages = _Stages(2 + len(plan) + 2 * len(simulated) + bool(unused.ranges), progress)

    def simulation(of: MatchingDatabase) -> Resimulation:
        return Resimulation(
            of,
            result.options,
            trials=[one.trial for one in result.trials],
            replicates=confirmation_replicates(how, result.options),
            seed=how.confirmation_seed,
            headlines_only=True,
            threads=threads,
            progress=stages.within,
            cancelled=cancelled,
        )

    confirming = simulation(_with_added(database, simulated, collections))
    outside = frozenset(confirming.sources.keys() - clips_by_source(database.clips).keys())
    gone = outside | {clip.source for clip in unused.clips}
    found = _addition_effects(confirming, how, simulated, outside, stages)
    whole = stages.next(confirming.by_replicate(outside))
    if unused.ranges:
        cut = simulation(without_rows(database, unused.rows))
        found.append(stages.next(effect_between(how.objective, whole, cut.by_replicate())))
    if unused.clips:
        found.append(stages.next(effect_of(confirming, how.objective, outside, gone)))
    found += _plan_effects(confirming, how, plan, gone, stages)
    # All effects are reported together, so they are one family. They are taken from it in the order of measurement.
    effects = iter(corrected_effects(found))
    added = _with_effects(simulated, effects)
    return Confirmed(
        chance=chance_of(confirming, outside),
        ranges=next(effects) if unused.ranges else None,
        unused=next(effects) if unused.clips else None,
        plan=_with_effects(plan, effects),
        additions=(*added, *(step for step in additions if step not in simulated)),
    )


class _Stages:
    """Progress over several simulations as one count, with a thousand units for each."""

    def __init__(self, count: int, progress: ProgressCallback | None) -> None:
        self._count, self._ended = count, 0
        self._report = progress or (lambda _done, _total, _note: None)

    def within(self, done: int, total: int, note: str) -> None:
        """Report the progress of the current simulation."""
        self._report(1000 * self._ended + 1000 * done // max(total, 1), 1000 * self._count, note)

    def next(self, found: Value) -> Value:
        """Report the end of the current simulation, and return its result `found`."""
        self._ended += 1
        self._report(1000 * self._ended, 1000 * self._count, "")
        return found


def _to_simulate(additions: Sequence[Addition], most: int) -> list[Addition]:
    """Choose the first `most` additions that have the set's skeleton; of a clip in two collections, only the first."""
    same = {step.filling.source: step for step in reversed(additions) if not step.filling.needs_retarget}
    return [step for step in additions if same.get(step.filling.source) is step][:most]


def _with_added(
    database: MatchingDatabase, steps: Sequence[Addition], collections: Mapping[str, MatchingDatabase]
) -> MatchingDatabase:
    """Return a database of the set together with the clips that `steps` add."""
    for name in dict.fromkeys(step.filling.collection for step in steps):
        wanted = {step.filling.source for step in steps if step.filling.collection == name}
        other = collections[name]
        database = joined(database, without_sources(other, clips_by_source(other.clips).keys() - wanted))
    return database


def _addition_effects(
    confirming: Resimulation, how: SuggestionOptions, steps: Sequence[Addition], outside: Sources, stages: _Stages
) -> list[Effect]:
    """Measure the effect of each addition, with p-values that are not corrected for multiple comparisons.

    `outside` are all sources to be added, which are absent before the first addition.
    """
    states = [outside]
    for step in steps:
        states.append(states[-1] - {step.filling.source})
    # The set with all additions comes first, so that trials that need none of them are not simulated again.
    for absent in reversed(states[1:]):
        stages.next(confirming.outcomes(absent))
    return [stages.next(effect_of(confirming, how.objective, *pair)) for pair in pairwise(states)]


def _plan_effects(
    confirming: Resimulation, how: SuggestionOptions, plan: Sequence[PlannedRemoval], gone: Sources, stages: _Stages
) -> list[Effect]:
    """Measure the effect of each removal of a plan, with p-values that are not corrected for multiple comparisons.

    `gone` are the sources that are absent before the first removal.
    """
    effects = []
    for step in plan:
        after = gone | {step.removal.source}
        effects.append(stages.next(effect_of(confirming, how.objective, gone, after)))
        gone = after
    return effects


def _with_effects(steps: Sequence[Step], effects: Iterator[Effect]) -> tuple[Step, ...]:
    """Return copies of the steps; the confirmed effect of each step is the next one of the iterator `effects`."""
    return tuple(replace(step, confirmed=next(effects)) for step in steps)
