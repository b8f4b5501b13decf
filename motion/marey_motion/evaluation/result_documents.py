"""Conversion of evaluations, and of the simulated ticks of their trials, to and from plain values and arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.evaluation.judgement import judge
from marey_motion.evaluation.perceived import PerceivedTransitions
from marey_motion.evaluation.result import (
    ClipUsage,
    Coverage,
    EvaluationResult,
    Provenance,
    ReplicateValues,
    TrialResult,
)
from marey_motion.evaluation.scenario import Trial
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import TrialRecord
from marey_schemas.documents.evaluations import COSTS
from marey_schemas.options.evaluation import EvaluationOptions, Grid

EVALUATION_SCHEMA = "marey/evaluation@1"
RECORDS_SCHEMA = "marey/evaluation-records@1"

Tree = dict[str, Any]


def result_to_tree(result: EvaluationResult) -> Tree:
    """Convert an evaluation to the content of its document, without the simulated ticks of its trials.

    The ticks are a separate document (`records_to_tree`).

    Parameters
    ----------
    result : EvaluationResult    the evaluation

    Returns
    -------
    dict    plain values and arrays
    """
    perceived = {} if result.perceived is None else {"perceived": asdict(result.perceived)}
    return {"schema": EVALUATION_SCHEMA, **_result_body(result), **_replicates_to_tree(result.replicates), **perceived}


def _replicates_to_tree(replicates: ReplicateValues | None) -> Tree:
    """Convert the metrics of all replicates, with the mean and the ends of the interval of each metric of the suite."""
    if replicates is None:
        return {}
    intervals = {name: replicates.interval(name) for name in replicates.suite}
    known = {name: one._asdict() for name, one in intervals.items() if one is not None}
    return {
        "replicates": {
            "names": list(replicates.names),
            "values": np.nan_to_num(replicates.values),
            "defined": np.isfinite(replicates.values),
            "followed": replicates.followed,
            "suite": {name: [_defined(value) for value in own.tolist()] for name, own in replicates.suite.items()},
            "intervals": known,
        }
    }


def _defined(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _replicates(tree: Mapping[str, Any] | None) -> ReplicateValues | None:
    if tree is None:
        return None
    return ReplicateValues(
        names=tuple(tree["names"]),
        values=np.where(tree["defined"], tree["values"], np.nan),
        followed=tree["followed"],
        suite={name: np.array(own, dtype=np.float64) for name, own in tree["suite"].items()},  # None becomes NaN
    )


def _result_body(result: EvaluationResult) -> Tree:
    judgement = judge(result)
    ranks = {each.outcome.trial.name: rank for rank, each in enumerate(judgement.ranked)}
    return {
        "options": _options_to_tree(result.options),
        "provenance": _plain(asdict(result.provenance)),
        "clips": [_plain(asdict(clip)) for clip in result.clips],
        "trials": [
            {
                "trial": _plain(asdict(one.outcome.trial)),
                "metrics": dict(one.outcome.metrics),
                "regimes": _plain(one.outcome.regimes),
                "followed": one.followed,
                "worst_rank": ranks[one.outcome.trial.name],
                "beyond_limits": list(dict.fromkeys(check.measure for check in one.exceeded)),
            }
            for one in judgement.trials
        ],
        "suite": dict(result.suite),
        "usage": {
            "clip": np.array([usage.clip for usage in result.usage], dtype=np.int32),
            "ticks": np.array([usage.ticks for usage in result.usage], dtype=np.int64),
            "share": np.array([usage.share for usage in result.usage], dtype=np.float64),
            "entries": np.array([usage.entries for usage in result.usage], dtype=np.int64),
            "trials": np.array([usage.trials for usage in result.usage], dtype=np.int64),
            "popularity": np.concatenate([np.empty(0, np.int64), *(usage.popularity for usage in result.usage)]),
        },
        "switches": result.switches,
        "coverage": {field.name: _listed(getattr(result.coverage, field.name)) for field in fields(Coverage)},
        "baseline": None if result.baseline is None else _result_body(result.baseline),
        "notes": list(result.notes),
    }


def result_from_tree(tree: Mapping[str, Any], records: Sequence[TrialRecord] = ()) -> EvaluationResult:
    """Make an evaluation from the content of its document, with or without the simulated ticks of its trials.

    Parameters
    ----------
    tree : mapping    result of `result_to_tree`
    records : sequence of TrialRecord    ticks of each trial, in the order of the trials; empty if they were not read

    Returns
    -------
    EvaluationResult    the evaluation

    Raises
    ------
    MotionError    if the document has another schema
    """
    _require(tree, EVALUATION_SCHEMA)
    return _result(tree, records)


def clips_from_tree(tree: Mapping[str, Any]) -> tuple[DatabaseClip, ...]:
    """Read the clips of an evaluation's document, in the order of their rows.

    Parameters
    ----------
    tree : mapping    result of `result_to_tree`

    Returns
    -------
    tuple of DatabaseClip    the clips
    """
    return tuple(DatabaseClip(**(dict(clip) | {"tags": tuple(clip["tags"])})) for clip in tree["clips"])


def _result(tree: Mapping[str, Any], records: Sequence[TrialRecord]) -> EvaluationResult:
    clips = clips_from_tree(tree)
    return EvaluationResult(
        options=options_from_tree(tree["options"]),
        provenance=Provenance(**tree["provenance"]),
        clips=clips,
        trials=tuple(
            TrialResult(trial_from_document(one["trial"]), one["metrics"], one["regimes"]) for one in tree["trials"]
        ),
        suite=tree["suite"],
        usage=_usage(tree["usage"], clips),
        switches=tree["switches"],
        coverage=Coverage(**(dict(tree["coverage"]) | {"too_short": tuple(tree["coverage"]["too_short"])})),
        records=tuple(records),
        baseline=None if tree["baseline"] is None else _result(tree["baseline"], ()),
        notes=tuple(tree["notes"]),
        perceived=PerceivedTransitions.from_tree(tree.get("perceived")),
        replicates=_replicates(tree.get("replicates")),
    )


def trial_from_document(tree: Mapping[str, Any]) -> Trial:
    """Return the trial that a part of an evaluation's document describes.

    Parameters
    ----------
    tree : mapping    member `trial` of an entry in `trials` of the document

    Returns
    -------
    Trial    the trial
    """
    path = tuple((x, z, heading) for x, z, heading in tree.get("path", ()))
    return Trial(**(dict(tree) | {"path": path}))


def options_from_tree(tree: Mapping[str, Any]) -> EvaluationOptions:
    """Read the options written by `result_to_tree`.

    Parameters
    ----------
    tree : mapping    plain values

    Returns
    -------
    EvaluationOptions    the options

    Raises
    ------
    ValidationError    if a value is out of range
    """
    flat = {"replicates": 1, **tree, **tree["grid"]}  # results of old versions have no replicates
    known = EvaluationOptions.model_fields.keys() & flat.keys()  # results of old versions have no limits
    return EvaluationOptions.model_validate({name: flat[name] for name in known})


def _options_to_tree(options: EvaluationOptions) -> Tree:
    """Convert options, with the speeds and turn rates of the trials under `grid`."""
    tree = _plain(options.model_dump())
    return {"grid": {name: tree.pop(name) for name in Grid.model_fields}, **tree}


def _usage(tree: Mapping[str, Any], clips: Sequence[DatabaseClip]) -> tuple[ClipUsage, ...]:
    columns = zip(*(tree[name].tolist() for name in ("clip", "ticks", "share", "entries", "trials")), strict=True)
    return tuple(
        ClipUsage(clip, ticks, share, entries, trials, tree["popularity"][own.start : own.stop])
        for own, (clip, ticks, share, entries, trials) in zip(clips, columns, strict=True)
    )


def records_to_tree(trials: Sequence[Trial], records: Sequence[TrialRecord]) -> Tree:
    """Join the simulated ticks of all or some trials into a few large arrays.

    Record r has the ticks [starts[r], starts[r + 1]). Costs are not defined at every tick. Each cost is stored
    as two arrays: the ticks at which it is defined, counted over all records, and its values at these ticks.

    Parameters
    ----------
    trials : sequence of Trial    R trials
    records : sequence of TrialRecord    simulated ticks of each trial

    Returns
    -------
    dict    plain values and arrays

    Raises
    ------
    MotionError    if there is not one record per trial, or if the records have different rates
    """
    rates = {record.rate_hz for record in records}
    if len(trials) != len(records) or len(rates) != 1:
        raise MotionError(
            f"each trial needs one record, and all records need the same rate; there are {len(records)} "
            f"records at the rates {sorted(rates)} for {len(trials)} trials"
        )
    return {
        "schema": RECORDS_SCHEMA,
        "rate_hz": rates.pop(),
        "trials": [trial.name for trial in trials],
        "starts": np.cumsum([0, *(len(record.rows) for record in records)], dtype=np.int64),
        **{
            name: np.concatenate([getattr(record, name) for record in records])
            for name in ("rows", "positions", "headings", "status")
        },
        **{name: _known(np.concatenate([getattr(record, name) for record in records])) for name in COSTS},
    }


def records_from_tree(tree: Mapping[str, Any]) -> dict[str, TrialRecord]:
    """Read the simulated ticks of trials from the content of their document.

    Parameters
    ----------
    tree : mapping    result of `records_to_tree`

    Returns
    -------
    dict of str to TrialRecord    by the name of their trial, in the order they were written

    Raises
    ------
    MotionError    if the document has another schema
    """
    _require(tree, RECORDS_SCHEMA)
    starts = tree["starts"].tolist()
    columns = {name: tree[name] for name in ("rows", "positions", "headings", "status")}
    columns |= {name: _everywhere(tree[name], starts[-1]) for name in COSTS}
    return {
        trial: TrialRecord(rate_hz=tree["rate_hz"], **{name: column[start:stop] for name, column in columns.items()})
        for trial, start, stop in zip(tree["trials"], starts, starts[1:], strict=False)
    }


def _known(costs: NDArray[np.float64]) -> Tree:
    ticks = np.flatnonzero(~np.isnan(costs)).astype(np.int32)
    return {"ticks": ticks, "values": costs[ticks]}


def _everywhere(tree: Mapping[str, Any], count: int) -> NDArray[np.float64]:
    costs = np.full(count, np.nan)
    costs[tree["ticks"]] = tree["values"]
    return costs


def _require(tree: Mapping[str, Any], schema: str) -> None:
    if tree.get("schema") != schema:
        raise MotionError(f"a document of schema {schema} is needed, not {tree.get('schema')}", where="schema")


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _plain(value: Any) -> Any:
    """Convert tuples to lists, and mappings to dictionaries."""
    if isinstance(value, Mapping):
        return {key: _plain(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
