"""Commands of the group `metric`: perceptual metrics, and comparisons of clips by them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.following import FINDINGS_JOB, Sources, Wait, clips_at, follow, refuse_without_waiting
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_refused, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.cli.terminal.typed_values import read_json
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from marey_client.marey import Marey
    from marey_schemas.documents.metrics import MetricDocument

DISTANCES = OptionsOf("marey_schemas.queue.job_params:DistancesParams", without=("loops", "metric"))
PAIRS_SHOWN = 15

metric = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Compare clips as people see them, by perceptual metrics."
)

MetricName = Annotated[
    str | None,
    typer.Option(
        "--metric",
        help="Perceptual metric that compares motions: the name of a built-in one, such as published/sigmoid (`marey "
        "metric ls` lists them), or project/folder/name.",
    ),
]
Shown = Annotated[
    str,
    typer.Argument(
        help="Name of a built-in metric, project/folder/name, or JSON file of a metric (name ends in .json)."
    ),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(metric, name="metric")


def metric_at(marey: Marey, name: str | None) -> str | None:
    """Return `name` if it is the name of a built-in metric, or else the id of the metric at the address `name`.

    Returns None if `name` is None. Raises `WrongUsage` if there is no such metric.
    """
    from marey_schemas.documents.metrics import is_built_in
    from marey_schemas.kinds import Kind

    if name is None or is_built_in(name):
        return name
    if name.partition("/")[0] in ("published", "uniform") or "/" not in name:
        raise WrongUsage(f"there is no built-in metric {name}; `marey metric ls` lists them")
    return str(require_item(marey, Address.parse(name), [Kind.METRIC]).id)


@metric.command("ls")
def list_metrics(
    context: typer.Context,
    place: Annotated[
        str | None,
        typer.Argument(
            help="Project or folder whose stored metrics are listed, too. Default: only built-in metrics are listed."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the built-in metrics, and the stored metrics of a project."""
    from marey_schemas.documents.metrics import built_in_metric, built_in_names

    known = {name: built_in_metric(name) for name in built_in_names()}
    if place is not None:
        address = Address.parse(place)
        with connect(context) as marey:
            items = marey.project(address.project).metrics.list(collection=address.path)
            known |= {f"{address.project}/{one.path}": one.document() for one in items}
    if as_json:
        return print_json({name: document.stored() for name, document in known.items()})
    rows = [(name, one.origin, ", ".join(part.measurement for part in one.components)) for name, one in known.items()]
    return print_table(("metric", "origin", "measurements"), rows)


@metric.command()
def show(context: typer.Context, name: Shown, as_json: AsJson = False) -> None:
    """Show the weights and conventions of a metric."""
    from marey_schemas.documents.metrics import JOINT_CLASS_NAMES, MetricIdentity

    document = _document(context, name)
    if as_json:
        return print_json(document.stored())
    columns = ("measurement", "shaping", "share", "c", "N", *JOINT_CLASS_NAMES)
    rows = [
        (
            one.measurement,
            one.shaping,
            f"{one.share:.3f}",
            f"{one.constant:.3f}",
            f"{one.norm:.3f}",
            *(f"{one.weights[part]:.3f}" if part in one.weights else "" for part in JOINT_CLASS_NAMES),
        )
        for one in document.components
    ]
    print_table(columns, rows, right=columns[2:])
    print_pairs(
        [
            ("origin", document.origin),
            ("frame rate", f"{document.frame_rate_hz:g} Hz"),
            ("digest", MetricIdentity.of(document).digest),
        ]
    )
    for note in document.notes:
        print_message(note)
    return None


@metric.command()
def store(
    context: typer.Context,
    name: Shown,
    into: Annotated[str, typer.Argument(help="Address of the new item: project/folder/name.")],
) -> None:
    """Store a metric as an item, so that versions of datasets and other projects can contain it."""
    address, document = Address.parse(into), _document(context, name)
    if not address.path or address.is_folder:
        raise WrongUsage(f"{into!r} names no item; write project/folder/name")
    folder, _, last = address.path.rpartition("/")
    with connect(context) as marey:
        made = marey.project(address.project).metrics.store(document, last, collection=folder)
    typer.echo(f"{made.project}/{made.path}")


def compare(
    context: typer.Context,
    sources: Sources,
    params: Chosen,
    job: Chosen,
    metric: MetricName = None,
    out: Annotated[
        Path | None,
        output_option("Also write the report of the comparison, an HTML page, to this file."),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(help="Also write every figure to this folder, as PNG and SVG, with its data as JSON and CSV."),
    ] = None,
    maps: Annotated[
        Path | None,
        typer.Option(help="Also write motion maps and registration curves to this file, as a NumPy archive (.npz)."),
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Measure how different clips look to people: distances of all pairs, motion maps and registration curves."""
    from marey_client.handles.metrics import Distances

    refuse_without_waiting(wait, out=out, figures=figures, maps=maps)
    addresses = addresses_in_one_project(sources)
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        clips = [clips_at(marey, address) for address in addresses]
        submitted = project.distances(clips, metric=metric_at(marey, metric), **job, **params)
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
        if ended is None:
            return
        found = Distances(marey.transport, ended)
        document = found.document()
        if out is not None:
            found.save_report(out)
        if figures is not None:
            found.save_figures(figures)
        if maps is not None:
            found.save_maps(maps)
    refused = found.summary["refused"]
    if as_json:
        print_json({"summary": found.summary, **_plain(document)})
    else:
        print_refused(refused)
        _print_distances(document)
    for path in filter(None, (out, figures, maps)):
        print_message(f"written: {path}")
    if refused:
        raise Refused


add_command(metric, compare, params=DISTANCES, job=FINDINGS_JOB)


def _document(context: typer.Context, name: str) -> MetricDocument:
    """Return the document of a metric that is given as the name of a built-in one, as a JSON file, or as an address.

    Only an address needs the server.
    """
    from marey_schemas.documents.metrics import MetricDocument, built_in_metric, is_built_in

    if name.endswith(".json"):
        return MetricDocument.model_validate(read_json(name))
    if is_built_in(name):
        return built_in_metric(name)
    with connect(context) as marey:
        project = marey.project(Address.parse(name).project)
        return project.metrics.get(str(metric_at(marey, name))).document()


def _print_distances(document: Mapping[str, Any]) -> None:
    names = [clip["name"] for clip in document["clips"]]
    table, parts = document["distances"], document["components"]
    if len(parts) == 1:  # its distances are those of the metric
        parts = {}
    pairs = sorted(
        ((i, j) for i in range(len(names)) for j in range(i + 1, len(names))), key=lambda pair: float(table[pair])
    )
    columns = ("clips", "distance", *parts)
    rows = [
        (f"{names[i]} – {names[j]}", f"{table[i, j]:.3f}", *(f"{part[i, j]:.3f}" for part in parts.values()))
        for i, j in pairs[:PAIRS_SHOWN]
    ]
    print_table(columns, rows, right=columns[1:])
    if len(pairs) > PAIRS_SHOWN:
        typer.echo(f"… and {counted(len(pairs) - PAIRS_SHOWN, 'pair')} more, which differ more; --json has all.")
    typer.echo(f"metric: {document['metric']['name']}")
    for sentence in document["says"]:
        print_message(sentence)


def _plain(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document in which lists replace numpy arrays, so that it can be printed as JSON."""
    tables = {name: part.tolist() for name, part in document["components"].items()}
    return {**document, "distances": document["distances"].tolist(), "components": tables}
