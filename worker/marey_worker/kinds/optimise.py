"""Kind `optimise`: removes and adds clips of an evaluated set step by step, and logs each step."""

from __future__ import annotations

from typing import Any

from marey_motion.evaluation.improvement.effects import confirmation_replicates, estimation_replicates
from marey_motion.evaluation.improvement.optimise import Optimisation, OptimisationStep, optimise, with_total
from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.improvement.selection import joined, same_skeleton, source_of
from marey_motion.evaluation.improvement.suggestion_documents import optimisation_to_tree
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.queue.job_params import OptimiseParams
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.candidates import Candidates, read_candidates
from marey_worker.job_io.evaluated_set import EvaluatedSet, read_evaluated_set, store_document
from marey_worker.job_io.matching_clips import refusing_motion_errors


def run(context: Context, params: OptimiseParams) -> dict[str, Any]:
    """Remove and add clips while this improves the evaluated set.

    The result refers to the document that lists the steps.
    """
    evaluated = read_evaluated_set(context)
    candidates = read_candidates(context, evaluated)
    with refusing_motion_errors():
        database = _with_candidates(evaluated.clips.database, candidates)
        simulation = _simulation(context, evaluated, database, estimation_replicates(params))
        others = _confirming(context, params, evaluated, database)
        own = {source_of(clip) for clip in evaluated.clips.database.clips}
        names = {source_of(clip): clip.name for clip in database.clips if clip.mirrored_from is None}
        steps: list[OptimisationStep] = []

        def made(step: OptimisationStep) -> None:
            steps.append(step)
            context.log(_describe(step, names))

        found = optimise(
            simulation,
            params,
            confirming=others[0] if others else None,
            absent=simulation.sources.keys() - own,
            made=made,
            progress=lambda done, total, uid: context.progress(
                done, total, f"step {len(steps)}: trying {names.get(uid, uid)}"
            ),
        )
        if others:
            context.progress(0, None, "confirming all steps together")
            found = with_total(found, others[1], params)
    _log_end(context, found, names)
    first, last = found.steps[0], found.steps[-1]
    return {
        "steps": len(found.steps) - 1,
        "ended": found.ended,
        "objective_before": first.objective,
        "objective_after": last.objective,
        "confirmed_change": None if found.total is None else found.total.objective.change,
        "data_s_before": first.data_s,
        "data_s_after": last.data_s,
        "document": store_document(context, {**optimisation_to_tree(found), "names": names}),
    }


def _with_candidates(database: MatchingDatabase, candidates: Candidates) -> MatchingDatabase:
    """Return one matching database with the clips of the evaluated set and all candidates.

    Raises `JobRefused` if the clips cannot be combined in one database.
    """
    unusable = [f"{one.folder} ({one.detail})" for one in candidates.unusable]
    mismatched = [name for name, other in candidates.databases.items() if not same_skeleton(database, other)]
    if unusable or mismatched:
        raise JobRefused(
            "skeleton-mismatch",
            f"the clips in {', '.join([*mismatched, *unusable])} cannot be combined with the clips of the evaluation; "
            "move them to the evaluation's skeleton first, with `marey retarget`, or leave them out",
        )
    for other in candidates.databases.values():
        database = joined(database, other)
    return database


def _simulation(
    context: Context, evaluated: EvaluatedSet, database: MatchingDatabase, replicates: range, seed: int | None = None
) -> Resimulation:
    """Return a simulation of the evaluation's trials with the clips of `database`, for some of the replicates.

    If `database` contains only the clips of the evaluated set, the records of the evaluation are used again.
    """
    alone = database is evaluated.clips.database
    return Resimulation(
        database,
        evaluated.result.options,
        trials=evaluated.trials,
        records=evaluated.result.records if alone else None,
        replicates=replicates,
        seed=seed,
        headlines_only=True,
        threads=context.threads,
    )


def _confirming(
    context: Context, params: OptimiseParams, evaluated: EvaluatedSet, database: MatchingDatabase
) -> list[Resimulation]:
    """Return two simulations with other replicates: one confirms single steps, and one all steps together.

    The list is empty if `confirmation_replicates` is 0.
    """
    turns = range(2 if params.confirmation_replicates else 0)
    replicates = [confirmation_replicates(params, evaluated.result.options, turn) for turn in turns]
    return [_simulation(context, evaluated, database, numbers, params.confirmation_seed) for numbers in replicates]


def _log_end(context: Context, found: Optimisation, names: dict[str, str]) -> None:
    for one in found.unconfirmed:
        clips = ", ".join(names.get(source, source) for source in one.sources)
        change = one.effect.objective
        context.log(
            f"not confirmed: {one.action} {clips}: the objective seemed to change by {-one.estimated_gain:+.4f} m, in "
            f"other replicates by {change.change:+.4f} m"
        )
    context.log(f"ended: {found.ended}")


def _describe(step: OptimisationStep, names: dict[str, str]) -> str:
    did = {"start": "the unchanged set", "remove": "without", "add": "with"}[step.action]
    clips = ", ".join(names.get(source, source) for source in step.sources)
    offset = step.metrics["offset_mean"]
    values = f"objective {step.objective:.4f} m, offset {offset:.4f} m, {step.data_s:.1f} s of data"
    return f"step {step.number}: {did} {clips}".rstrip() + f": {values}, {step.changed_trials} trials changed"
