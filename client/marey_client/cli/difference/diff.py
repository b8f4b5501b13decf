"""Command `diff`: how two revisions of an item differ, as text, JSON or a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.addresses import Address
from marey_client.cli.revisions import require_revision
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command

if TYPE_CHECKING:
    from marey_schemas.documents.differences import Difference

PICTURES = ("svg", "png")


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(app, diff, params=OptionsOf("marey_schemas.documents.differences:DifferenceOptions"))


def diff(
    context: typer.Context,
    before: Annotated[str, typer.Argument(help="Item, or one of its revisions: project/folder/name[@revision].")],
    params: Chosen,
    after: Annotated[
        str | None,
        typer.Argument(
            help="Revision to compare with: of the same item, or of another item of the same kind. Default: the "
            "first argument is compared with the revision before it."
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the difference to this file, which ends in .svg or .png.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show how two revisions of an item differ: frames, joints, path, segments, fields."""
    if picture is not None and picture.suffix.lower().lstrip(".") not in PICTURES:
        raise WrongUsage(f"{picture} must end in .svg or .png")
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        first, first_revision = require_revision(marey, Address.parse(before), list(Kind))
        if after is None:
            found = first.difference(after=first_revision, plot=picture is not None, **params)
        else:
            second, second_revision = require_revision(marey, Address.parse(after), list(Kind))
            if first.item.kind is not second.item.kind:
                raise WrongUsage(
                    f"only items of one kind can be compared; the kind of {before} is {first.item.kind}, and that of "
                    f"{after} is {second.item.kind}"
                )
            found = first.difference(
                first_revision or first.item.revision,
                second_revision or second.item.revision,
                other=None if second.id == first.id else second,
                plot=picture is not None,
                **params,
            )
    if picture is not None:
        _draw(found, picture)
    if as_json:
        return print_json(found)
    from marey_client.cli.difference.words import described

    return typer.echo("\n".join(described(found)))


def _draw(difference: Difference, picture: Path) -> None:
    from marey_client import embedded
    from marey_client.downloads import write_whole

    if difference.plot is None and difference.annotations is None:
        return print_message("there is nothing to draw; only changed motions and annotations have a picture")
    write_whole(picture, embedded.draw_difference(difference, picture.suffix.lower().lstrip(".")))
    return print_message(f"wrote {picture}")
