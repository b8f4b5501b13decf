"""Commands `model`, which trains a generative model, and `sample`, which draws motions from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import SEEDED_JOB, Wait, follow, input_at, print_commit
from marey_client.cli.terminal.invocation import AsJson, connect, output_option, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.formats import DEFAULT_FORMAT, SAMPLE_FORMATS
from marey_schemas.wording import one_of

if TYPE_CHECKING:
    from marey_client.handles.models import ModelHandle
    from marey_client.marey import Marey


MODEL = OptionsOf(
    "marey_schemas.queue.job_params:ModelParams",
    short={
        "spatial_share": "--share",
        "spatial_components": "--components",
        "most_temporal_components": "--time-components",
        "mixture_components": "--mixture",
    },
    defaults={"name": "the name of the first folder or clip; of a whole project, model"},
)


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(app, model, params=MODEL, job=SEEDED_JOB)
    app.command()(sample)


def model(
    context: typer.Context,
    sources: Annotated[
        list[str], typer.Argument(help="Aligned clips, or folders of aligned clips: project/folder[/name].")
    ],
    params: Chosen,
    job: Chosen,
    into: Annotated[
        str | None, typer.Option(help="Folder that receives the model; default: the folder of the clips.")
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Train a generative model of one action on clips that were aligned with each other."""
    from marey_schemas.kinds import Kind

    addresses = addresses_in_one_project(sources)
    folder, _, last = addresses[0].path.rpartition("/")
    params.setdefault("name", last or "model")
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        aligned = [input_at(marey, address, Kind.PROCESSED) for address in addresses]
        submitted = project.train_model(aligned, into=folder if into is None else into.strip("/"), **job, **params)
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
        if ended is not None:
            _print_model(project.model(ended), as_json)
            print_commit(ended)


def sample(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="A model: project/folder/name, or project/id.")],
    n: Annotated[int, typer.Option("-n", min=1, max=1000, help="Number of motions to draw.")] = 1,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the random numbers; the same seed gives the same motions.")
    ] = 0,
    format: Annotated[  # noqa: A002
        str, typer.Option(help=f"Format of the files: {one_of(SAMPLE_FORMATS)}. json puts all motions into one file.")
    ] = DEFAULT_FORMAT,
    out: Annotated[Path | None, output_option("Folder of the files; default: the current folder.")] = None,
    into: Annotated[
        str | None, typer.Option(help="Create clips in this folder of the model's project, instead of files.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of length of BVH files: cm or m. Default: cm.")] = None,
    as_json: AsJson = False,
) -> None:
    """Draw motions from a model, and write the motions to files or create clips from them."""
    if format not in SAMPLE_FORMATS:
        raise WrongUsage(f"{format!r} is not a format; the formats are {', '.join(SAMPLE_FORMATS)}")
    if into is not None and out is not None:
        raise WrongUsage("--out writes files and --into creates clips; give only one of the two")
    if into is not None:
        refuse_ignored(context, "with --into", "format", "unit")
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
    """Return the model at an address. Raises `WrongUsage` if there is none."""
    from marey_schemas.kinds import Kind

    found: ModelHandle = require_item(marey, Address.parse(place), [Kind.MODEL])
    return found


def _print_model(found: ModelHandle, as_json: bool) -> None:
    training = found.training()
    if as_json:
        return print_json({"model": found.item, "summary": found.summary(), "warnings": training["warnings"]})
    typer.echo(found.verdict)
    errors = training["reconstruction"]
    if errors is not None:
        kept = found.summary()["spatial_components"]
        counts = [f"{count}{' *' if count == kept else ''}" for count in errors["components"].tolist()]
        columns = {"components": counts, "trained on, cm": [f"{error:.2f}" for error in errors["training_cm"]]}
        if "left_out_cm" in errors:  # not known if all examples come from one take
            columns["left out, cm"] = [f"{error:.2f}" for error in errors["left_out_cm"]]
        print_table(tuple(columns), list(zip(*columns.values(), strict=True)), right=tuple(columns))
    for warning in training["warnings"]:
        print_message(f"{warning['code']}: {warning['message']}")
    place = f"{found.project}/{found.path}"
    return print_message(f"to draw motions from the model, run marey sample {place} -n 10 --out samples")
