"""Command `script compare`: runs of a script as a table or a chart."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.queue.compared_tables import (
    RunTable,
    shown_columns,
    table_of_means,
    table_of_runs,
    texts_of_means,
)
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_schemas.formats.pictures import CHART_FILES, Plot

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.documents.report_pages import ReportOrigin
    from marey_schemas.queue.comparisons import ComparedColumn, RunComparison

MOST_COLUMNS = 16
"""Greatest number of columns of a table for people."""

Names = list[str] | None
ScriptName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the script.")]


def compare(
    context: typer.Context,
    project: ProjectName,
    name: ScriptName,
    fields: Annotated[
        Names, typer.Option("--field", help="Logged field to compare; may be repeated. Default: all.")
    ] = None,
    highest: Annotated[
        Names, typer.Option(help="Field whose highest value is marked as the best; may be repeated.")
    ] = None,
    lowest: Annotated[
        Names, typer.Option(help="Field whose lowest value is marked as the best; may be repeated.")
    ] = None,
    sort: Annotated[
        str,
        typer.Option(
            metavar="ORDER",
            help="Order of the runs: created_at, fields.NAME for a logged field, or values.NAME for a parameter; "
            "a leading - sorts in descending order. The first value of the field in this order is the best, "
            "unless --highest or --lowest names the field.",
        ),
    ] = "-created_at",
    limit: Annotated[
        int | None, typer.Option(min=1, help="Greatest number of runs. Default: as many as possible.")
    ] = None,
    means: Annotated[
        bool,
        typer.Option(
            "--means", help="Print one row for each setting, with the means of the fields over its runs (seeds)."
        ),
    ] = False,
    every_column: Annotated[bool, typer.Option("--all-columns", help="Show columns with equal values, too.")] = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV with exact numbers.")] = False,
    chart: Annotated[
        Path | None,
        typer.Option(
            help="Also draw charts to this file: .html is a page with all charts and tables, .svg or .png one chart."
        ),
    ] = None,
    plot: Annotated[
        Plot | None,
        typer.Option(
            help="With --chart: kind of chart. lines: fields over steps; scatter: a field over a parameter; "
            "bars: a bar for each setting. Default: in a .html page all kinds, in a .svg or .png the first "
            "kind for which there are values."
        ),
    ] = None,
    parameter: Annotated[
        str | None,
        typer.Option(
            help="With --chart: parameter on the horizontal axis. Default: the first one that differs between the runs."
        ),
    ] = None,
    log: Annotated[
        bool,
        typer.Option("--log", help="With --chart: use a logarithmic scale for fields that have only positive values."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Compare the succeeded runs of a script: print a table of the differences, and with --chart also draw charts.

    Runs that differ only by their seeds are replicates of one setting. Charts show the number n of replicates, their
    mean, and for 3 or more replicates the 95 % confidence interval of the mean.
    """
    ending = _ending_of(chart)
    if as_csv and as_json:
        raise WrongUsage("choose one of --csv and --json")
    if chart is None and (plot or parameter or log):
        raise WrongUsage("--plot, --parameter and --log have an effect only with --chart; add --chart FILE")
    goals: dict[str, Any] = dict.fromkeys(highest or (), "highest")
    if both := sorted(goals.keys() & set(lowest or ())):
        raise WrongUsage(f"{both[0]} is named by --highest and by --lowest; name it by only one of them")
    goals |= dict.fromkeys(lowest or (), "lowest")
    with connect(context) as marey:
        script = marey.project(project).scripts.at(name)
        found = script.compare(sort=sort, limit=limit, fields=fields or (), goals=goals, curves=chart is not None)
        if chart is not None:
            options = {"file_type": ending, "plot": plot, "parameter": parameter, "log": log}
            _draw(found, chart, options, _origin(marey, project) if ending == "html" else None)
    if as_json:
        return print_json(found)
    columns = shown_columns(found, every=every_column)
    if as_csv:
        return typer.echo((table_of_means if means else table_of_runs)(found, columns).csv(), nl=False)
    return _print(found, columns, means=means)


def _ending_of(chart: Path | None) -> str:
    ending = "" if chart is None else chart.suffix.lower().lstrip(".")
    if chart is not None and ending not in CHART_FILES:
        raise WrongUsage(f"{chart} must end in .html, .svg or .png")
    return ending


def _origin(marey: Marey, project: str) -> ReportOrigin:
    """Return the facts that a page names as its origin: project, server, user, and the present time."""
    from marey_schemas.documents.report_pages import ReportOrigin

    user = marey.me().user
    return ReportOrigin(project, marey.transport.url, None if user is None else user.name, datetime.now(UTC))


def _draw(found: RunComparison, chart: Path, options: dict[str, Any], origin: ReportOrigin | None) -> None:
    from marey_client import embedded
    from marey_client.downloads import write_whole
    from marey_schemas.documents.report_pages import with_origin

    if not found.runs:
        return print_message("there is nothing to draw; no run has succeeded")
    drawn = embedded.draw_comparison(found, **options)
    write_whole(chart, drawn if origin is None else with_origin(drawn, origin))
    return print_message(f"wrote {chart}")


def _print(found: RunComparison, columns: Sequence[ComparedColumn], *, means: bool) -> None:
    left_out = columns[MOST_COLUMNS:]
    shown = columns[:MOST_COLUMNS]
    table: RunTable = texts_of_means(found, shown) if means else table_of_runs(found, shown)
    print_table(table.heads, table.texts(), right=sorted(table.numeric))
    if goals := [f"{column.goal} {column.name}" for column in shown if column.goal is not None]:
        print_message(f"* best: {', '.join(goals)}")
    if left_out:
        print_message(f"{len(left_out)} more columns; choose with --field, or use --csv")
    if not found.complete:
        print_message(f"only the first {len(found.runs)} runs are compared")
    if repeats := sum(setting.repeats for setting in found.settings) if means else 0:
        print_message(f"{repeats} repetitions with a seed that was compared already are not counted")
