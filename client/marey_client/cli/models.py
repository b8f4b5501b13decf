"""`model` and `sample`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, find_item, require_item
from marey_client.cli.failures import WrongUsage
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.jobs import follow
from marey_client.cli.output import print_json, print_table, tell
from marey_schemas.formats import SAMPLE_FORMATS
from marey_schemas.wording import one_of

if TYPE_CHECKING:
    from marey_client.handles.models import ModelHandle
    from marey_client.marey import Marey
    from marey_schemas.jobs import CollectionInput, ItemInput


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.command()(model)
    app.command()(sample)


def model(
    context: typer.Context,
    sources: Annotated[list[str], typer.Argument(help="Aligned clips or folders of them: project/folder.")],
    name: Annotated[str | None, typer.Option(help="Name of the model; default: that of the folder.")] = None,
    into: Annotated[str | None, typer.Option(help="Its folder in the project; default: beside the clips'.")] = None,
    scaling: Annotated[
        str | None, typer.Option(help="jacobian (default), sfpca (slower, closer), root_max or none.")
    ] = None,
    share: Annotated[
        float | None, typer.Option(help="Share of the variance that is kept, 0.01 to 1; default 0.95.")
    ] = None,
    components: Annotated[int | None, typer.Option(help="Keep exactly so many spatial components.")] = None,
    time_components: Annotated[int | None, typer.Option(help="Keep at most so many of time; default 3.")] = None,
    mixture: Annotated[int | None, typer.Option(help="Exactly so many kinds of motion; default: chosen.")] = None,
    criterion: Annotated[str | None, typer.Option(help="What chooses how many kinds: bic (default) or aic.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything that is random in training.")] = 0,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Draw the figures of the report.")] = True,
    tag: Annotated[list[str] | None, typer.Option(help="Tag of the result; may be repeated.")] = None,
    priority: Annotated[int, typer.Option(min=-100, max=100, help="Higher goes first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Learn a generative model of one action from clips that were aligned with each other."""
    addresses = [Address.parse(source) for source in sources]
    if len({address.project for address in addresses}) > 1:
        raise WrongUsage("the aligned clips must be in one project")
    folder, _, last = addresses[0].path.rpartition("/")
    given: dict[str, Any] = {
        "name": name or last or "model",
        "scaling": scaling,
        "spatial_share": share,
        "spatial_components": components,
        "most_temporal_components": time_components,
        "mixture_components": mixture,
        "criterion": criterion,
        "report": None if report else False,
        "tags": tuple(tag or ()) or None,
    }
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        submitted = project.train_model(
            [_aligned_at(marey, address) for address in addresses],
            into=folder if into is None else into.strip("/"),
            seed=seed,
            priority=priority,
            **{name: value for name, value in given.items() if value is not None},
        )
        if not wait:
            return print_json(submitted) if as_json else typer.echo(submitted.id)
        follow(marey, submitted)
        found = project.model(submitted)
        return _print_model(found, as_json)


def sample(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="A model: project/folder/name, or project/id.")],
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="How many motions.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same motions.")] = 0,
    format: Annotated[str, typer.Option(help=f"{one_of(SAMPLE_FORMATS)}.")] = "bvh",  # noqa: A002
    out: Annotated[
        Path | None, typer.Option("--out", "--output", "-o", help="Folder to write files to; default: this one.")
    ] = None,
    into: Annotated[str | None, typer.Option(help="Make clips in this folder of the project, not files.")] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of a BVH file: cm or m.")] = None,
    as_json: AsJson = False,
) -> None:
    """Draw motions from a model, and write them to files or make clips of them."""
    if format not in SAMPLE_FORMATS:
        raise WrongUsage(f"{format!r} is no format; there are {', '.join(SAMPLE_FORMATS)}")
    if into is not None and out is not None:
        raise WrongUsage("--out writes files, --into makes clips; ask for one of them")
    with connect(context) as marey:
        found = model_at(marey, place)
        if into is not None:
            made = [f"{clip.project}/{clip.path}" for clip in found.add_samples(n, seed, into=into.strip("/"))]
        else:
            made = [str(path) for path in found.save_samples(out or Path(), format, n=n, seed=seed, unit=unit)]
    if as_json:
        return print_json({"clips" if into is not None else "files": made})
    for one in made:
        typer.echo(one)
    return None


def model_at(marey: Marey, place: str) -> ModelHandle:
    """The model at a place. Raises `WrongUsage` where there is none."""
    from marey_schemas.kinds import Kind

    found: ModelHandle = require_item(marey, Address.parse(place), [Kind.MODEL])
    return found


def _aligned_at(marey: Marey, address: Address) -> CollectionInput | ItemInput:
    from marey_schemas.jobs import CollectionInput
    from marey_schemas.kinds import Kind

    found = find_item(marey, address, [Kind.PROCESSED])
    return CollectionInput(collection=address.path) if found is None else found.as_input()


def _print_model(found: ModelHandle, as_json: bool) -> None:
    training = found.training()
    if as_json:
        return print_json({"model": found.item, "summary": found.summary(), "warnings": training["warnings"]})
    typer.echo(found.verdict)
    errors = training["reconstruction"]
    if errors is not None:
        columns = ("components", "trained on, cm", "left out, cm")
        kept = found.summary()["spatial_components"]
        rows = [
            (f"{count}{' *' if count == kept else ''}", f"{trained:.2f}", f"{left_out:.2f}")
            for count, trained, left_out in zip(
                errors["components"].tolist(), errors["training_cm"], errors["left_out_cm"], strict=True
            )
        ]
        print_table(columns, rows, right=columns)
    for warning in training["warnings"]:
        tell(f"{warning['code']}: {warning['message']}")
    return tell(f"{found.path}: marey sample {found.project}/{found.path} -n 10 --out samples")
