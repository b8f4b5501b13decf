"""Optimisation of a set of clips: clips are removed or added one by one, as long as this lowers an objective.

Every step tries all candidates, each by simulating the trials that it can change. The best of them may owe its place to
chance, so it is simulated again in other replicates, and applied only if its gain is confirmed there. The objective
decreases with every step, so no set is visited twice and the loop ends. An optimisation can be continued later from the
log of its steps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.effects import Effect, corrected_for, effect_of
from marey_motion.evaluation.improvement.filling import source_seconds
from marey_motion.evaluation.improvement.objective import headline_means, objective_value
from marey_motion.evaluation.improvement.resimulation import NONE, Resimulation, Sources
from marey_schemas.options.improvement import OptimisationOptions

Action = Literal["start", "remove", "add"]
End = Literal["no gain", "not confirmed", "steps", "evaluations"]
ProgressCallback = Callable[[int, int, str], None]

CONFIRMED_AT_ONCE = 3
"""Maximum number of candidates of one step that are simulated again, the best first, until one is confirmed.

If the gain of the best candidate was due to chance, that of the next candidate may be real. But the probabilities are
corrected for the number of these candidates, so a larger maximum can make confirmations harder.
"""


@dataclass(frozen=True)
class OptimisationStep:
    """Record of one step, sufficient to repeat it.

    Parameters
    ----------
    sources : the removed or added source clip; or all source clips that no trial needs, if one step removes them
    absent : the source clips that are not in the set after the step, in ascending order
    objective : objective after the step, metres
    metrics : headline metrics after the step
    data_s : seconds of data after the step
    evaluations : number of candidates tried, over all steps so far
    changed_trials : trials whose result the step changes, in any replicate of the estimate
    confirmed : effect of the step in other replicates, with probabilities corrected for the number of candidates that
        could be confirmed; None for the start, and None for all steps if the optimisation confirms no steps
    """

    number: int
    action: Action
    sources: tuple[str, ...]
    absent: tuple[str, ...]
    objective: float
    metrics: Mapping[str, float]
    data_s: float
    evaluations: int
    changed_trials: int
    confirmed: Effect | None = None


@dataclass(frozen=True)
class Unconfirmed:
    """A candidate of a step whose estimated gain was not confirmed in other replicates, so that it was not applied.

    The probabilities of `effect` are corrected for the number of candidates of the step that could be confirmed; its
    interval is not corrected. So the interval of a refused effect can exclude 0.
    """

    action: Action
    sources: tuple[str, ...]
    estimated_gain: float
    effect: Effect


@dataclass(frozen=True)
class Optimisation:
    """Steps of an optimisation, beginning with the unchanged set ("start"), and the reason why the optimisation ended.

    `ended` is "no gain" if no candidate lowers the objective enough, "not confirmed" if the gain of none of the best
    candidates is confirmed, and "steps" or "evaluations" if the maximum number of steps or of evaluations is reached.
    `unconfirmed` contains the candidates that were refused after the last step. `total` is the effect of all steps
    together in replicates in which no step was chosen or confirmed; None if it was not simulated.
    """

    steps: tuple[OptimisationStep, ...]
    ended: End
    unconfirmed: tuple[Unconfirmed, ...] = ()
    total: Effect | None = None


def optimise(
    simulation: Resimulation,
    options: OptimisationOptions,
    *,
    confirming: Resimulation | None = None,
    absent: Collection[str] = NONE,
    log: Sequence[OptimisationStep] = (),
    made: Callable[[OptimisationStep], None] | None = None,
    progress: ProgressCallback | None = None,
) -> Optimisation:
    """Remove and add source clips until no step lowers the objective or the budget is spent.

    Parameters
    ----------
    simulation : Resimulation    simulation over a database (`selection.joined`) that contains the clips of the set and
        all clips that may be added
    options : OptimisationOptions    objective and budget
    confirming : Resimulation, optional    the same trials in other replicates; without it, no step is confirmed, and
        the estimated gain decides
    absent : collection of str    sources that may be added; the set at the start consists of all other sources
    log : sequence of OptimisationStep    earlier steps to continue from; `absent` must then list the sources that were
        absent before the first of these steps
    made : callable, optional    called with every new step
    progress : callable, optional    called as progress(candidates tried, candidates of this step, uid)

    Returns
    -------
    Optimisation    the steps, and the reason why there are no more

    Raises
    ------
    MotionError    if the log was not made with this database, these trials and this objective
    """
    steps = list(log)
    if steps:
        _require_same(simulation, options, steps[-1])
    else:
        steps.append(_step(simulation, options, 0, "start", (), frozenset(absent)))
        if made is not None:
            made(steps[0])
    search = _Search(simulation, confirming, options, steps[-1].evaluations)
    while len(steps) - 1 < options.max_steps:
        step = search.best_step(steps[-1], progress)
        if step is None:
            ended: End = "evaluations" if search.spent else "not confirmed" if search.refused else "no gain"
            return Optimisation(tuple(steps), ended, tuple(search.refused))
        steps.append(step)
        if made is not None:
            made(step)
    return Optimisation(tuple(steps), "steps")


def with_total(optimisation: Optimisation, fresh: Resimulation, options: OptimisationOptions) -> Optimisation:
    """Measure the effect of all steps together in replicates in which no step was chosen or confirmed.

    Parameters
    ----------
    optimisation : Optimisation    the steps
    fresh : Resimulation    the trials in these replicates
    options : OptimisationOptions    objective

    Returns
    -------
    Optimisation    with `total`, which stays None if there is no step
    """
    if len(optimisation.steps) == 1:
        return optimisation
    first, last = (frozenset(optimisation.steps[place].absent) for place in (0, -1))
    return replace(optimisation, total=effect_of(fresh, options.objective, first, last, with_data=True))


def _step(
    simulation: Resimulation,
    options: OptimisationOptions,
    number: int,
    action: Action,
    sources: Sequence[str],
    absent: Sources,
) -> OptimisationStep:
    results = simulation.results(absent)
    seconds = simulation.seconds(absent)
    return OptimisationStep(
        number=number,
        action=action,
        sources=tuple(sources),
        absent=tuple(sorted(absent)),
        objective=objective_value(options.objective, results, seconds),
        metrics=headline_means(results),
        data_s=seconds,
        evaluations=0,
        changed_trials=0,
    )


def _require_same(simulation: Resimulation, options: OptimisationOptions, last: OptimisationStep) -> None:
    value = objective_value(options.objective, simulation.results(last.absent), simulation.seconds(last.absent))
    if value != last.objective:
        raise MotionError(
            f"the objective after this step is {value:.17g}, but the log has {last.objective:.17g}; continue with the "
            "same clips, normaliser, trials and objective, or start a new log",
            code="log-mismatch",
            where=f"step {last.number}",
        )


class _Candidate(NamedTuple):
    """A changed set of clips that a step can choose, and its estimated gain: the decrease of the objective, metres."""

    gain: float
    action: Action
    sources: tuple[str, ...]
    absent: Sources


class _Search:
    """Search over the candidates of each step, within the budget."""

    def __init__(
        self,
        simulation: Resimulation,
        confirming: Resimulation | None,
        options: OptimisationOptions,
        evaluations: int,
    ) -> None:
        self._simulation, self._confirming, self._options = simulation, confirming, options
        self._evaluations = evaluations
        self._seconds = {
            source: own[0] for source, own in source_seconds(simulation.database, simulation.options).items()
        }
        self._least = simulation.options.coverage_least_s
        self.spent = False
        self.refused: list[Unconfirmed] = []

    def best_step(self, last: OptimisationStep, progress: ProgressCallback | None) -> OptimisationStep | None:
        """Choose the step after the step `last`.

        Of the `CONFIRMED_AT_ONCE` steps that lower the objective most, it is the best one whose gain is confirmed.
        Returns None if no step lowers the objective enough, if none of these gains is confirmed, or if the budget is
        spent. Afterwards, `refused` contains the steps whose gains were not confirmed.
        """
        self.refused = []
        found: list[_Candidate] = []
        candidates = self._candidates(frozenset(last.absent))
        for done, (action, sources, absent) in enumerate(candidates):
            if self._evaluations == self._options.max_evaluations:
                self.spent = True
                return None
            self._evaluations += 1
            results = self._simulation.results(absent)
            value = objective_value(self._options.objective, results, self._simulation.seconds(absent))
            if (gain := last.objective - value) > 0.0 and gain >= self._options.least_gain:
                found.append(_Candidate(gain, action, sources, absent))
            if progress is not None:
                progress(done + 1, len(candidates), sources[0])
        # Candidates with equal gains keep their order.
        found.sort(key=lambda one: -one.gain)
        return self._first_confirmed(last, found[:CONFIRMED_AT_ONCE])

    def _first_confirmed(self, last: OptimisationStep, best: Sequence[_Candidate]) -> OptimisationStep | None:
        for one in best:
            effect = self._confirm(frozenset(last.absent), one, len(best))
            if effect is None or effect.improves or self._is_certain(frozenset(last.absent), one, effect):
                return self._made(last, one, effect)
            self.refused.append(Unconfirmed(one.action, one.sources, one.gain, effect))
        return None

    def _made(self, last: OptimisationStep, one: _Candidate, effect: Effect | None) -> OptimisationStep:
        sides = (self._simulation.results(absent) for absent in (last.absent, one.absent))
        changed = {first.trial.name for first, second in zip(*sides, strict=True) if first != second}
        return replace(
            _step(self._simulation, self._options, last.number + 1, one.action, one.sources, one.absent),
            evaluations=self._evaluations,
            changed_trials=len(changed),
            confirmed=effect,
        )

    def _confirm(self, before: Sources, one: _Candidate, tried: int) -> Effect | None:
        if self._confirming is None:
            return None
        effect = effect_of(self._confirming, self._options.objective, before, one.absent, with_data=True)
        return corrected_for(effect, tried)

    def _is_certain(self, before: Sources, one: _Candidate, effect: Effect) -> bool:
        """Check whether a candidate lowers the objective without a change in any trial.

        The gain of such a candidate does not depend on chance.
        """
        return effect.objective.change < 0.0 and all(
            simulation.results(before) == simulation.results(one.absent)
            for simulation in (self._simulation, self._confirming)
            if simulation is not None
        )

    def _candidates(self, absent: Sources) -> list[tuple[Action, tuple[str, ...], Sources]]:
        simulation = self._simulation
        counts = simulation.trials_needing(absent)
        present = [source for source in simulation.sources if source not in absent]
        unneeded = tuple(source for source in present if counts[source] == 0)
        removals = sorted((source for source in present if counts[source]), key=lambda source: (counts[source], source))
        candidates: list[tuple[Action, tuple[str, ...], Sources]] = []
        if unneeded:
            candidates.append(("remove", unneeded, absent | set(unneeded)))
        candidates += [
            ("remove", (source,), absent | {source})
            for source in removals[: self._options.consider]
            if simulation.leaves_rows(absent | {source})
        ]
        candidates += [("add", (source,), absent - {source}) for source in self._additions(absent)]
        return candidates

    def _additions(self, absent: Sources) -> list[str]:
        """List at most `consider` absent sources to try, in descending order of the missing seconds that they supply.

        A cell lacks data if the present sources have less than `_least` seconds in it. Sources whose addition would
        exceed `max_data_s` are left out.
        """
        limit = self._options.max_data_s
        room = np.inf if limit is None else limit - self._simulation.seconds(absent)
        fitting = [source for source in sorted(absent) if self._simulation.seconds_of(source) <= room]
        covered = sum((own for source, own in self._seconds.items() if source not in absent), np.zeros(()))
        missing = np.maximum(self._least - covered, 0.0)
        filled = {source: float(np.minimum(self._seconds[source], missing).sum()) for source in fitting}
        return sorted(fitting, key=lambda source: (-filled[source], source))[: self._options.consider]
