"""Commands `study` for results: the export of judgements, and their analysis."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.studies.conducting import StudyPlace, study, study_at
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import FINDINGS_JOB, Wait, follow, refuse_without_waiting
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message, print_pairs
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command

if TYPE_CHECKING:
    from collections.abc import Mapping

    from marey_client.handles.findings import Findings

ANALYSE = OptionsOf("marey_schemas.queue.job_params:AnalyseStudyParams")


class ExportForm(StrEnum):
    """Form of the file with exported judgements: trials as JSON or CSV, or compared pairs as CSV."""

    JSON = "json"
    CSV = "csv"
    PAIRS = "pairs"


def add_to(_app: typer.Typer) -> None:
    """Register the commands of this module in the group `study`."""
    study.command("export")(export)
    add_command(study, analyse, params=ANALYSE, job=FINDINGS_JOB)


def export(
    context: typer.Context,
    place: StudyPlace,
    out: Annotated[Path, output_option("File that receives the judgements.")],
    form: Annotated[
        ExportForm,
        typer.Option(
            help="Form of the file. json: participants with their trials; csv: one line for each trial; pairs: "
            "one line for each comparison of the chosen pair with another pair."
        ),
    ] = ExportForm.CSV,
    revision: Annotated[int | None, typer.Option(min=1, help="Revision of the study; default: the newest.")] = None,
) -> None:
    """Write the answers of participants to a file, under pseudonyms and without dates.

    For maintainers and owners of the project.
    """
    from marey_client.downloads import write_whole
    from marey_client.handles.studies import pairs_csv, trials_csv

    with connect(context) as marey:
        people = list(study_at(marey, place).judgements(revision=revision))
    if form is ExportForm.JSON:
        text = json.dumps([one.model_dump(mode="json") for one in people], indent=1) + "\n"
    else:
        text = (pairs_csv if form is ExportForm.PAIRS else trials_csv)(people)
    write_whole(out, text)
    print_message(f"{out}: {sum(len(one.trials) for one in people):,} trials of {len(people):,} participants")


def analyse(
    context: typer.Context,
    place: StudyPlace,
    params: Chosen,
    job: Chosen,
    out: Annotated[
        Path | None,
        output_option("Also write the report of the analysis, an HTML page, to this file."),
    ] = None,
    metric: Annotated[
        Path | None, typer.Option(help="Also write the best fitted metric to this file, as JSON.")
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Compute perceived differences, order and groups of the motions, and fit metrics. For maintainers and owners."""
    from marey_client.handles.findings import Findings

    refuse_without_waiting(wait, out=out, metric=metric)
    with connect(context) as marey:
        handle = study_at(marey, place)
        request = handle.analyse_request(**params).model_copy(update=job)
        ended = follow(marey, marey.project(handle.project).submit(request), wait=wait, as_json=as_json)
        if ended is None:
            return None
        found = Findings(marey.transport, ended)
        if out is not None:
            found.save_report(out)
        if metric is not None:
            _save_metric(found, metric)
        document = found.document()
    if as_json:
        return print_json(document)
    _print_analysis(found.summary, document)
    for path in (out, metric):
        if path is not None:
            print_message(f"written: {path}")
    return None


def _save_metric(found: Findings, path: Path) -> None:
    try:
        found.save_file("fitted", path)
    except LookupError as error:
        raise WrongUsage(f"no metric was fitted: {'; '.join(found.document()['refusals'])}") from error


def _print_analysis(summary: Mapping[str, object], document: Mapping[str, object]) -> None:
    shown = {name: value for name, value in summary.items() if name != "outputs"}
    print_pairs(
        [
            (name.replace("_", " "), f"{value:.3g}" if isinstance(value, float) else str(value))
            for name, value in shown.items()
        ]
    )
    refusals = document["refusals"]
    assert isinstance(refusals, list)
    for text in refusals:
        print_message(text)
