"""Command `view`, and addresses of pages: prints or opens the address of the page that shows a clip in a browser."""

from __future__ import annotations

import html
import tempfile
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote, urlencode

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project
from marey_client.cli.revisions import require_revision
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import connect
from marey_client.cli.terminal.output import print_message

if TYPE_CHECKING:
    from marey_client.items import ItemHandle
    from marey_client.marey import Marey

InBrowser = Annotated[
    bool, typer.Option("--browser", help="Open the page in a browser of this machine; default: print its address.")
]
SOURCE = "source"
"""Value of `--beside` that means the clip from which the clip was made."""
_REDIRECT = '<!doctype html><meta charset="utf-8"><title>Marey</title><meta http-equiv="refresh" content="0;url={url}">'


def add_to(app: typer.Typer) -> None:
    """Register the command of this module."""
    app.command()(view)


def view(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="The clip: project/folder/name[@revision], or project/id[@revision].")],
    beside: Annotated[
        str | None,
        typer.Option(help="Another clip of the project to show beside it, or `source`: the clip it was made from."),
    ] = None,
    browser: InBrowser = False,
) -> None:
    """Show a clip in a browser. The address signs one browser in, once, within two minutes."""
    from marey_schemas.sign_ins import VIEW_PATH

    other = [] if beside in (None, SOURCE) else [str(beside)]
    addresses = addresses_in_one_project([place, *other])
    project = addresses[0].project
    with connect(context) as marey:
        found = [_clip_at(marey, address) for address in addresses]
        shown = [_named(clip.id, revision) for clip, revision in found]
        if beside == SOURCE:
            shown.append(_source_of(*found[0]))
        clips = dict(zip(("clip", "beside"), (f"{project}/{one}" for one in shown), strict=False))
        url = page_address(marey, project, VIEW_PATH, clips)
    return show_page(url, browser=browser)


def page_address(marey: Marey, project: str, path: str, query: Mapping[str, str]) -> str:
    """Return the address of a page about a project, with the code of a new link that signs one browser in."""
    link = marey.project(project).browser_link()
    return f"{marey.transport.url}{path}?{urlencode(query, safe='/@')}#{quote(link.code)}"


def show_page(url: str, *, browser: bool) -> None:
    """Open the address of a page in a browser of this machine, or print it. Raises `WrongUsage` without a browser."""
    if browser:
        return _open(url)
    return typer.echo(url)


def _clip_at(marey: Marey, address: Address) -> tuple[ItemHandle, int | None]:
    from marey_schemas.kinds import Kind

    return require_revision(marey, address, [Kind.CLIP])


def _named(item: str, revision: int | None) -> str:
    return item if revision is None else f"{item}@{revision}"


def _source_of(clip: ItemHandle, revision: int | None) -> str:
    """Return the id and revision of the clip from which a clip was made. Raises `WrongUsage` if it is not just one."""
    from marey_schemas.kinds import Kind

    graph = clip.lineage_graph(revision, direction="inputs", depth=1)
    sources = [one for one in graph.revisions if one.kind is Kind.CLIP and one.distance == -1 and not one.deleted]
    if len(sources) != 1:
        place = f"{clip.project}/{clip.path}"
        raise WrongUsage(
            f"{place} was made from {len(sources)} clips that exist; name a clip after --beside, see `marey lineage "
            f"{place}`"
        )
    return _named(sources[0].item, sources[0].revision)


def _open(url: str) -> None:
    """Open an address in the browser by a file, because other users could read the arguments of a program."""
    with tempfile.NamedTemporaryFile("w", prefix="marey-view-", suffix=".html", delete=False) as file:
        file.write(_REDIRECT.format(url=html.escape(url)))
    if webbrowser.open(Path(file.name).as_uri()):
        return print_message("opened the page in the browser; the link works once")
    Path(file.name).unlink()
    raise WrongUsage("no browser was found on this machine; leave out --browser, and open the address that is printed")
