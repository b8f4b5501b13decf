"""Optimisation of a set of clips: clips are removed or added one by one, as long as this lowers an objective.

Every step tries all candidates, each by simulating the trials that it can change, and applies the best one. The
objective decreases with every step, so no set is visited twice and the loop ends. An optimisation can be continued
later from the log of its steps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.filling import source_seconds
from marey_motion.evaluation.improvement.objective import headline_means, objective_value
from marey_motion.evaluation.improvement.resimulation import NONE, Resimulation, Sources
from marey_schemas.options.improvement import OptimisationOptions

Action = Literal["start", "remove", "add"]
ProgressCallback = Callable[[int, int, str], None]


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
    changed_trials : trials whose result the step changes
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


@dataclass(frozen=True)
class Optimisation:
    """Steps of an optimisation, beginning with the unchanged set ("start"), and the reason why the optimisation ended.

    `ended` is "no gain" if no candidate lowers the objective enough, and "steps" or "evaluations" if the maximum number
    of steps or of evaluations is reached.
    """

    steps: tuple[OptimisationStep, ...]
    ended: Literal["no gain", "steps", "evaluations"]


def optimise(
    simulation: Resimulation,
    options: OptimisationOptions,
    *,
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
    absent : collection of str    sources that may be added; all other sources are the set
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
        steps.append(_step(simulation, options, 0, "start", (), frozenset(absent), 0, 0))
        if made is not None:
            made(steps[0])
    search = _Search(simulation, options, steps[-1].evaluations)
    while len(steps) - 1 < options.max_steps:
        step = search.best_step(steps[-1], progress)
        if step is None:
            return Optimisation(tuple(steps), "evaluations" if search.spent else "no gain")
        steps.append(step)
        if made is not None:
            made(step)
    return Optimisation(tuple(steps), "steps")


def _step(
    simulation: Resimulation,
    options: OptimisationOptions,
    number: int,
    action: Action,
    sources: Sequence[str],
    absent: Sources,
    evaluations: int,
    changed_trials: int,
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
        evaluations=evaluations,
        changed_trials=changed_trials,
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


class _Search:
    """Search over the candidates of each step, within the budget."""

    def __init__(self, simulation: Resimulation, options: OptimisationOptions, evaluations: int) -> None:
        self._simulation, self._options = simulation, options
        self._evaluations = evaluations
        self._seconds = {
            source: own[0] for source, own in source_seconds(simulation.database, simulation.options).items()
        }
        self._least = simulation.options.coverage_least_s
        self.spent = False

    def best_step(self, last: OptimisationStep, progress: ProgressCallback | None) -> OptimisationStep | None:
        """Choose the step, after the step `last`, that lowers the objective most.

        Returns None if no step lowers the objective enough, or if the budget is spent.
        """
        candidates = self._candidates(frozenset(last.absent))
        best: tuple[float, Action, tuple[str, ...], Sources] | None = None
        for done, (action, sources, absent) in enumerate(candidates):
            if self._evaluations == self._options.max_evaluations:
                self.spent = True
                return None
            self._evaluations += 1
            results = self._simulation.results(absent)
            value = objective_value(self._options.objective, results, self._simulation.seconds(absent))
            if best is None or value < best[0]:
                best = value, action, sources, absent
            if progress is not None:
                progress(done + 1, len(candidates), sources[0])
        if best is None or last.objective - best[0] < self._options.least_gain:
            return None
        _, action, sources, absent = best
        before, after = self._simulation.outcomes(last.absent), self._simulation.outcomes(absent)
        changed = sum(one.result != other.result for one, other in zip(before, after, strict=True))
        return _step(
            self._simulation, self._options, last.number + 1, action, sources, absent, self._evaluations, changed
        )

    def _candidates(self, absent: Sources) -> list[tuple[Action, tuple[str, ...], Sources]]:
        simulation = self._simulation
        outcomes = simulation.outcomes(absent)
        present = [source for source in simulation.sources if source not in absent]
        counts = {source: sum(source in outcome.needed for outcome in outcomes) for source in present}
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
