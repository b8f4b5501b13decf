"""Command `dataset bisect`: the first version at which a metric of the evaluation has crossed a value."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.datasets.places import DatasetPlace, parse, short
from marey_client.cli.evaluations import EVALUATE, Loops, Normaliser, Trims, add_clip_options, evaluation_at
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import FINDINGS_JOB
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_client.cli.terminal.schema_options import Chosen, add_command
from marey_client.progress import progress, show_progress
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Iterator

    from marey_client.handles.bisections import VersionRange, VersionTest
    from marey_client.handles.crossings import Crossing, Limit, Measurement, ParentChange, VersionEvaluations
    from marey_schemas.queue.jobs import Job

OPTIONS = replace(EVALUATE, without=(*EVALUATE.without, "name", "report", "trial_figures"))
"""Options of the evaluations, except the name and the options of the report.

Each evaluation is named after its version, and no report is made.
"""


def add_to(dataset: typer.Typer) -> None:
    """Add the command of this module to the group `marey dataset`."""
    add_command(dataset, bisect, params=OPTIONS, job=FINDINGS_JOB)


def bisect(
    context: typer.Context,
    place: DatasetPlace,
    good: Annotated[str, typer.Option(help="Version that is known to be good: a branch, a tag or a commit.")],
    metric: Annotated[
        str,
        typer.Option(
            help="Headline metric of the evaluation, such as offset_mean_m. An unknown name prints the list of all "
            "metrics."
        ),
    ],
    params: Chosen,
    job: Chosen,
    bad: Annotated[
        str, typer.Option(help="Later version that is known to be bad: a branch, a tag or a commit.")
    ] = "main",
    above: Annotated[
        float | None,
        typer.Option(
            help="Limit of the metric: versions with a value above it are bad. Give one "
            "of --above, --below and --half-way."
        ),
    ] = None,
    below: Annotated[
        float | None,
        typer.Option(
            help="Limit of the metric: versions with a value below it are bad. Give one "
            "of --above, --below and --half-way."
        ),
    ] = None,
    half_way: Annotated[
        bool,
        typer.Option("--half-way", help="Set the limit half-way between the values of the good and the bad version."),
    ] = False,
    path: Annotated[str, typer.Option(help="Folder of the dataset whose clips are evaluated; default: all.")] = "",
    first_parent: Annotated[
        bool,
        typer.Option(
            "--first-parent",
            help="At each merge, follow only its first parent: the branch into which another version was merged.",
        ),
    ] = False,
    into: Annotated[
        str | None,
        typer.Option(
            help="Folder that receives the evaluations; default: the name of the dataset, followed by -bisect."
        ),
    ] = None,
    loop: Loops = None,
    trim: Trims = None,
    normaliser: Normaliser = None,
    preview: Annotated[
        bool,
        typer.Option(
            "--preview",
            help="Show the number of versions, and how many evaluations are expected, but evaluate nothing.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Find the first bad version after a good one. A version is bad if a metric of its evaluation has crossed a limit.

    The command evaluates the good and the bad version, then versions between them. Each evaluation roughly halves the
    number of candidates for the first bad version. Versions that cannot be evaluated are skipped; if this leaves
    several candidates, all of them are listed, and the exit status is 1. The same command continues an interrupted
    search.
    """
    from marey_client.handles.bisections import read_range
    from marey_client.handles.crossings import VersionEvaluations, find_crossing
    from marey_schemas.queue.job_params import EvaluateParams

    limit = _limit(above, below, half_way)
    at = parse(place)
    with connect(context) as marey:
        add_clip_options(marey, params, loop, trim)
        handle = at.on(marey)
        evaluations = VersionEvaluations(
            marey.project(at.project), handle, metric, EvaluateParams.model_validate(params), path=path.strip("/"),
            into=None if into is None else into.strip("/"),
            normaliser=evaluation_at(marey, normaliser).id if normaliser else None, **job,
        )  # fmt: skip
        among = read_range(handle, good, bad, first_parent=first_parent)
        if preview:
            return _print_plan(among, as_json)
        print_message(_plan(among))
        with _interruptible(evaluations):
            found = find_crossing(among, evaluations, limit, _print_test)
    print_json(_document(found)) if as_json else _print_found(found)
    if found.first_bad is None:
        raise typer.Exit(1)
    return None


def _limit(above: float | None, below: float | None, half_way: bool) -> Limit | None:
    """Return the limit given by --above or --below, or None for --half-way.

    Raises `WrongUsage` unless exactly one of these options is given.
    """
    from marey_client.handles.crossings import Limit

    if (above is not None) + (below is not None) + half_way != 1:
        raise WrongUsage("give the limit of the metric by one of --above, --below and --half-way")
    if half_way:
        return None
    return Limit(above) if above is not None else Limit(below or 0.0, above=False)


@contextmanager
def _interruptible(evaluations: VersionEvaluations) -> Iterator[None]:
    """Show the progress of the evaluations; after an interruption, print how to continue the search."""
    trials = evaluations.params.trial_count
    try:
        with progress() as advance:

            def show(now: Job) -> None:
                show_progress(now, advance, trials, "trials")

            evaluations.on_progress = show
            yield
    except KeyboardInterrupt:
        print_message(
            f"the running evaluation was cancelled; the same command continues the search and reuses the "
            f"{counted(len(evaluations.measured), 'evaluation')} made so far"
        )
        raise


# -- output ------------------------------------------------------------------------------------------------------------


def _plan(among: VersionRange) -> str:
    count, tests = len(among.commits), among.expected_tests
    return (
        f"{counted(count, 'version')} can be the first bad one; about {counted(2 + tests, 'evaluation')}: 2 of the "
        f"good and the bad version, and {tests} between them"
    )


def _print_plan(among: VersionRange, as_json: bool) -> None:
    if as_json:
        document = {"good": among.good, "bad": among.bad, "versions": len(among.commits), "first": among.first}
        return print_json({**document, "expected": 2 + among.expected_tests})
    if among.first is not None:
        print_pairs([("first between good and bad", f"{short(among.first.digest)} {among.first.message}")])
    return print_message(_plan(among))


def _print_test(test: VersionTest, found: Measurement, left: int) -> None:
    verdict = {True: "bad", False: "good", None: "skipped"}[test.bad]
    value = found.reason if found.value is None else f"{found.value:.6g}" + (" (reused)" if found.reused else "")
    more = f"; about {left} more to evaluate" if left else ""
    print_message(f"{short(test.commit.digest)} is {verdict}: {value}{more}")


def _print_found(found: Crossing) -> None:
    first = found.first_bad
    if first is None:
        _print_suspects(found)
    else:
        print_pairs([
            ("first bad version", short(first.digest)), ("author", first.author), ("time", first.at),
            ("message", first.message), ("job", first.job),
            (found.metric, f"{found.value(first):.6g}, which is {found.limit}"),
            *((f"parent {short(one.parent.commit.digest)}", _change(found, one)) for one in found.changes),
        ])  # fmt: skip
        for one in found.changes:
            _print_doubts(found, one)
        print_message(f"this is one crossing; {found.metric} may also cross {found.limit.value:.6g} at other versions")
    reused = sum(one.reused for one in found.measurements)
    print_message(
        f"{counted(len(found.measurements), 'evaluation')}, {reused} of them reused; "
        f"{2 + found.search.range.expected_tests} were expected"
    )


def _change(found: Crossing, one: ParentChange) -> str:
    if one.parent.value is None:
        return f"not evaluated: {one.parent.reason}"
    assert found.first_bad is not None
    change = (found.value(found.first_bad) or 0.0) - one.parent.value
    interval = "" if one.interval is None else f", 95 % interval {one.interval[0]:+.4g} to {one.interval[1]:+.4g}"
    return f"{one.parent.value:.6g}, change {change:+.4g}{interval}"


def _print_doubts(found: Crossing, one: ParentChange) -> None:
    name = short(one.parent.commit.digest)
    if one.may_be_noise:
        print_message(f"the interval of the change from {name} contains 0, so the crossing may be noise")
    if one.parent.value is not None and found.limit.exceeded_by(one.parent.value):
        print_message(f"{name} counts as good because a later version is good, but its value is {found.limit}, too")


def _print_suspects(found: Crossing) -> None:
    reasons = {one.commit.digest: one.reason for one in found.measurements}
    rows = [(short(one.digest), one.at, one.author, one.message, reasons[one.digest]) for one in found.search.suspects]
    print_table(("first bad version is one of", "time", "author", "message", "reason"), rows)


def _document(found: Crossing) -> dict[str, Any]:
    results = {test.commit.digest: test.bad for test in found.search.tests}
    return {
        "metric": found.metric,
        "limit": {"value": found.limit.value, "above": found.limit.above},
        "first_bad": found.first_bad,
        "suspects": found.search.suspects,
        "changes": [
            {
                "parent": one.parent.commit.digest,
                "before": one.parent.value,
                "interval": one.interval,
                "may_be_noise": one.may_be_noise,
            }
            for one in found.changes
        ],
        "evaluations": [
            {
                "commit": one.commit.digest,
                "value": one.value,
                "bad": results.get(one.commit.digest),
                "evaluation": one.output,
                "reused": one.reused,
                "reason": one.reason,
            }
            for one in found.measurements
        ],
        "expected": 2 + found.search.range.expected_tests,
    }
