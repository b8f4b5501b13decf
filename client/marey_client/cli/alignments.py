"""`align`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, find_item, require_item
from marey_client.cli.failures import Refused, WrongUsage
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.jobs import clips_at, follow
from marey_client.cli.output import print_json, print_table, tell_refused

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.jobs import CollectionInput, ItemInput, Job

CHOICES = ("medoid", "nearest_mean_length")
COLUMNS = ("clip", "frames", "cost, cm²", "slowest", "fastest", "")
SQUARE_CM = 1e4  # in a square metre


def add_to(app: typer.Typer) -> None:
    """Register the command of this module."""
    app.command()(align)


def align(
    context: typer.Context,
    sources: Annotated[list[str], typer.Argument(help="Clips or folders of clips of one action: project/folder.")],
    into: Annotated[str, typer.Option(help="The folder in the project that the results go to.")],
    reference: Annotated[
        str, typer.Option(help="Whose time counts: medoid, nearest_mean_length, or a clip: project/folder/name.")
    ] = "medoid",
    layer: Annotated[str | None, typer.Option(help="Align part by part, as annotations of this layer say.")] = None,
    annotations: Annotated[
        list[str] | None,
        typer.Option(help="Annotations or folders of them to go by; default: all over these clips."),
    ] = None,
    label: Annotated[
        list[str] | None, typer.Option(help="Only segments and keyframes of this label; may be repeated.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Frames per second of the results; default: the commonest.")
    ] = None,
    slope_limit: Annotated[
        int | None, typer.Option(min=-1, max=60, help="Frames in a row that may belong to one; -1: any; default 3.")
    ] = None,
    cost: Annotated[str | None, typer.Option(help="turned (poses alone; default) or plain (positions as is).")] = None,
    window: Annotated[int | None, typer.Option(help="Odd number of frames compared at once; default 1.")] = None,
    weight: Annotated[list[str] | None, typer.Option(help="joint=weight in the cost; may be repeated.")] = None,
    mirror: Annotated[str | None, typer.Option(help="none (default), or add: a mirrored twin of every clip.")] = None,
    suffix: Annotated[str | None, typer.Option(help="Appended to the names of the results.")] = None,
    tag: Annotated[list[str] | None, typer.Option(help="Tag of the results; may be repeated.")] = None,
    priority: Annotated[int, typer.Option(min=-100, max=100, help="Higher goes first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Bring examples of one action into step with each other, as a job."""
    addresses = [Address.parse(source) for source in sources]
    if len({address.project for address in addresses}) > 1:
        raise WrongUsage("the clips must be in one project")
    given = {
        "layer": layer,
        "labels": tuple(label or ()) or None,
        "rate_hz": rate,
        "cost": cost,
        "window": window,
        "weights": dict(map(_weight, weight)) if weight else None,
        "mirroring": mirror,
        "suffix": suffix,
        "tags": tuple(tag or ()) or None,
    }
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if slope_limit is not None:
        options["slope_limit"] = None if slope_limit < 0 else slope_limit
    with connect(context) as marey:
        submitted = marey.project(addresses[0].project).align(
            [clips_at(marey, address) for address in addresses],
            into=into.strip("/"),
            annotations=[_annotations_at(marey, place) for place in annotations] if annotations else None,
            reference=_reference(marey, reference),
            priority=priority,
            **options,
        )
        if not wait:
            return print_json(submitted) if as_json else typer.echo(submitted.id)
        ended = follow(marey, submitted)
    return _print_ended(ended, as_json)


def _reference(marey: Marey, text: str) -> str:
    from marey_schemas.kinds import Kind

    return text if text in CHOICES else str(require_item(marey, Address.parse(text), [Kind.CLIP]).id)


def _annotations_at(marey: Marey, text: str) -> CollectionInput | ItemInput:
    from marey_schemas.jobs import CollectionInput
    from marey_schemas.kinds import Kind

    address = Address.parse(text)
    found = find_item(marey, address, [Kind.ANNOTATION])
    return CollectionInput(collection=address.path) if found is None else found.as_input()


def _weight(text: str) -> tuple[str, float]:
    joint, _, value = text.rpartition("=")
    try:
        weight = float(value)
    except ValueError:
        raise WrongUsage(f"{text!r}: write joint=weight, the weight a number") from None
    if not joint:
        raise WrongUsage(f"{text!r}: write joint=weight")
    return joint, weight


def _print_ended(ended: Job, as_json: bool) -> None:
    result = ended.result or {}
    refused: list[dict[str, Any]] = list(result.get("refused", ()))
    if as_json:
        print_json(ended)
    else:
        rows = [
            (
                one["name"],
                one["frames"],
                f"{one['cost'] * SQUARE_CM:.2f}",
                f"{one['least_slope']:.2f}",
                f"{one['greatest_slope']:.2f}",
                "reference" if one["name"] == result["reference"] else "",
            )
            for one in result.get("aligned", ())
        ]
        print_table(COLUMNS, rows, right=COLUMNS[1:5])
        tell_refused(refused)
        keyframes = ", ".join(f"{label} {frame}" for label, frame in result.get("keyframes", {}).items())
        typer.echo(
            f"{result.get('clips')} clips of {result.get('frames')} frames at {result.get('frame_rate_hz'):g} Hz"
            + (f"; keyframes: {keyframes}" if keyframes else "")
            + f"; {len(refused)} refused"
        )
    if refused:
        raise Refused
