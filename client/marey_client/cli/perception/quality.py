"""Command `quality`, which measures defects of clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project
from marey_client.cli.terminal.failures import Refused
from marey_client.cli.terminal.following import Sources, Wait, clips_at, follow, input_at, refuse_without_waiting
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message, print_refused, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command

if TYPE_CHECKING:
    from collections.abc import Mapping

    from marey_client.handles.findings import Quality
    from marey_schemas.documents.quality import QualityChange, QualityDocument, QualityTotal

QUALITY = OptionsOf("marey_schemas.queue.job_params:QualityParams")
JOB = OptionsOf("marey_schemas.queue.jobs:JobCreate", only=("seed", "priority", "cache"))
CLIPS_SHOWN = 10


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    add_command(app, quality, params=QUALITY, job=JOB)


def quality(
    context: typer.Context,
    sources: Sources,
    params: Chosen,
    job: Chosen,
    reference: Annotated[
        list[str] | None,
        typer.Option(
            help="Recorded clip, or folder of such clips, as reference: it is measured in the same way, and its "
            "totals are shown beside those of the clips; may be repeated."
        ),
    ] = None,
    contacts: Annotated[
        list[str] | None,
        typer.Option(
            help="Annotation, or folder of annotations, with segments contact_left, contact_right or contact_both of "
            "all clips; may be repeated. Without it, contacts are detected by speed."
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="JOB",
            help="Id of an earlier job of `marey quality`: also print how the totals have changed since that job.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        output_option("Also write the report of the measurement, an HTML page, to this file."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="Also write one row for each clip to this file, as CSV.")] = None,
    figures: Annotated[
        Path | None,
        typer.Option(help="Also write every figure to this folder, as PNG and SVG, with its data as JSON and CSV."),
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Measure defects of clips: foot skate, contacts, penetration of the floor, jitter, exceeded joint limits."""
    from marey_client.handles.findings import Quality
    from marey_schemas.kinds import Kind

    refuse_without_waiting(wait, out=out, csv=csv, figures=figures, against=against)
    addresses = addresses_in_one_project([*sources, *(reference or ()), *(contacts or ())])
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        clips = [clips_at(marey, Address.parse(place)) for place in sources]
        recorded = [clips_at(marey, Address.parse(place)) for place in reference or ()]
        labelled = [input_at(marey, Address.parse(place), Kind.ANNOTATION) for place in contacts or ()]
        submitted = project.quality(clips, reference=recorded or None, contacts=labelled or None, **job, **params)
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
        if ended is None:
            return
        found = Quality(marey.transport, ended)
        document = found.measured()
        changes = None if against is None else found.changes_since(Quality(marey.transport, marey.jobs.get(against)))
        _save(found, out, csv, figures)
    _print(document, changes, as_json)
    for path in filter(None, (out, csv, figures)):
        print_message(f"written: {path}")
    if document.refused:
        raise Refused


def _save(found: Quality, out: Path | None, csv: Path | None, figures: Path | None) -> None:
    if out is not None:
        found.save_report(out)
    if csv is not None:
        found.save_table(csv)
    if figures is not None:
        found.save_figures(figures)


def _print(document: QualityDocument, changes: Mapping[str, tuple[float, float]] | None, as_json: bool) -> None:
    if as_json:
        since = {} if changes is None else {"changes_since": changes}
        return print_json({**document.model_dump(mode="json", by_alias=True), **since})
    print_refused(document.refused)
    _print_totals(document, changes)
    _print_clips(document)
    return None


def _print_totals(document: QualityDocument, changes: Mapping[str, tuple[float, float]] | None) -> None:
    from marey_schemas.documents.quality import MEASURES

    columns = ["measure", "unit", "mean", "95 % interval"]
    if document.reference is not None:
        columns += ["reference", "difference", "95 % interval of the difference"]
    if changes is not None:
        columns += ["earlier"]
    rows: list[list[Any]] = []
    for name, measure in MEASURES.items():
        digits, total = measure.digits, document.measured.totals[name]
        row = [measure.title, measure.unit, _number(total.value, digits), _ends(total, digits)]
        if document.reference is not None:
            change = document.changes.get(name)
            row += [_number(document.reference.totals[name].value, digits)]
            row += [_number(None if change is None else change.value, digits), _ends(change, digits)]
        if changes is not None:
            row += [_number(changes[name][0] if name in changes else None, digits)]
        rows.append(row)
    print_table(columns, rows, right=("mean", "reference", "difference", "earlier"))


def _print_clips(document: QualityDocument) -> None:
    from marey_schemas.documents.quality import MAIN_MEASURE, MEASURES, worst_clips_first

    measure, clips = MEASURES[MAIN_MEASURE], worst_clips_first(document.measured.clips)
    rows = [(clip.name, _number(clip.values[MAIN_MEASURE], measure.digits)) for clip in clips[:CLIPS_SHOWN]]
    print_table(("worst clips", f"{measure.title} {measure.unit}"), rows, right=(f"{measure.title} {measure.unit}",))
    if len(clips) > CLIPS_SHOWN:
        print_message(f"… and {len(clips) - CLIPS_SHOWN} more; --csv writes all, with all measures")


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{round(value, digits) + 0.0:,.{digits}f}"


def _ends(one: QualityTotal | QualityChange | None, digits: int) -> str:
    if one is None or one.low is None or one.high is None:
        return ""
    return f"{_number(one.low, digits)} to {_number(one.high, digits)}"
