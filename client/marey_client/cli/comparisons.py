"""Command `compare`: what changed between evaluations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.evaluations import evaluation_at, perceived_text
from marey_client.cli.improvements import SHOWN, Evaluation, print_findings, submit_and_follow
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import FINDINGS_JOB, Wait, refuse_without_waiting
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_message, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

COMPARE = OptionsOf("marey_schemas.queue.job_params:CompareParams")
PRINTED_METRICS = (
    ("offset_mean", "offset m"),
    ("abs_se_v", "speed error m/s"),
    ("abs_se_omega_deg", "turn error degrees/s"),
    ("pose_cost_mean", "pose cost m"),
    ("transitions_per_s", "switches 1/s"),
)
"""Metrics in the printed tables; --json and the report contain all metrics."""


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    add_command(app, compare, params=COMPARE, job=FINDINGS_JOB)


def compare(
    context: typer.Context,
    before: Evaluation,
    others: Annotated[
        list[str],
        typer.Argument(
            help="Evaluation to compare with BEFORE; or several, each of another set of clips. All must have the "
            "same trials and the same scaling of features as BEFORE: create them with `marey evaluate "
            "--normaliser BEFORE`."
        ),
    ],
    params: Chosen,
    job: Chosen,
    out: Annotated[
        Path | None,
        output_option("Also write the report of the comparison, an HTML page, to this file."),
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Compare two evaluations trial by trial, or compare several evaluations with the first one."""
    refuse_without_waiting(wait, out=out)
    with connect(context) as marey:
        first, *rest = (evaluation_at(marey, place) for place in (before, *others))
        if any(one.project != first.project for one in rest):
            raise WrongUsage("all evaluations must be in one project")
        found = submit_and_follow(marey, first, first.compare_request(*rest, **params), job, wait, as_json)
        if found is None:
            return
        document = found.document()
        if out is not None:
            found.save_report(out)
    print_findings(found, document, as_json, _print_several if len(others) > 1 else _print_comparison)
    if out is not None and not as_json:
        print_message(f"report: {out}")


def _print_several(document: Mapping[str, Any]) -> None:
    """Print the metrics of several evaluations beside each other, with the verdict on each change from the first."""
    documents = (document, *document["others"])
    found = [{one["metric"]: one for one in each["metrics"]} for each in documents]
    rows = []
    for name, label in PRINTED_METRICS:
        if all(name in each for each in found):
            row = [label, f"{found[0][name]['before']:.4f}"]
            for each in found:
                row += [f"{each[name]['after']:.4f}", each[name]["verdict"]]
            rows.append(row)
    names = [each["names"]["after"] for each in documents]
    columns = ["metric", document["names"]["before"]]
    for name in names:
        columns += [name, ""]
    print_table(columns, rows, right=[columns[1], *names])
    typer.echo(f"Each verdict is about the change from {document['names']['before']}; --out writes a report.")
    _print_why_unclear([one for each in found for one in each.values()])


def _print_why_unclear(metrics: Iterable[Mapping[str, Any]]) -> None:
    """If changes have no interval because there are too few replicates, print how to get one."""
    from marey_schemas.documents.replicates import LEAST_REPLICATES

    if any(one["verdict"] == "unclear" and one["replicates"] < LEAST_REPLICATES for one in metrics):
        typer.echo(
            "“unclear” changes have no interval, because the evaluations have too few replicates. Evaluate all sets "
            f"again with --replicates {LEAST_REPLICATES} or more."
        )


def _print_comparison(document: Mapping[str, Any]) -> None:
    changed = document["changed"]
    moved = [one for one in changed if not one["same_motion"]]
    if not changed:
        typer.echo(f"No trial changed: the results of all {document['trials']} trials are identical, bit for bit.")
    elif not moved:
        typer.echo(
            f"The character moves in the same way in every trial; {len(changed)} of {document['trials']} trials use "
            "other clips."
        )
    else:
        typer.echo(f"{len(moved)} of {document['trials']} trials changed.")
    metrics = {one["metric"]: one for one in document["metrics"]}
    rows = [
        (label, f"{one['before']:.4f}", f"{one['after']:.4f}", f"{one['change']:+.4f}",
         "" if one["low"] is None else f"{one['low']:+.4f} to {one['high']:+.4f}", one["verdict"])
        for name, label in PRINTED_METRICS if (one := metrics.get(name)) is not None
    ]  # fmt: skip
    columns = ("metric", "before", "after", "change", "95 % interval", "verdict")
    print_table(columns, rows, right=columns[1:5])
    _print_why_unclear(metrics.values())
    _print_perceived(document)
    if moved:
        from marey_schemas.documents.worst_first import worst_first

        worst = worst_first(moved, _rise, lambda one: str(one["trial"]))[:SHOWN]
        rows_of_trials = [
            (one["trial"], _metres(one["offset_mean_before"]), _metres(one["offset_mean_after"])) for one in worst
        ]
        columns_of_trials = ("changed trials, the worst first", "offset before m", "after m")
        print_table(columns_of_trials, rows_of_trials, right=columns_of_trials[1:])
    for name, label in (("removed", "removed"), ("added", "added"), ("newly_unused", "newly unused")):
        if document[name]:
            typer.echo(f"{label}: {counted(len(document[name]), 'clip')}")


def _print_perceived(document: Mapping[str, Any]) -> None:
    """Print the perceptual distances of transitions, if an evaluation has them."""
    for name in ("before", "after"):
        if (perceived := document.get(f"perceived_{name}")) is not None:
            typer.echo(f"{name}: {perceived_text(perceived)}")


def _rise(one: Mapping[str, Any]) -> float | None:
    from marey_schemas.documents.worst_first import increase

    return increase(one["offset_mean_before"], one["offset_mean_after"])


def _metres(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
