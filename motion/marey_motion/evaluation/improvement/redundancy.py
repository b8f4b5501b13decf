"""Redundancy of clips in a set: the effect of leaving out each used clip, and a plan for several removals."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from marey_motion.evaluation.improvement.effects import Effect, effect_of
from marey_motion.evaluation.improvement.lost_poses import LostPoses
from marey_motion.evaluation.improvement.objective import headline_means
from marey_motion.evaluation.improvement.resimulation import NONE, Resimulation, Sources
from marey_schemas.options.improvement import ObjectiveOptions

ProgressCallback = Callable[[int, int, str], None]

TRIED_AGAIN = 12
"""Number of clips that each step of a plan tries, except the first step.

The order of harm changes little from step to step, and trying all clips in each step would take most of the time.
"""


@dataclass(frozen=True)
class Removal:
    """Effect of leaving out one source clip and its mirrored copy.

    Parameters
    ----------
    seconds : seconds of data saved
    trials : number of trials that need the clip; all other trials stay identical
    estimate : effect on the trials, in the replicates that are used to choose removals
    harm : estimated change of the objective without its term for the amount of data, metres; negative if the removal
        helps. With a perceptual metric, the price of the poses that the removal loses is added
    harm_per_s : `harm` per second of data saved; removals are ranked by this number, the least harmful first
    lost_s : seconds of poses that the removal loses: poses of this clip that look like no pose of the remaining clips,
        and poses of clips removed earlier that look like a pose of this clip, but like no pose of the remaining clips.
        None without a perceptual metric
    replaced_share : share of the clip's poses that look like a pose of the remaining clips; None without a perceptual
        metric
    """

    source: str
    name: str
    seconds: float
    trials: int
    estimate: Effect
    harm: float
    harm_per_s: float
    lost_s: float | None = None
    replaced_share: float | None = None


@dataclass(frozen=True)
class Appearance:
    """Comparison of poses by a perceptual metric, and the price of lost poses, in metres of the objective per second.

    The price of the poses that a removal loses is added to the harm of the removal.
    """

    poses: LostPoses
    price_m_per_s: float


@dataclass(frozen=True)
class PlannedRemoval:
    """One step of a plan: the removal of one more source clip and its mirrored copy from the set, and the result.

    Parameters
    ----------
    removal : the removed source, and the effect of its removal compared with the state after the previous step
    metrics : headline metrics of the suite after this step, in the replicates of the estimate
    seconds_left : seconds of data that are left after this step
    confirmed : effect of this removal in other replicates, corrected for the number of steps; None if it was not
        simulated in them
    """

    removal: Removal
    metrics: Mapping[str, float]
    seconds_left: float
    confirmed: Effect | None = None


def leave_one_out(
    simulation: Resimulation,
    objective: ObjectiveOptions,
    *,
    removed: Collection[str] = NONE,
    consider: int | None = None,
    appearance: Appearance | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[Removal, ...]:
    """Measure the effect of leaving out each source clip that a trial needs; the least harm per second comes first.

    Parameters
    ----------
    simulation : Resimulation    the suite over the set
    objective : ObjectiveOptions    weights of the objective, whose change is the harm
    removed : collection of str    sources that are removed already
    consider : int, optional    number of sources to try; sources that fewer trials need come first, then the order is
        that of the uids; all if None
    appearance : Appearance, optional    poses whose loss adds to the harm
    progress : callable, optional    called as progress(sources done, total, uid)

    Returns
    -------
    tuple of Removal    one per source tried; a source without which no row can be chosen is not tried
    """
    gone = frozenset(removed)
    counts = simulation.trials_needing(gone)
    rarest = sorted(counts, key=lambda source: (counts[source], source))
    candidates = [source for source in rarest if simulation.leaves_rows(gone | {source})][:consider]
    found = []
    for done, source in enumerate(candidates):
        found.append(_without(simulation, objective, gone, source, counts[source], appearance))
        if progress is not None:
            progress(done + 1, len(candidates), source)
    return _ranked(found)


def _without(
    simulation: Resimulation,
    objective: ObjectiveOptions,
    gone: Sources,
    source: str,
    trials: int,
    appearance: Appearance | None,
) -> Removal:
    """Measure the effect of leaving out one source clip, which `trials` trials need, if `gone` are removed already."""
    estimate = effect_of(simulation, objective, gone, gone | {source})
    seconds, harm = simulation.seconds_of(source), estimate.objective.change
    lost = replaced = None
    if appearance is not None:
        lost = appearance.poses.seconds(gone | {source}) - appearance.poses.seconds(gone)
        replaced = appearance.poses.replaced_share(source, gone)
        harm += appearance.price_m_per_s * lost
    name = name_of(simulation, source)
    return Removal(source, name, seconds, trials, estimate, harm, harm / seconds, lost, replaced)


def _ranked(removals: Iterable[Removal]) -> tuple[Removal, ...]:
    return tuple(sorted(removals, key=lambda removal: (removal.harm_per_s, removal.source)))


def plan_removals(
    simulation: Resimulation,
    ranked: Sequence[Removal],
    count: int,
    objective: ObjectiveOptions,
    *,
    removed: Collection[str] = NONE,
    appearance: Appearance | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[PlannedRemoval, ...]:
    """Plan removals: each step removes the source clip whose removal harms least per second of data saved.

    The first step removes the first of `ranked`. Each later step tries again the `TRIED_AGAIN` sources whose removal
    harmed least when it was last tried, and no other sources. Every step is simulated, so the metrics of a step equal
    the metrics of an evaluation of the remaining clips. The plan ends early if nothing more can be removed. Progress
    counts steps.

    Parameters
    ----------
    simulation : Resimulation    the suite over the set
    ranked : sequence of Removal    result of `leave_one_out` with the same objective, sources and appearance
    count : int    largest number of removals
    objective : ObjectiveOptions    weights of the objective, whose change is the harm
    removed : collection of str    sources that are removed already
    appearance : optional    as for `leave_one_out`
    progress : callable, optional    called as progress(steps done, total, uid)

    Returns
    -------
    tuple of PlannedRemoval    in order
    """
    gone, left = frozenset(removed), list(ranked)
    steps: list[PlannedRemoval] = []
    while left and len(steps) < count:
        if steps:
            counts = simulation.trials_needing(gone)
            again = [one.source for one in left if counts[one.source] and simulation.leaves_rows(gone | {one.source})]
            tried = [
                _without(simulation, objective, gone, source, counts[source], appearance)
                for source in again[:TRIED_AGAIN]
            ]
            left = [*_ranked(tried), *(one for one in left if one.source in again[TRIED_AGAIN:])]
            if not left:
                break
        chosen = left.pop(0)
        gone |= {chosen.source}
        steps.append(PlannedRemoval(chosen, headline_means(simulation.results(gone)), simulation.seconds(gone)))
        if progress is not None:
            progress(len(steps), count, chosen.source)
    return tuple(steps)


def name_of(simulation: Resimulation, source: str) -> str:
    """Look up the name of a source clip.

    Parameters
    ----------
    simulation : Resimulation    the suite over the set
    source : str    uid

    Returns
    -------
    str    name for people
    """
    clips = [simulation.database.clips[own] for own in simulation.sources[source]]
    return next((clip.name for clip in clips if clip.mirrored_from is None), clips[0].name)
