"""`report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from marey_client.cli.addresses import Address, require_item
from marey_client.cli.invocation import connect
from marey_client.cli.output import tell
from marey_schemas.wording import counted


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.command()(report)


def report(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="An evaluation or a model: project/folder/name, or project/id.")],
    out: Annotated[Path, typer.Option("--out", "--output", "-o", help="The file to write.")] = Path("report.html"),
    figures: Annotated[
        Path | None, typer.Option(help="Write every figure to this folder: PNG, SVG, JSON, CSV.")
    ] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Show it in a browser.")] = False,
) -> None:
    """Write the report of an evaluation or a model to a file."""
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        found = require_item(marey, Address.parse(place), [Kind.EVALUATION, Kind.MODEL])
        found.save_report(out)
        drawn = found.save_figures(figures) if figures is not None else []
    typer.echo(out)
    if figures is not None:
        tell(f"{counted(len(drawn), 'file')} of figures in {figures}")
    if open_it:
        import webbrowser

        webbrowser.open(out.absolute().as_uri())
