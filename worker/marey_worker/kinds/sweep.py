"""Kind `sweep`: runs the trials of an evaluation with other feature weights, one task for each setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from marey_motion.evaluation.improvement.sweep import (
    Influence,
    SweepRow,
    group_influences,
    sweep_weights,
    vary_each_group,
)
from marey_schemas.options.matching import FeatureWeights
from marey_schemas.queue.job_params import SweepParams
from marey_worker.context import Context
from marey_worker.job_io.evaluated_set import read_evaluated_set, store_document
from marey_worker.job_io.matching_clips import refusing_motion_errors

SWEEP_SCHEMA = "marey/sweep@1"


def run(context: Context, params: SweepParams) -> dict[str, Any]:
    """Run the trials with this task's settings of feature weights; the result has the metrics of each setting."""
    evaluated = read_evaluated_set(context)
    settings = vary_each_group(evaluated.result.options.database, params.factors)
    with refusing_motion_errors():
        rows = sweep_weights(
            evaluated.clips.database,
            evaluated.result.options,
            settings[context.task.position :: context.task.size],
            how=params,
            trials=evaluated.trials,
            threads=context.threads,
            progress=context.progress,
        )
    return {"rows": [_row(row) for row in rows]}


def gather(context: Context, params: SweepParams, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Combine the results of all tasks in the order of the settings, and store the document.

    Groups of features are ranked by the effect of their weights on the objective.
    """
    # Task i of n has made the settings i, i + n, i + 2n and so on.
    longest = max(len(result["rows"]) for result in results)
    found = [result["rows"][turn] for turn in range(longest) for result in results if turn < len(result["rows"])]
    rows = [_row_of(tree) for tree in found]
    influences = [_influence(influence) for influence in group_influences(rows)]
    document = {
        "schema": SWEEP_SCHEMA,
        "objective": params.objective.model_dump(),
        "settings": found,
        "influences": influences,
    }
    best = min(rows, key=lambda row: row.objective)
    return {
        "settings": len(rows),
        "objective": rows[0].objective,
        "best_objective": best.objective,
        "best_weights": best.weights.model_dump(),
        "influences": influences,
        "document": store_document(context, document),
    }


def _row(row: SweepRow) -> dict[str, Any]:
    return {
        "weights": row.weights.model_dump(),
        "metrics": dict(row.metrics),
        "headlines": row.headlines,
        "objective": row.objective,
        "confirming": list(row.confirming),
    }


def _row_of(tree: Mapping[str, Any]) -> SweepRow:
    weights = FeatureWeights.model_construct(**tree["weights"])
    return SweepRow(**(dict(tree) | {"weights": weights, "confirming": tuple(tree["confirming"])}))


def _influence(influence: Influence) -> dict[str, Any]:
    tree, confirmed = asdict(influence), influence.confirmed
    return tree if confirmed is None else {**tree, "confirmed": {**asdict(confirmed), "verdict": confirmed.verdict}}
