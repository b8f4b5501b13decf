"""Comparison of the runs of a script: differing columns, best values, and means of replicates with intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from marey_schemas.documents.replicates import mean_interval
from marey_schemas.queue.comparisons import (
    MOST_DRAWN,
    ComparedColumn,
    ComparedRun,
    ComparedSetting,
    Curve,
    FieldSummary,
    Goal,
    RunComparison,
    Source,
    number_of,
)
from marey_server.errors import BadRequestProblem
from marey_server.store.scripts import comparing
from marey_server.store.scripts.comparing import RunToCompare
from marey_server.store.transaction import Transaction

MOST_NAMED = 20
"""Greatest number of fields that an error names."""


@dataclass(frozen=True, slots=True)
class Compared:
    """Request for a comparison of runs.

    Parameters
    ----------
    sort : order of the runs, as in the list of runs; if it names a logged field, it also gives the goal of the field
    limit : greatest number of runs
    fields : logged fields to compare; empty: all
    goals : whether the highest or the lowest value is the best, by field
    curves : whether to return the curves of the given fields, or else of the fields that most runs logged
    """

    sort: str
    limit: int
    fields: tuple[str, ...] = ()
    goals: Mapping[str, Goal] | None = None
    curves: bool = False


def compare_runs(tx: Transaction, project: str, name: str, wanted: Compared) -> RunComparison:
    """Compare the succeeded runs of a script, or the first `wanted.limit` of them.

    Raises `BadRequestProblem` for an unknown order, and for a field that no run has logged.
    """
    found, complete = comparing.find_runs(tx, project, name, sort=wanted.sort, limit=wanted.limit)
    curves = comparing.read_curves(tx, [run.curves_blob for run in found if run.curves_blob]) if wanted.curves else {}
    return compare_read(name, found, curves, wanted, complete=complete)


def compare_read(
    name: str,
    found: Sequence[RunToCompare],
    curves: Mapping[str, Mapping[str, Curve]],
    wanted: Compared,
    *,
    complete: bool,
) -> RunComparison:
    """Compare runs that were read from the database.

    `curves` maps the digest of a curves file to its curves by field. `complete` is false if there are more runs than
    these. Raises `BadRequestProblem` for a field that no run has logged.
    """
    goals = _goals(wanted)
    logged = dict.fromkeys(field for run in found for field in run.fields)
    if found and (unknown := [field for field in (*wanted.fields, *goals) if field not in logged]):
        plain = [field for field in logged if field.isidentifier()]  # a worker may have made up others
        shown = ", ".join(plain[:MOST_NAMED]) or "none"
        more = f" and {len(plain) - MOST_NAMED} more" if len(plain) > MOST_NAMED else ""
        raise BadRequestProblem(
            f"No compared run logged the field {unknown[0]!r}; the fields are {shown}{more}.", code="no-field"
        )
    drawn = _drawn(found, curves, wanted)
    fields = wanted.fields or tuple(logged)
    settings = {key: place for place, key in enumerate(dict.fromkeys(run.setting for run in found))}
    counted = _counted(found)
    runs = []
    for run in found:
        own = curves.get(run.curves_blob or "", {})
        kept = {field: own[field] for field in drawn if field in own}
        runs.append(_shown(run, fields, settings[run.setting], counted=run.job in counted, curves=kept))
    summaries = tuple(_summary(runs, place) for place in settings.values())
    return RunComparison(
        subject=name,
        columns=tuple(_with_best(column, goals, runs, summaries) for column in _columns(runs, fields)),
        runs=tuple(runs),
        settings=summaries,
        curves=drawn,
        complete=complete,
    )


def _goals(wanted: Compared) -> dict[str, Goal]:
    """Return for each field whether its highest or its lowest value is the best.

    If the order of the runs names a field, it counts as a goal: in descending order, the highest value is the best.
    """
    falls, field = wanted.sort.startswith("-"), wanted.sort.removeprefix("-")
    goals: dict[str, Goal] = {}
    if field.startswith("fields.") and (not wanted.fields or field.removeprefix("fields.") in wanted.fields):
        goals[field.removeprefix("fields.")] = "highest" if falls else "lowest"
    return goals | dict(wanted.goals or {})


def _drawn(
    found: Sequence[RunToCompare], curves: Mapping[str, Mapping[str, Curve]], wanted: Compared
) -> tuple[str, ...]:
    """Return the fields whose curves are returned, at most `MOST_DRAWN`.

    These are the requested fields, or else the fields that most runs have.
    """
    counts = Counter(field for run in found for field in curves.get(run.curves_blob or "", {}))
    fields = wanted.fields or [field for field, _ in counts.most_common()]
    return tuple(field for field in fields if field in counts)[:MOST_DRAWN]


def _counted(found: Sequence[RunToCompare]) -> set[str]:
    """Return the ids of the jobs from which means are computed: for each setting and seed, the newest run."""
    newest: dict[tuple[str, int], RunToCompare] = {}
    for run in found:
        known = newest.setdefault((run.setting, run.seed), run)
        if (run.created_at, run.job) > (known.created_at, known.job):
            newest[run.setting, run.seed] = run
    return {run.job for run in newest.values()}


def _shown(
    run: RunToCompare, fields: Sequence[str], setting: int, *, counted: bool, curves: dict[str, Curve]
) -> ComparedRun:
    return ComparedRun(
        job=run.job,
        commit=run.commit,
        seed=run.seed,
        created_at=run.created_at,
        inputs=run.inputs,
        values=run.values,
        fields={field: run.fields[field] for field in fields if field in run.fields},
        setting=setting,
        counted=counted,
        curves=curves,
    )


def _summary(runs: Sequence[ComparedRun], setting: int) -> ComparedSetting:
    members = [place for place, run in enumerate(runs) if run.setting == setting]
    counted = [place for place in members if runs[place].counted]
    fields = {}
    for field in dict.fromkeys(field for place in counted for field in runs[place].fields):
        numbers = [number for place in counted if (number := number_of(runs[place].fields.get(field))) is not None]
        # The mean of the runs that did not fail to give a number would be too good.
        if len(numbers) == len(counted):
            n, mean, low, high = mean_interval(numbers)
            fields[field] = FieldSummary(n=n, mean=mean, low=low, high=high)
    return ComparedSetting(runs=tuple(counted), repeats=len(members) - len(counted), fields=fields)


def _columns(runs: Sequence[ComparedRun], fields: Sequence[str]) -> Iterator[ComparedColumn]:
    named: list[tuple[Source, str]] = [
        ("input", name) for name in dict.fromkeys(key for run in runs for key in run.inputs)
    ]
    named += [("value", name) for name in dict.fromkeys(key for run in runs for key in run.values)]
    if runs:
        named.append(("commit", "commit"))
    named += [("field", name) for name in fields]
    for of, name in named:
        column = ComparedColumn(name=name, of=of, differs=False, numeric=False)
        cells = [run.cell(column) for run in runs]
        differs = len({(isinstance(cell, bool), cell) for cell in cells}) > 1
        numeric = all(number_of(cell) is not None for cell in cells if cell is not None)
        yield column.model_copy(update={"differs": differs, "numeric": numeric})


def _with_best(
    column: ComparedColumn,
    goals: Mapping[str, Goal],
    runs: Sequence[ComparedRun],
    settings: Sequence[ComparedSetting],
) -> ComparedColumn:
    """Return the column of a field with the best value and the best mean; unchanged if the field has no goal."""
    goal = goals.get(column.name) if column.of == "field" else None
    if goal is None:
        return column
    choose = max if goal == "highest" else min
    numbers = [number for run in runs if (number := number_of(run.fields.get(column.name))) is not None]
    means = [own.fields[column.name].mean for own in settings if column.name in own.fields]
    best = {"best": choose(numbers, default=None), "best_mean": choose(means, default=None)}
    return column.model_copy(update={"goal": goal, **best})
